"""`bench map`: how good a map the mapper makes of a recording in real time with true poses, and refined."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.mapfiles.ply import read_ply_points, write_gaussian_ply
from beamsplat.common.mapfiles.scores import ViewScore, f_score, fused_surface, render_rgb_depth, score_view
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.keyframe import Keyframe
from beamsplat.services.mapping.mapper import HALF, Mapper
from beamsplat.services.mapping.settings import MapperSettings
from beamsplat.services.mapping.warm import warm
from beamsplat.tools.bench.depth_priors import Prior, find_prior
from beamsplat.tools.evaluation.dataset import Recording, load, read_depth_png

HELD_OUT_EVERY, HELD_OUT_AT = 8, 2  # pictures i with i % 8 == 2 are scored and never shown
Say = Callable[[str], None]


@dataclass(frozen=True)
class MapBench:
    """What to run."""

    prior: str = "stixel"
    distance_m: float = 0.25
    angle_rad: float = 0.22
    settings: MapperSettings = field(default_factory=MapperSettings)
    refine_s: float = 60.0
    count_cpu: bool = (
        False  # refinement is measured in CPU seconds a thread instead of wall: on a machine that is shared
    )
    threads: int = 1
    seed: int = 0
    jump: bool = False  # the second half of the keyframes is misplaced until the drive has ended
    settle_steps: int = 0  # at the end of the drive, at half size, before the first scoring


JUMP = make_transform(so3_exp([0.0, 0.0, np.radians(10.0)]), np.array([1.0, 0.0, 0.0]))
# (recording, number of the picture, its depth_m) -> bool [H, W], False on what moves; None: nothing does
Mask = Callable[[Recording, int, np.ndarray], np.ndarray | None]


@dataclass
class _Clock:
    """Wall and CPU seconds of the mapper alone: without decoding, scoring and compiling."""

    wall_s: float = 0.0
    cpu_s: float = 0.0

    def run(self, work: Callable[[], Any]) -> Any:
        wall, cpu = time.perf_counter(), time.process_time()
        result = work()
        self.wall_s += time.perf_counter() - wall
        self.cpu_s += time.process_time() - cpu
        return result


def raster_camera(camera: Pinhole) -> RasterCamera:
    """The rasterizer's camera of a pinhole."""
    return RasterCamera(
        camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px
    )


def run_bench(
    path: Path,
    bench: MapBench,
    say: Say = lambda text: None,
    out: Path | None = None,
    prior: Prior | None = None,
    mask: Mask | None = None,
) -> dict[str, Any]:
    """Runs the mapper over a recording and gives the figures of the design's section 12.

    `wall_s` and `cpu_s` are the mapper's and the prior's: pictures are decoded, views scored and kernels
    compiled outside. With `out`, pictures of held-out views beside the truth and the map are written there.
    `prior` is used in place of the one that `bench.prior` names; `mask` says what moves.

    With `bench.jump` the pose graph holds the second half of the drive 1 m and 10 degrees off, and finds the
    truth at its end: compare with a run without the jump, both with the same `settle_steps`.
    """
    warm()
    recording = load(path)
    mapper = Mapper(bench.settings, seed=bench.seed, threads=bench.threads)
    clock = _Clock()
    keyframes, refused = _drive(recording, mapper, bench, prior or find_prior(bench.prior), mask, clock, say)
    if bench.jump:
        clock.run(lambda: mapper.move_anchors({1: np.eye(4)}))
    clock.run(lambda: mapper.refine(bench.settle_steps, HALF))
    online_clock, online_steps = replace(clock), mapper.steps
    online = score_map(recording, mapper, say)
    _refine(mapper, bench, clock)
    refined = score_map(recording, mapper, say)
    if out is not None:
        write_pictures(recording, mapper, out)
        write_gaussian_ply(out / "splats.ply", mapper.store.params[:, : mapper.store.count])
    return {
        "data": str(path), "prior": bench.prior, "threads": bench.threads, "seed": bench.seed,
        "keyframes": keyframes, "refused": refused, "data_s": recording.seconds,
        "wall_s": online_clock.wall_s, "cpu_s": online_clock.cpu_s, "steps": online_steps,
        "refine_wall_s": clock.wall_s - online_clock.wall_s, "refine_cpu_s": clock.cpu_s - online_clock.cpu_s,
        "refine_steps": mapper.steps - online_steps, "online": online, "refined": refined,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }  # fmt: skip


def _drive(
    recording: Recording, mapper: Mapper, bench: MapBench, prior: Prior, mask: Mask | None, clock: _Clock,
    say: Say,
) -> tuple[int, int]:  # fmt: skip
    """Every keyframe with its fixed work, as they come; gives how many were used and refused."""
    used, refused, last = 0, 0, None
    for index, shot in enumerate(recording.shots):
        if index % HELD_OUT_EVERY == HELD_OUT_AT or not _moved(last, shot.T_map_camera, bench):
            continue
        guess = clock.run(lambda i=index: prior(recording, i))
        if guess is None:
            continue
        last = shot.T_map_camera
        late = 2 * index >= len(recording.shots)
        frame = replace(
            make_keyframe(recording, index, guess), anchor=int(late),
            mask=None if mask is None else clock.run(lambda i=index, d=guess[0]: mask(recording, i, d)),
        )  # fmt: skip
        place = JUMP if late and bench.jump else np.eye(4)
        outcome = clock.run(lambda f=frame, T=place: mapper.add(f, T))
        clock.run(mapper.optimise)
        used, refused = used + outcome.ok, refused + (not outcome.ok)
        if used % 10 == 0:
            say(f"{used} keyframes, {mapper.store.count} Gaussians, {clock.cpu_s:.0f} CPU s")
    return used, refused


def _refine(mapper: Mapper, bench: MapBench, clock: _Clock) -> None:
    start = replace(clock)
    while True:
        cpu_s = (clock.cpu_s - start.cpu_s) / bench.threads
        spent = cpu_s if bench.count_cpu else clock.wall_s - start.wall_s
        if spent >= bench.refine_s or not mapper.keyframes:
            return
        clock.run(lambda: mapper.refine(20))


def write_pictures(recording: Recording, mapper: Mapper, out: Path) -> None:
    """Truth beside render of every eighth held-out view: `offpath_NNN.png`, `heldout_NNN.png`."""
    out.mkdir(parents=True, exist_ok=True)
    camera = raster_camera(recording.camera)

    def write(name: str, T_map_camera: np.ndarray, truth: np.ndarray) -> None:
        rgb, _, _ = render_rgb_depth(mapper.rasterizer, mapper.store, camera, T_map_camera)
        both = np.hstack([truth, (rgb * 255.0 + 0.5).astype(np.uint8)])
        cv2.imwrite(str(out / name), cv2.cvtColor(both, cv2.COLOR_RGB2BGR))

    for i, view in enumerate(recording.extra_views[::8]):
        truth = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
        write(f"offpath_{8 * i:03d}.png", view.T_map_camera, truth)
    for index in range(HELD_OUT_AT, len(recording.shots), 16 * HELD_OUT_EVERY):
        write(f"heldout_{index:03d}.png", recording.shots[index].T_map_camera, recording.image(index))


def _moved(last: np.ndarray | None, T_map_camera: np.ndarray, bench: MapBench) -> bool:
    if last is None:
        return True
    cos = (np.trace(last[:3, :3].T @ T_map_camera[:3, :3]) - 1.0) / 2.0
    far = np.linalg.norm(last[:3, 3] - T_map_camera[:3, 3]) >= bench.distance_m
    return bool(far or np.arccos(np.clip(cos, -1.0, 1.0)) >= bench.angle_rad)


def make_keyframe(recording: Recording, index: int, guess: tuple[np.ndarray, np.ndarray]) -> Keyframe:
    """A keyframe bound to one anchor at the map's origin, with the beams of the moment."""
    shot = recording.shots[index]
    uv, z, _ = project_beams(shot.beams, recording.camera, recording.T_body_camera)
    return Keyframe(
        id=index, rgb=recording.image(index), camera=raster_camera(recording.camera),
        T_anchor_camera=shot.T_map_camera, depth_m=guess[0], sigma_m=guess[1],
        beams_uvz=np.column_stack([uv, z]) if len(z) else np.zeros((0, 3)),
    )  # fmt: skip


def score_map(recording: Recording, mapper: Mapper, say: Say) -> dict[str, float | None]:
    """Figures at the views that the mapper has not seen; None where the recording has no such views."""
    say("scoring")
    camera = raster_camera(recording.camera)
    off, held = [], []
    for view in recording.extra_views:
        true_rgb = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
        rgb, depth, _ = render_rgb_depth(mapper.rasterizer, mapper.store, camera, view.T_map_camera)
        off.append(score_view(rgb, depth, true_rgb, read_depth_png(view.depth_file)))
    for index in range(HELD_OUT_AT, len(recording.shots), HELD_OUT_EVERY):
        rgb, depth, _ = render_rgb_depth(
            mapper.rasterizer, mapper.store, camera, recording.shots[index].T_map_camera
        )
        held.append(score_view(rgb, depth, recording.image(index), None))
    figures = {
        "psnr_offpath_db": _mean(off, "psnr_db"), "ssim_offpath": _mean(off, "ssim"),
        "depth_l1_offpath_m": _mean(off, "depth_l1_m"), "psnr_heldout_db": _mean(held, "psnr_db"),
        "ssim_heldout": _mean(held, "ssim"), "gaussians": mapper.store.count,
    }  # fmt: skip
    surface = recording.path / "gt_surface.ply"
    if surface.is_file():
        half = camera.resized(camera.width_px // 2, camera.height_px // 2)
        views = [(half, mapper.T_map_camera(held)) for held in mapper.keyframes.values()]
        figures |= f_score(fused_surface(mapper.rasterizer, mapper.store, views), read_ply_points(surface))
    return figures


def _mean(scores: list[ViewScore], name: str) -> float | None:
    return float(np.mean([getattr(score, name) for score in scores])) if scores else None
