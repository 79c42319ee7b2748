"""Rendering all images of a lap, in worker processes, each picture kept in the cache under its own hash."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.tools.simulator import store
from beamsplat.tools.simulator.camera import Sensor, pixel_rays
from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.movers import Cast, Stage, Walk
from beamsplat.tools.simulator.path import Drive, Limits
from beamsplat.tools.simulator.render import Picture, RayTable, Renderer, ray_table
from beamsplat.tools.simulator.settings import CameraSettings, Faults
from beamsplat.tools.simulator.shade import surfaces
from beamsplat.tools.simulator.world import World, load_world

METERING_VIEWS = 12
METERED = 0.40  # exposed value of the 70th percentile of the drive's light


@dataclass(frozen=True)
class Shoot:
    """What the pictures of a lap depend on, besides the world."""

    world_file: str
    seed: int
    camera: CameraSettings
    walks: tuple[Walk, ...]
    people: int
    exposure_changes: bool


class Studio:
    """A world with a camera in it; built once in each process."""

    def __init__(self, shoot: Shoot) -> None:
        self.shoot = shoot
        cv2.setNumThreads(1)
        world = load_world(Path(shoot.world_file))
        self.world = world
        caster = Caster.of(world.mesh)
        scene = surfaces(world.mesh, world.atlas, world.light)
        self.renderer = Renderer(caster, scene)
        self.drive = Drive(world.route_m, Limits(), start=start_of(shoot.seed))
        camera = shoot.camera
        self.table = ray_table(pixel_rays(camera.width_px, camera.height_px, camera.K, camera.distortion))
        self.sensor = Sensor(
            self.table.rays, noise=camera.noise, vignetting=camera.vignetting, quality=camera.jpeg_quality
        )
        self.stage = None
        if shoot.walks:
            cast = build_cast(world, shoot.walks, shoot.people, shoot.seed)
            self.stage = Stage(cast, caster, scene, world.atlas, world.lights)
        self.gain = self._meter()

    def _meter(self) -> float:
        """One exposure for the whole drive, from what small pictures along it see."""
        K = np.array([[60.0, 0, 35.5], [0, 60.0, 26.5], [0, 0, 1]])
        table = ray_table(pixel_rays(72, 54, K))
        times = np.linspace(0.0, self.drive.lap_s, METERING_VIEWS, endpoint=False)
        views = [self.renderer.picture(self.pose(t), table).radiance for t in times]
        return METERED / float(np.percentile(np.stack(views).mean(axis=-1), 70))

    def pose(self, time_s: float) -> np.ndarray:
        """`T_world_camera` [4, 4] at a time of the lap."""
        return self.drive.transform_at(time_s) @ self.shoot.camera.T_body_camera

    def picture(self, time_s: float) -> Picture:
        actors = None if self.stage is None else self.stage.actors_at(time_s)
        return self.renderer.picture(self.pose(time_s), self.table, actors)

    def still(self, T_world_camera: np.ndarray, table: RayTable) -> Picture:
        """A view of the scene without movers."""
        return self.renderer.picture(T_world_camera, table)

    def shot(self, time_s: float) -> tuple[bytes, np.ndarray, np.ndarray]:
        """JPEG, depth in mm uint16 [H, W], moving bool [H, W] at a time of the lap."""
        picture = self.picture(time_s)
        rng = np.random.default_rng([self.shoot.seed, 0x4E, round(time_s * 1e6)])
        gain = self.gain * Faults(exposure_changes=self.shoot.exposure_changes).gain_at(time_s)
        jpeg = self.sensor.jpeg(self.sensor.develop(picture.radiance, gain, rng))
        return jpeg, depth_mm(picture.depth_z_m), picture.moving


def depth_mm(depth_z_m: np.ndarray) -> np.ndarray:
    """uint16 millimetres, 0 = nothing or beyond 65 m."""
    mm = np.nan_to_num(np.rint(depth_z_m * 1000.0), nan=0.0)
    return np.where(mm < 65535, mm, 0).astype(np.uint16)


def start_of(seed: int) -> float:
    """Where on the loop a lap begins."""
    return float(np.random.default_rng([seed, 0x53]).random())


def build_cast(world: World, walks: tuple[Walk, ...], people: int, seed: int) -> Cast:
    """The movers of a recording."""
    return Cast.of(list(walks), people, world.texture_size_m, np.random.default_rng([seed, 0x50]))


def shot_path(shoot: Shoot, time_s: float) -> Path:
    """Where the cache keeps one picture; the world's file is named by its own hash."""
    settings = [
        Path(shoot.world_file).name,
        shoot.seed,
        shoot.camera,
        [repr(w) for w in shoot.walks],
        shoot.people,
    ]
    name = store.key("shot", *settings, shoot.exposure_changes, round(time_s * 1e6))
    return store.cache_root() / "shots" / name[:2] / f"{name}.npz"


def save_shot(path: Path, jpeg: bytes, depth: np.ndarray, moving: np.ndarray) -> None:
    """One picture with its truth."""
    png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    mask = cv2.imencode(".png", moving.astype(np.uint8) * 255)[1] if moving.any() else np.zeros(0, np.uint8)
    with store.whole_file(path) as part, open(part, "wb") as out:
        np.savez(out, jpeg=np.frombuffer(jpeg, np.uint8), depth_png=png, mask_png=mask)


@dataclass(frozen=True)
class Shot:
    """One finished picture: encoded bytes; an empty mask means nothing moves in it."""

    jpeg: np.ndarray
    depth_png: np.ndarray
    mask_png: np.ndarray


def load_shot(path: Path) -> Shot:
    with np.load(path) as data:
        return Shot(data["jpeg"], data["depth_png"], data["mask_png"])


_studio: Studio | None = None


def _start_worker(shoot: Shoot) -> None:
    global _studio
    _studio = Studio(shoot)


def _render(task: tuple[float, str]) -> None:
    assert _studio is not None
    save_shot(Path(task[1]), *_studio.shot(task[0]))


def render_all(
    shoot: Shoot, times_s: list[float], jobs: int, progress: Callable[[int, int], None]
) -> list[Path]:
    """Files of the pictures at all times (of the lap); those not cached are rendered by `jobs` processes."""
    paths = [shot_path(shoot, t) for t in times_s]
    missing = [(t, str(p)) for t, p in zip(times_s, paths) if not p.exists()]
    done = len(paths) - len(missing)
    progress(done, len(paths))
    for _ in _map(shoot, missing, jobs):
        done += 1
        progress(done, len(paths))
    return paths


def _map(shoot: Shoot, tasks: list[tuple[float, str]], jobs: int) -> Iterator[None]:
    if jobs <= 1 or len(tasks) < 8:
        if tasks:
            studio = Studio(shoot)
            for time_s, path in tasks:
                yield save_shot(Path(path), *studio.shot(time_s))
        return
    context = multiprocessing.get_context("spawn")
    with context.Pool(min(jobs, len(tasks)), _start_worker, (shoot,)) as pool:
        yield from pool.imap_unordered(_render, tasks, chunksize=2)
