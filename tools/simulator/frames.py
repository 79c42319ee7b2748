"""Renders all images of a lap in worker processes; every frame is cached under a hash of its inputs.

`time_s` is always the time in seconds since the start of the lap.
"""

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

METERING_VIEWS = 12  # number of views along the lap that set the exposure
METERED_LEVEL = 0.40  # exposure gain times the 70th percentile of the radiance in these views


@dataclass(frozen=True)
class FrameSpec:
    """All inputs that determine the frames of a lap; `world_file` is the cached world."""

    world_file: str
    seed: int
    camera: CameraSettings
    actor_paths: tuple[ActorPath, ...]
    people: int
    exposure_changes: bool


class FrameRenderer:
    """Renders camera frames of one world; each worker process creates one renderer."""

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
        """Return the exposure gain of the whole drive, measured in small rendered views along the path."""
        K = np.array([[60.0, 0, 35.5], [0, 60.0, 26.5], [0, 0, 1]])
        table = ray_table(pixel_rays(72, 54, K))
        times = np.linspace(0.0, self.drive.lap_s, METERING_VIEWS, endpoint=False)
        views = [self.renderer.render(self.camera_pose(t), table).radiance for t in times]
        return METERED_LEVEL / float(np.percentile(np.stack(views).mean(axis=-1), 70))

    def camera_pose(self, time_s: float) -> np.ndarray:
        """Return the true `T_world_camera` float64 [4, 4] at `time_s`."""
        return self.drive.transform_at(time_s) @ self.spec.camera.T_body_camera

    def render(self, time_s: float) -> RenderedView:
        """Render the view at `time_s`, with dynamic objects, before the image sensor."""
        actors = None if self.actor_lighting is None else self.actor_lighting.snapshot(time_s)
        return self.renderer.render(self.camera_pose(time_s), self.table, actors)

    def render_static(self, T_world_camera: np.ndarray, table: RayTable) -> RenderedView:
        """Render the view from `T_world_camera` [4, 4] through the rays of `table`, no dynamic objects."""
        return self.renderer.render(T_world_camera, table)

    def render_frame(self, time_s: float) -> tuple[bytes, np.ndarray, np.ndarray]:
        """Render the camera image at `time_s` and its ground truth.

        Returns:
            The image as JPEG bytes, the depth uint16 [H, W] along optical z in millimetres (0 = no surface),
            and the mask of dynamic objects bool [H, W].
        """
        view = self.render(time_s)
        rng = np.random.default_rng([self.spec.seed, 0x4E, round(time_s * 1e6)])
        gain = self.gain * Faults(exposure_changes=self.spec.exposure_changes).exposure_gain_at(time_s)
        jpeg = self.sensor.jpeg(self.sensor.develop(view.radiance, gain, rng))
        return jpeg, depth_mm(view.depth_z_m), view.moving


def depth_mm(depth_z_m: np.ndarray) -> np.ndarray:
    """Convert depth in metres (NaN = no surface) to uint16 millimetres; 0 = none, or beyond 65 m."""
    mm = np.nan_to_num(np.rint(depth_z_m * 1000.0), nan=0.0)
    return np.where(mm < 65535, mm, 0).astype(np.uint16)


def lap_start(seed: int) -> float:
    """Return the start of a lap as a fraction 0..1 of the closed route, drawn from the seed."""
    return float(np.random.default_rng([seed, 0x53]).random())


def build_actors(world: World, actor_paths: tuple[ActorPath, ...], people: int, seed: int) -> ActorSet:
    """Return the dynamic objects of a recording: persons on the first `people` paths, carts on the others."""
    return ActorSet.of(list(actor_paths), people, world.texture_size_m, np.random.default_rng([seed, 0x50]))


def frame_path(spec: FrameSpec, time_s: float) -> Path:
    """Return the path of the cache file of the frame at `time_s`; the file may not exist."""
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
    """Write image, depth uint16 [H, W] in mm and mask bool [H, W] of dynamic objects to one file."""
    png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    mask = cv2.imencode(".png", moving.astype(np.uint8) * 255)[1] if moving.any() else np.zeros(0, np.uint8)
    with store.atomic_file(path) as part, open(part, "wb") as out:
        np.savez(out, jpeg=np.frombuffer(jpeg, np.uint8), depth_png=png, mask_png=mask)


@dataclass(frozen=True)
class RenderedFrame:
    """One frame: contents of a JPEG and two PNG files, uint8 [B] each; no mask bytes if nothing moves."""

    jpeg: np.ndarray
    depth_png: np.ndarray
    mask_png: np.ndarray


def load_frame(path: Path) -> RenderedFrame:
    """Return a frame, read from a file that `save_frame` wrote."""
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
    """Render the frames at `times_s` that are not in the cache, with `jobs` processes.

    `progress` is called with the number of finished frames and the number of all frames.

    Returns:
        The cache files of all frames, in the order of `times_s`.
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
