"""Renders all images of a lap in worker processes; every frame is cached under a hash of its inputs."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.tools.simulator import store
from beamsplat.tools.simulator.actors import ActorLighting, ActorPath, ActorSet
from beamsplat.tools.simulator.camera import ImageSensor, pixel_rays
from beamsplat.tools.simulator.path import DrivePath, MotionLimits
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.render import RayTable, RenderedView, SceneRenderer, ray_table
from beamsplat.tools.simulator.settings import CameraSettings, Faults
from beamsplat.tools.simulator.shade import shading_tables
from beamsplat.tools.simulator.world import World, load_world

METERING_VIEWS = 12  # views along the lap that set the exposure
METERED_LEVEL = 0.40  # exposed value of the 70th percentile of their radiance


@dataclass(frozen=True)
class FrameSpec:
    """Inputs of the rendered frames of a lap, besides the world."""

    world_file: str
    seed: int
    camera: CameraSettings
    actor_paths: tuple[ActorPath, ...]
    people: int
    exposure_changes: bool


class FrameRenderer:
    """Renders frames of one world as its camera sees them; built once in each process."""

    def __init__(self, spec: FrameSpec) -> None:
        self.spec = spec
        cv2.setNumThreads(1)
        world = load_world(Path(spec.world_file))
        self.world = world
        caster = RayCaster.of(world.mesh)
        scene = shading_tables(world.mesh, world.atlas, world.light)
        self.renderer = SceneRenderer(caster, scene)
        self.drive = DrivePath(world.route_m, MotionLimits(), start=lap_start(spec.seed))
        camera = spec.camera
        self.table = ray_table(pixel_rays(camera.width_px, camera.height_px, camera.K, camera.distortion))
        self.sensor = ImageSensor(
            self.table.rays, noise=camera.noise, vignetting=camera.vignetting, quality=camera.jpeg_quality
        )
        self.actor_lighting = None
        if spec.actor_paths:
            actors = build_actors(world, spec.actor_paths, spec.people, spec.seed)
            self.actor_lighting = ActorLighting(actors, caster, scene, world.atlas, world.lights)
        self.gain = self._meter()

    def _meter(self) -> float:
        """Return one exposure gain for the whole drive, measured in small views along it."""
        K = np.array([[60.0, 0, 35.5], [0, 60.0, 26.5], [0, 0, 1]])
        table = ray_table(pixel_rays(72, 54, K))
        times = np.linspace(0.0, self.drive.lap_s, METERING_VIEWS, endpoint=False)
        views = [self.renderer.render(self.camera_pose(t), table).radiance for t in times]
        return METERED_LEVEL / float(np.percentile(np.stack(views).mean(axis=-1), 70))

    def camera_pose(self, time_s: float) -> np.ndarray:
        """Return `T_world_camera` float64 [4, 4] at a time of the lap."""
        return self.drive.transform_at(time_s) @ self.spec.camera.T_body_camera

    def render(self, time_s: float) -> RenderedView:
        """Render the view at a time of the lap, with dynamic objects, before the image sensor."""
        actors = None if self.actor_lighting is None else self.actor_lighting.snapshot(time_s)
        return self.renderer.render(self.camera_pose(time_s), self.table, actors)

    def render_static(self, T_world_camera: np.ndarray, table: RayTable) -> RenderedView:
        """Render the scene without dynamic objects."""
        return self.renderer.render(T_world_camera, table)

    def render_frame(self, time_s: float) -> tuple[bytes, np.ndarray, np.ndarray]:
        """Render a frame at a time of the lap.

        Returns:
            JPEG bytes, depth uint16 [H, W] in millimetres, mask of dynamic objects bool [H, W].
        """
        view = self.render(time_s)
        rng = np.random.default_rng([self.spec.seed, 0x4E, round(time_s * 1e6)])
        gain = self.gain * Faults(exposure_changes=self.spec.exposure_changes).exposure_gain_at(time_s)
        jpeg = self.sensor.jpeg(self.sensor.develop(view.radiance, gain, rng))
        return jpeg, depth_mm(view.depth_z_m), view.moving


def depth_mm(depth_z_m: np.ndarray) -> np.ndarray:
    """Return depth in millimetres, uint16; 0 = no surface, or farther than 65 m."""
    mm = np.nan_to_num(np.rint(depth_z_m * 1000.0), nan=0.0)
    return np.where(mm < 65535, mm, 0).astype(np.uint16)


def lap_start(seed: int) -> float:
    """Return where on the closed route a lap begins, 0..1."""
    return float(np.random.default_rng([seed, 0x53]).random())


def build_actors(world: World, actor_paths: tuple[ActorPath, ...], people: int, seed: int) -> ActorSet:
    """Return the dynamic objects of a recording: `people` persons, then carts, one on each path."""
    return ActorSet.of(list(actor_paths), people, world.texture_size_m, np.random.default_rng([seed, 0x50]))


def frame_path(spec: FrameSpec, time_s: float) -> Path:
    """Return the file of one frame in the cache."""
    settings = [
        Path(spec.world_file).name,  # a hash of the world
        spec.seed,
        spec.camera,
        [repr(w) for w in spec.actor_paths],
        spec.people,
    ]
    name = store.key("shot", *settings, spec.exposure_changes, round(time_s * 1e6))
    return store.cache_root() / "shots" / name[:2] / f"{name}.npz"


def save_frame(path: Path, jpeg: bytes, depth: np.ndarray, moving: np.ndarray) -> None:
    """Write one frame with its ground truth."""
    png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    mask = cv2.imencode(".png", moving.astype(np.uint8) * 255)[1] if moving.any() else np.zeros(0, np.uint8)
    with store.atomic_file(path) as part, open(part, "wb") as out:
        np.savez(out, jpeg=np.frombuffer(jpeg, np.uint8), depth_png=png, mask_png=mask)


@dataclass(frozen=True)
class RenderedFrame:
    """One rendered frame, encoded as uint8 [B] each; the mask is empty if nothing moves."""

    jpeg: np.ndarray
    depth_png: np.ndarray
    mask_png: np.ndarray


def load_frame(path: Path) -> RenderedFrame:
    """Read a frame that `save_frame` wrote."""
    with np.load(path) as data:
        return RenderedFrame(data["jpeg"], data["depth_png"], data["mask_png"])


_worker_renderer: FrameRenderer | None = None


def _start_worker(spec: FrameSpec) -> None:
    global _worker_renderer
    _worker_renderer = FrameRenderer(spec)


def _render_task(task: tuple[float, str]) -> None:
    assert _worker_renderer is not None
    save_frame(Path(task[1]), *_worker_renderer.render_frame(task[0]))


def render_frames(
    spec: FrameSpec, times_s: list[float], jobs: int, progress: Callable[[int, int], None]
) -> list[Path]:
    """Return the files of the frames at all times of the lap.

    Frames that are not cached are rendered by `jobs` processes.
    """
    paths = [frame_path(spec, t) for t in times_s]
    missing = [(t, str(p)) for t, p in zip(times_s, paths) if not p.exists()]
    done = len(paths) - len(missing)
    progress(done, len(paths))
    for _ in _render_missing(spec, missing, jobs):
        done += 1
        progress(done, len(paths))
    return paths


def _render_missing(spec: FrameSpec, tasks: list[tuple[float, str]], jobs: int) -> Iterator[None]:
    if jobs <= 1 or len(tasks) < 8:
        if tasks:
            frame_renderer = FrameRenderer(spec)
            for time_s, path in tasks:
                save_frame(Path(path), *frame_renderer.render_frame(time_s))
                yield
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(jobs, len(tasks)), _start_worker, (spec,)) as pool:
        yield from pool.imap_unordered(_render_task, tasks, chunksize=2)
