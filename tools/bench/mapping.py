"""`bench map`: quality of the map of a recording with true poses, built in real time and after refinement."""

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
from beamsplat.common.mapfiles.scores import ViewScore, f_score, fused_surface, rgb_depth_alpha, score_view
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.engines.protocol import Engine
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.mapper import HALF, Mapper
from beamsplat.services.mapping.settings import MapperSettings
from beamsplat.services.mapping.warm import warm
from beamsplat.tools.bench.depth_priors import Prior, find_prior
from beamsplat.tools.evaluation.dataset import TruthDataset, load_dataset, read_depth_png

HELD_OUT_EVERY, HELD_OUT_AT = 8, 2  # images i with i % 8 == 2 are scored and never mapped
Log = Callable[[str], None]


@dataclass(frozen=True)
class MapBenchSettings:
    """Settings of one run of `bench map`."""

    prior: str = "stixel"
    distance_m: float = 0.25
    angle_rad: float = 0.22
    settings: MapperSettings = field(default_factory=MapperSettings)
    refine_s: float = 60.0
    count_cpu: bool = False  # refine_s are CPU seconds per thread instead of wall time: for shared machines
    threads: int = 1
    seed: int = 0
    jump: bool = False  # misplace the second half of the keyframes until the end of the drive
    settle_steps: int = 0  # steps at half image size at the end of the drive, before the first scoring


T_MAP_ANCHOR_JUMP = make_transform(so3_exp([0.0, 0.0, np.radians(10.0)]), np.array([1.0, 0.0, 0.0]))
# (recording, index of the image, its depth_m) -> bool [H, W], False on dynamic objects; None without any
Mask = Callable[[TruthDataset, int, np.ndarray], np.ndarray | None]


@dataclass
class MapperTimer:
    """Accumulated wall and CPU time in s of the calls that are made through `run`.

    These are calls of the mapper, the depth prior and the masks, not decoding, scoring and compilation.
    """

    wall_s: float = 0.0
    cpu_s: float = 0.0
    mapper_wall_s: float = 0.0  # of the mapper alone

    def run(self, work: Callable[[], Any], *, of_mapper: bool = True) -> Any:
        """Call `work`, add its wall and CPU time to the sums, and return its result."""
        wall, cpu = time.perf_counter(), time.process_time()
        result = work()
        spent_s = time.perf_counter() - wall
        self.wall_s += spent_s
        self.mapper_wall_s += spent_s * of_mapper
        self.cpu_s += time.process_time() - cpu
        return result


def raster_camera(camera: Pinhole) -> RasterCamera:
    """Return the rasterizer's camera type with the intrinsics of a pinhole camera, without distortion."""
    return RasterCamera(
        camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px
    )


def run_bench(
    path: Path,
    bench: MapBenchSettings,
    log: Log = lambda text: None,
    out: Path | None = None,
    prior: Prior | None = None,
    mask: Mask | None = None,
    engine: Engine | None = None,
) -> dict[str, Any]:
    """Map a recording and score the map before and after refinement; return the results by name.

    `wall_s` and `cpu_s` are the time of the mapper and the depth prior until the end of the drive; decoding,
    scoring and compilation are not counted.

    With `bench.jump`, the anchor of the second half of the drive is misplaced by 1 m and 10 degrees until the
    end of the drive, as before a loop closure. Compare the result with a run without `jump` that has the same
    `settle_steps`.

    Args:
        path: folder of the recording, see `load_dataset`.
        log: receives progress messages.
        out: folder for the map and for renders of held-out views beside true images; None writes nothing.
        prior: depth prior of the keyframes; None uses the one called `bench.prior`.
        mask: computes the masks of dynamic objects; None maps all pixels.
        engine: of the mapper; None = the CPU, with `bench.threads`.
    """
    warm()
    recording = load_dataset(path)
    mapper = Mapper(bench.settings, seed=bench.seed, threads=bench.threads, engine=engine)
    timer = MapperTimer()
    keyframes, refused = _map_drive(
        recording, mapper, bench, prior or find_prior(bench.prior), mask, timer, log
    )
    if bench.jump:
        timer.run(lambda: mapper.move_anchors({1: np.eye(4)}))
    timer.run(lambda: mapper.refine(bench.settle_steps, HALF))
    online_timer, online_steps = replace(timer), mapper.steps
    online = score_map(recording, mapper, log)
    _refine(mapper, bench, timer)
    refined = score_map(recording, mapper, log)
    if out is not None:
        write_comparison_images(recording, mapper, out)
        write_gaussian_ply(out / "splats.ply", mapper.store.with_harmonics())
    return {
        "data": str(path), "prior": bench.prior, "threads": bench.threads, "seed": bench.seed,
        "keyframes": keyframes, "refused": refused, "data_s": recording.seconds,
        "wall_s": online_timer.wall_s, "cpu_s": online_timer.cpu_s, "steps": online_steps,
        "mapper_wall_s": online_timer.mapper_wall_s, "images": len(recording.posed_images),
        "refine_wall_s": timer.wall_s - online_timer.wall_s, "refine_cpu_s": timer.cpu_s - online_timer.cpu_s,
        "refine_steps": mapper.steps - online_steps, "online": online, "refined": refined,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }  # fmt: skip


def map_and_score(
    recording: TruthDataset, bench: MapBenchSettings, prior: Prior, true_surface_m: np.ndarray | None = None,
    *, surface: bool = True,
) -> tuple[dict[str, float | None], MapperTimer]:  # fmt: skip
    """Map a recording without refinement; return the scores of the map by name, and the computing time.

    Args:
        true_surface_m: points of the true surface in the map frame, float64 [N, 3]; None reads gt_surface.ply
            of the recording.
        surface: also compute the F-score of the surface.
    """
    mapper, timer = Mapper(bench.settings, seed=bench.seed, threads=bench.threads), MapperTimer()
    _map_drive(recording, mapper, bench, prior, None, timer, lambda text: None)
    return score_map(recording, mapper, lambda text: None, true_surface_m, surface=surface), timer


def _map_drive(
    recording: TruthDataset, mapper: Mapper, bench: MapBenchSettings, prior: Prior, mask: Mask | None,
    timer: MapperTimer, log: Log,
) -> tuple[int, int]:  # fmt: skip
    """Insert the keyframes in order of time, each followed by a fixed number of optimisation steps.

    Returns:
        The number of keyframes that the mapper has used, and the number that it has rejected.
    """
    used, refused, last = 0, 0, None
    for index, posed_image in enumerate(recording.posed_images):
        if index % HELD_OUT_EVERY == HELD_OUT_AT or not _moved(last, posed_image.T_map_camera, bench):
            continue
        prior_depth = timer.run(lambda i=index: prior(recording, i), of_mapper=False)
        if prior_depth is None:
            continue
        last = posed_image.T_map_camera
        late = 2 * index >= len(recording.posed_images)
        frame = replace(
            make_keyframe(recording, index, prior_depth), anchor=int(late),
            mask=None if mask is None else timer.run(
                lambda i=index, d=prior_depth[0]: mask(recording, i, d), of_mapper=False
            ),
        )  # fmt: skip
        T_map_anchor = T_MAP_ANCHOR_JUMP if late and bench.jump else np.eye(4)
        outcome = timer.run(lambda f=frame, T=T_map_anchor: mapper.add(f, T))
        timer.run(mapper.optimise)
        used, refused = used + outcome.ok, refused + (not outcome.ok)
        if used % 10 == 0:
            log(f"{used} keyframes, {mapper.store.count} Gaussians, {timer.cpu_s:.0f} CPU s")
    return used, refused


def _refine(mapper: Mapper, bench: MapBenchSettings, timer: MapperTimer) -> None:
    start = replace(timer)
    while True:
        cpu_s = (timer.cpu_s - start.cpu_s) / bench.threads
        spent = cpu_s if bench.count_cpu else timer.wall_s - start.wall_s
        if spent >= bench.refine_s or not mapper.keyframes:
            return
        timer.run(lambda: mapper.refine(20))


def write_comparison_images(recording: TruthDataset, mapper: Mapper, out: Path) -> None:
    """Write some held-out views as PNG files: the true image on the left, the render of the map on the right.

    `offpath_NNN.png` are views off the path, `heldout_NNN.png` are images of the drive that were not mapped.
    """
    out.mkdir(parents=True, exist_ok=True)
    camera = raster_camera(recording.camera)

    def write(name: str, T_map_camera: np.ndarray, truth: np.ndarray) -> None:
        rgb, _, _ = rgb_depth_alpha(mapper.render(camera, T_map_camera))
        both = np.hstack([truth, (rgb * 255.0 + 0.5).astype(np.uint8)])
        cv2.imwrite(str(out / name), cv2.cvtColor(both, cv2.COLOR_RGB2BGR))

    for i, view in enumerate(recording.offpath_views[::8]):
        truth = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
        write(f"offpath_{8 * i:03d}.png", view.T_map_camera, truth)
    for index in range(HELD_OUT_AT, len(recording.posed_images), 16 * HELD_OUT_EVERY):
        write(f"heldout_{index:03d}.png", recording.posed_images[index].T_map_camera, recording.image(index))


def _moved(last: np.ndarray | None, T_map_camera: np.ndarray, bench: MapBenchSettings) -> bool:
    if last is None:
        return True
    cos = (np.trace(last[:3, :3].T @ T_map_camera[:3, :3]) - 1.0) / 2.0
    far = np.linalg.norm(last[:3, 3] - T_map_camera[:3, 3]) >= bench.distance_m
    return bool(far or np.arccos(np.clip(cos, -1.0, 1.0)) >= bench.angle_rad)


def make_keyframe(
    recording: TruthDataset, index: int, prior_depth: tuple[np.ndarray, np.ndarray]
) -> RgbdKeyframe:
    """Return image `index` of a recording as a keyframe, with its depth and the beams at its time.

    The frame of its anchor is the map frame. `prior_depth` is (depth_m, sigma_m), both float32 [H, W].
    """
    posed_image = recording.posed_images[index]
    uv, z, _ = project_beams(posed_image.beams, recording.camera, recording.T_body_camera)
    return RgbdKeyframe(
        id=index, rgb=recording.image(index), camera=raster_camera(recording.camera),
        T_anchor_camera=posed_image.T_map_camera, depth_m=prior_depth[0], sigma_m=prior_depth[1],
        beams_uvz=np.column_stack([uv, z]) if len(z) else np.zeros((0, 3)),
    )  # fmt: skip


def score_map(
    recording: TruthDataset, mapper: Mapper, log: Log, true_surface_m: np.ndarray | None = None,
    *, surface: bool = True,
) -> dict[str, float | None]:  # fmt: skip
    """Return the scores of the map at held-out views by name: PSNR, SSIM, depth error, F-score, map size.

    A score is None if the recording has no views for it.

    Args:
        true_surface_m: points of the true surface in the map frame, float64 [N, 3]; None reads gt_surface.ply
            of the recording. If that file is missing too, there is no F-score.
        surface: False leaves the F-score out.
    """
    log("scoring")
    camera = raster_camera(recording.camera)
    off, held = [], []
    for view in recording.offpath_views:
        true_rgb = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
        rgb, depth, _ = rgb_depth_alpha(mapper.render(camera, view.T_map_camera))
        off.append(score_view(rgb, depth, true_rgb, read_depth_png(view.depth_file)))
    for index in range(HELD_OUT_AT, len(recording.posed_images), HELD_OUT_EVERY):
        T_map_camera = recording.posed_images[index].T_map_camera
        rgb, depth, _ = rgb_depth_alpha(mapper.render(camera, T_map_camera))
        held.append(score_view(rgb, depth, recording.image(index), None))
    figures = {
        "psnr_offpath_db": _mean(off, "psnr_db"), "ssim_offpath": _mean(off, "ssim"),
        "depth_l1_offpath_m": _mean(off, "depth_l1_m"), "psnr_heldout_db": _mean(held, "psnr_db"),
        "ssim_heldout": _mean(held, "ssim"), "gaussians": mapper.store.count,
    }  # fmt: skip
    surface_file = recording.path / "gt_surface.ply"
    if surface and true_surface_m is None and surface_file.is_file():
        true_surface_m = read_ply_points(surface_file)
    if surface and true_surface_m is not None:
        half = camera.resized(camera.width_px // 2, camera.height_px // 2)
        views = [(half, mapper.T_map_camera(held)) for held in mapper.keyframes.values()]
        points_m = fused_surface(lambda c, T: rgb_depth_alpha(mapper.render(c, T)), views)
        figures |= f_score(points_m, true_surface_m)
    return figures


def _mean(scores: list[ViewScore], name: str) -> float | None:
    return float(np.mean([getattr(score, name) for score in scores])) if scores else None
