"""Runs of SLAM, fusion and mapper with chosen settings on a recording with ground truth."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.services.fusion.inputs import PlaneSweepConfig
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.mapping.settings import MapperSettings

RANGE_NOISE_M = 0.003  # added to the ranges with seeds above 0, where the algorithm itself is not random
# A view shows what was mapped if an image was taken this near, in about this direction.
_VIEW_DISTANCE_M, _VIEW_ANGLE_RAD = 0.7, np.radians(30.0)
_SURFACE_TOLERANCE = 0.02  # relative depth within which a point of the true surface counts as seen

# (settings, seed) -> figures by name
Run = Callable[[Any, int], dict[str, float]]


@dataclass(frozen=True)
class Figure:
    """One metric of a run: its key in the results, its title in the table, and how the table treats it."""

    key: str
    title: str
    quality: bool = True  # False: a cost, which does not count in the order of the table
    timed: bool = False  # varies with the load of the machine


@dataclass(frozen=True)
class Part:
    """SLAM, fusion or mapper: its settings, its metrics, and the function that prepares its runs."""

    settings: Any  # with all defaults
    figures: tuple[Figure, ...]
    seconds: float  # default length of the recording
    open: Callable[[Path, float], Run]
    noise: str  # how the three runs with default settings differ
    note: str = ""  # what a reader of the table must know about the figures


def open_slam(data: Path, seconds: float) -> Run:
    """Return a function that maps the start of a recording with the lidar SLAM and returns metrics by name.

    Its arguments are LidarSlamSettings and a seed of the range noise (0: no noise).

    Args:
        data: folder with bag/ and groundtruth.txt.
        seconds: length of the part of the recording that is used, s.
    """
    from beamsplat.services.localization.lidar2d.offline_mapping import MeasurementLog, map_measurements
    from beamsplat.services.localization.lidar2d.warm import warm
    from beamsplat.services.replay.options import SourceOptions
    from beamsplat.services.replay.source import open_source
    from beamsplat.tools.evaluation.slam import errors_against_truth, measurements

    options = SourceOptions(without=frozenset({"image", "pose"}), require=frozenset({"scan"}))
    source = open_source(data / "bag", options)
    try:
        taken = list(measurements(source))
        lidar = source.rig().lidar
    finally:
        source.close()
    if lidar is None:
        raise UserError(f"{data / 'bag'}: the calibration has no lidar")
    end_ns = min(item[1] for item in taken) + int(seconds * 1e9)
    taken = [item for item in taken if item[1] < end_ns]
    warm()

    def run(settings: LidarSlamSettings, seed: int) -> dict[str, float]:
        rng = np.random.default_rng(seed)
        items = [(*m[:2], _noisy(m[2], rng), *m[3:]) if m[0] == "scan" and seed else m for m in taken]
        with tempfile.TemporaryDirectory() as folder:
            log = MeasurementLog(lidar.T_body_lidar, items, lambda: None)
            done = map_measurements(log, Path(folder), settings=settings)
            errors = errors_against_truth(Path(folder), data / "groundtruth.txt")
        return {
            "ate_first_pose_rmse_m": errors["ate_first_pose_rmse_m"],
            "online_ate_first_pose_rmse_m": errors["online_ate_first_pose_rmse_m"],
            "loop_closures": done["loop_closures"],
            "cpu_s": done["cpu_s"],
        }

    run(LidarSlamSettings(), 0)  # the first run is slower
    return run


def open_fusion(data: Path, seconds: float) -> Run:
    """Return a function that runs depth source and fusion on the start of a recording.

    The function returns metrics by name. Its arguments are PlaneSweepConfig and a seed of the range noise
    (0: no noise).

    Args:
        data: folder with bag/, groundtruth.txt and depth_gt/.
        seconds: length of the part of the recording that is used, s.
    """
    import cv2

    from beamsplat.services.depth.source import make_source
    from beamsplat.services.fusion.warm import warm
    from beamsplat.tools.evaluation.depth_replay import truth_depth_files
    from beamsplat.tools.evaluation.drive import open_drive
    from beamsplat.tools.evaluation.evaluate import DEFAULT, evaluate

    cv2.setNumThreads(1)
    drive, truth = open_drive(data / "bag", data / "groundtruth.txt"), truth_depth_files(data)
    end_ns = drive.images[0].stamp_ns + int(seconds * 1e9)
    drive.images = [image for image in drive.images if image.stamp_ns < end_ns]
    warm()

    def run(settings: PlaneSweepConfig, seed: int) -> dict[str, float]:
        rng, seen = np.random.default_rng(seed), drive
        if seed:
            noisy = [replace(scan, ranges_m=_noisy(scan.ranges_m, rng)) for scan in drive.scans]
            seen = replace(drive, scans=noisy)
        report = evaluate(seen, make_source("stixel", {}), truth, heldout=False, config=settings)
        errors: Any = report[DEFAULT]
        cpu_ms: Any = report["cpu_ms"]
        figures = {key: errors[key] for key in ("absrel", "delta1", "coverage", "dense_within_1sigma")}
        return {**figures, "frames": errors["frames"], "cpu_ms": cpu_ms[DEFAULT]}

    run(PlaneSweepConfig(), 0)  # the first run is slower
    return run


def open_map(data: Path, seconds: float) -> Run:
    """Return a function that maps the start of a recording with one thread; it returns metrics by name.

    Its arguments are MapperSettings and the seed of the mapper. Fused depth of the keyframes is computed only
    once, because the settings of the mapper do not change it.

    The map is scored only at views off the path near the images used, and on the part of the true surface
    that these images show.

    Args:
        data: folder with bag/, groundtruth.txt, depth_gt/, extra_views/ and gt_surface.ply.
        seconds: length of the part of the recording that is used, s.
    """
    import cv2

    from beamsplat.tools.bench.fused_prior import FusedDepthPrior
    from beamsplat.tools.bench.mapping import MapBenchSettings, map_and_score
    from beamsplat.tools.evaluation.dataset import load_dataset

    cv2.setNumThreads(1)
    recording = load_dataset(data)
    end_ns = recording.posed_images[0].stamp_ns + int(seconds * 1e9)
    recording.posed_images = [image for image in recording.posed_images if image.stamp_ns < end_ns]
    T_map_cameras = np.array([image.T_map_camera for image in recording.posed_images])
    recording.offpath_views = [
        view for view in recording.offpath_views if _is_near(view.T_map_camera, T_map_cameras)
    ]
    surface_m = _seen_surface(recording)
    fused, known = FusedDepthPrior("stixel"), {}

    def prior(recording: Any, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        if index not in known:
            known[index] = fused(recording, index)
        return known[index]

    def run(settings: MapperSettings, seed: int) -> dict[str, float]:
        bench = MapBenchSettings(settings=settings, seed=seed, threads=1)
        score, timer = map_and_score(recording, bench, prior, surface_m)
        keys = ("psnr_offpath_db", "depth_l1_offpath_m", "fscore_5cm", "gaussians", "psnr_heldout_db")
        return {**{key: score[key] for key in keys}, "wall_s": timer.wall_s, "cpu_s": timer.cpu_s}

    run(MapperSettings(), 0)  # computes the fused depth and loads the kernels
    return run


def _noisy(ranges_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return (ranges_m + rng.normal(0.0, RANGE_NOISE_M, len(ranges_m))).astype(ranges_m.dtype)


def _is_near(T_map_camera: np.ndarray, T_map_cameras: np.ndarray) -> bool:
    """Return whether one of the camera poses [N, 4, 4] is near `T_map_camera` in position and direction."""
    near = np.linalg.norm(T_map_cameras[:, :3, 3] - T_map_camera[:3, 3], axis=1) < _VIEW_DISTANCE_M
    return bool(np.any(near & (T_map_cameras[:, :3, 2] @ T_map_camera[:3, 2] > np.cos(_VIEW_ANGLE_RAD))))


def _seen_surface(recording: Any) -> np.ndarray:
    """Return the points float64 [N, 3] of the true surface, map frame, that images with true depth show."""
    from beamsplat.common.geometry.transforms import inverse, transform_points
    from beamsplat.common.mapfiles.ply import read_ply_points

    points, camera = read_ply_points(recording.path / "gt_surface.ply"), recording.camera
    seen = np.zeros(len(points), dtype=bool)
    for index, image in enumerate(recording.posed_images):
        depth = recording.true_depth(index)
        if depth is None:
            continue
        x, y, z = transform_points(inverse(image.T_map_camera), points).T
        ahead = np.maximum(z, 1e-3)
        u = np.rint(camera.fx_px * x / ahead + camera.cx_px)
        v = np.rint(camera.fy_px * y / ahead + camera.cy_px)
        inside = (z > 0.1) & (u >= 0) & (v >= 0) & (u < camera.width_px) & (v < camera.height_px)
        at = np.flatnonzero(inside)
        truth = depth[v[at].astype(int), u[at].astype(int)]
        seen[at] |= np.abs(truth - z[at]) <= _SURFACE_TOLERANCE * z[at]
    return points[seen]


_RANGE_NOISE = f"3 runs, in two of them with noise of {1e3 * RANGE_NOISE_M:.0f} mm added to the ranges"
PARTS: dict[str, Part] = {
    "slam": Part(
        LidarSlamSettings(),
        (Figure("ate_first_pose_rmse_m", "ATE optimised (m)"),
         Figure("online_ate_first_pose_rmse_m", "ATE online (m)"),
         Figure("cpu_s", "CPU (s)", quality=False, timed=True)),
        90.0, open_slam, _RANGE_NOISE,
    ),
    "fusion": Part(
        PlaneSweepConfig(),
        (Figure("absrel", "AbsRel"), Figure("delta1", "delta1"), Figure("coverage", "coverage"),
         Figure("dense_within_1sigma", "within 1 sigma"),
         Figure("cpu_ms", "CPU per keyframe (ms)", quality=False, timed=True)),
        16.0, open_fusion, _RANGE_NOISE,
        "AbsRel, delta1 and within 1 sigma are of the pixels that have depth: they improve if fewer "
        "difficult pixels have one, and the coverage falls.",
    ),
    "map": Part(
        MapperSettings(),
        (Figure("psnr_offpath_db", "PSNR off the path (dB)"), Figure("depth_l1_offpath_m", "depth L1 (m)"),
         Figure("fscore_5cm", "F-score at 5 cm"), Figure("gaussians", "Gaussians", quality=False),
         Figure("cpu_s", "CPU (s)", quality=False, timed=True)),
        12.0, open_map, "3 runs with different seeds of the mapper",
        "Parts of the views that these seconds do not show lower the PSNR and raise the depth L1 of all runs "
        "alike. One thread: the CPU seconds are the wall seconds of a machine that does nothing else.",
    ),
}  # fmt: skip
