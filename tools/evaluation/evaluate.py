"""Evaluates depth along a drive against dense true depth and against held-out beams."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.depth.recorded import read_depth
from beamsplat.services.depth.source import DepthInput, DepthSource, Estimate
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput, PlaneSweepConfig
from beamsplat.services.fusion.result import FusionResult, rejected
from beamsplat.services.fusion.scaling import affine, ratio
from beamsplat.tools.evaluation.drive import RecordedDrive
from beamsplat.tools.evaluation.metrics import (
    MethodErrors,
    confirmed_by_truth,
    every_third,
    every_third_block,
)

DEFAULT = "field"
KEYFRAME_M, KEYFRAME_RAD = 0.3, np.radians(15.0)  # motion between keyframes


@dataclass(frozen=True)
class DepthComparison:
    """Depth of one image by every method, its true depth, and the CPU time of each method."""

    stamp_ns: int
    image_rgb: np.ndarray  # uint8 [H, W, 3], undistorted
    estimate: Estimate
    methods: dict[str, FusionResult]
    truth: np.ndarray  # float32 [H, W], NaN = none
    seconds: dict[str, float]  # CPU time by method, and of the source


def truth_depth_files(folder: Path) -> dict[int, Path]:
    """Return the files `<stamp_ns>.png` of true depth in a folder, or in its subfolder depth_gt/, by stamp.

    Raises:
        UserError: the folder contains no files with such a name.
    """
    folder = Path(folder)
    if (folder / "depth_gt").is_dir():
        folder = folder / "depth_gt"
    files = {int(p.stem): p for p in sorted(folder.glob("*.png")) if p.stem.isdigit()}
    if not files:
        raise UserError(f"{folder} holds no truth: expected <stamp_ns>.png, 16 bit millimetres of optical z")
    return files


def replay_depth(
    drive: RecordedDrive,
    source: DepthSource,
    wanted: dict[int, Path | None],
    heldout_mask: Callable[[int], np.ndarray] | None = None,
    config: PlaneSweepConfig | None = None,
    floor: bool | None = None,
    refuse: Callable[[str], None] | None = None,
) -> Iterator[DepthComparison]:
    """Run depth estimation and fusion over a drive in order of time; yield the results of the wanted images.

    An image is processed without later data, except the scan during which it was taken. Wanted images are
    processed as keyframes (method `field`). Method `field_carried` is the depth of the same image if it were
    not a keyframe: then only earlier keyframes contribute.

    Args:
        wanted: stamps of the wanted images, each with the file of its true depth, or None.
        heldout_mask: returns bool [beams] for a number of beams; True beams are held out. None: no beams are.
        config: settings of fusion; None uses the defaults.
        floor: whether the camera's height above the floor is known; None: if the poses are planar.
        refuse: receives the reason for each image that cannot be decoded; None: it is an error.

    Raises:
        UserError: an image cannot be decoded, and `refuse` is None.
    """
    planar = drive.planar
    known = planar if floor is None else floor
    fusion = Fusion(
        drive.undistort.pinhole, drive.T_body_camera, floor_known=known, planar=planar, config=config
    )
    next_scan = 0
    last_keyframe: np.ndarray | None = None
    for number, image in enumerate(drive.images):
        stamp = image.stamp_ns
        T_map_body = drive.pose(stamp)
        if T_map_body is None:
            continue
        while next_scan < len(drive.scans) and drive.scans[next_scan].last_ns <= stamp:
            due = drive.scans[next_scan]
            fusion.add_scan(
                drive.scan_in_map(due, None if heldout_mask is None else heldout_mask(len(due.ranges_m)))
            )
            next_scan += 1
        try:
            rgb = drive.rgb(number)
        except UserError as error:
            if refuse is None:
                raise
            refuse(str(error))
            continue
        scan = drive.scan_near(stamp)
        excluded_beams = None if heldout_mask is None or scan is None else heldout_mask(len(scan.ranges_m))
        beams = drive.beams_at(stamp, excluded_beams)
        is_keyframe = last_keyframe is None or _moved(last_keyframe, T_map_body)
        if stamp not in wanted and not is_keyframe:
            fusion.look(rgb, T_map_body)
            continue
        started = time.process_time()
        view = DepthInput(stamp, rgb, drive.undistort.pinhole, drive.T_body_camera, beams, known)
        estimate = source.estimate(view)
        seconds = {"source": time.process_time() - started}
        prediction = estimate.values if estimate.ok and estimate.kind != "none" else None
        frame = FusionInput(stamp, rgb, T_map_body, beams, prediction, estimate.kind)
        methods: dict[str, FusionResult] = {}
        for name in ("field_carried", "field"):
            if name == "field_carried" and stamp not in wanted:
                continue
            started = time.process_time()
            methods[name] = fusion.fuse(frame, keyframe=name == "field")
            seconds[name] = time.process_time() - started
        last_keyframe = T_map_body
        if stamp not in wanted:
            continue
        path = wanted[stamp]
        truth = np.full(rgb.shape[:2], np.nan, np.float32) if path is None else read_depth(path)
        uv, z, _ = project_beams(beams, drive.undistort.pinhole, drive.T_body_camera)
        for name, correct in (("ratio", ratio), ("affine", affine)):
            started = time.process_time()
            done = correct(prediction, estimate.kind, uv, z) if prediction is not None else None
            methods[name] = done or rejected(rgb.shape[:2], estimate.status)
            seconds[name] = time.process_time() - started
        yield DepthComparison(stamp, rgb, estimate, methods, truth, seconds)


def _moved(T_before: np.ndarray, T_now: np.ndarray) -> bool:
    T = inverse(T_before) @ T_now
    turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return bool(np.linalg.norm(T[:3, 3]) > KEYFRAME_M or turn > KEYFRAME_RAD)


def evaluate(
    drive: RecordedDrive,
    source: DepthSource,
    truth: dict[int, Path],
    *,
    heldout: bool = True,
    config: PlaneSweepConfig | None = None,
    floor: bool | None = None,
    progress: Callable[[str, int, int], None] = lambda run, done, total: None,
) -> dict[str, object]:
    """Evaluate the depth of a drive; return the JSON report of `beamsplat eval depth`.

    The report contains one object of metrics per method, and the name of the `default` method.

    Args:
        truth: files of the true depth, by stamp of the image.
        heldout: also process the drive with every third beam, and with every third block of beams, held out.
        config: settings of fusion; None uses the defaults.
        floor: whether the camera's height above the floor is known; None: if the poses are planar.
        progress: receives the name of the pass over the drive, the number of finished and of all images.

    Raises:
        UserError: no image of the drive has a true depth.
    """
    stamps = {image.stamp_ns for image in drive.images}
    wanted: dict[int, Path | None] = {s: p for s, p in truth.items() if s in stamps}
    if not wanted:
        raise UserError(f"{drive.path}: no image has the stamp of a truth file")
    errors: dict[str, MethodErrors] = {}
    excluded: dict[str, float] = {}
    seconds: dict[str, list[float]] = {}
    for run in ("dense", "third", "blocks") if heldout else ("dense",):
        heldout_mask = _heldout_selector(run, drive)
        total, unconfirmed = 0, 0
        for count, outcome in enumerate(replay_depth(drive, source, wanted, heldout_mask, config, floor)):
            progress(run, count + 1, len(wanted))
            results = dict(outcome.methods)
            if outcome.estimate.kind == "metric":
                raw = outcome.estimate.values
                results = {"raw": FusionResult(raw, np.full_like(raw, np.nan)), **results}
            if run == "dense":
                _add_dense(errors, results, outcome, drive, seconds)
                continue
            uv, z = _heldout_beams(drive, outcome.stamp_ns, heldout_mask)
            good = confirmed_by_truth(outcome.truth, uv, z)
            total, unconfirmed = total + len(z), unconfirmed + int((~good).sum())
            for name, result in results.items():
                sigma = None if name == "raw" else result.sigma_m
                errors[name].add_held(run, result.depth_m, sigma, uv[good], z[good])
        if run != "dense":
            excluded[run] = unconfirmed / max(total, 1)
    report: dict[str, object] = {name: e.summary(excluded) for name, e in errors.items()}
    report["default"] = DEFAULT
    report["cpu_ms"] = {name: 1e3 * float(np.median(values)) for name, values in seconds.items()}
    report["poses"] = drive.poses_name
    report["floor_known"] = drive.planar if floor is None else floor
    return report


def _add_dense(
    errors: dict[str, MethodErrors], results: dict[str, FusionResult], outcome: DepthComparison,
    drive: RecordedDrive, seconds: dict[str, list[float]],
) -> None:  # fmt: skip
    uv, z, _ = project_beams(drive.beams_at(outcome.stamp_ns), drive.undistort.pinhole, drive.T_body_camera)
    for name, result in results.items():
        e = errors.setdefault(name, MethodErrors())
        e.add_dense(result.depth_m, None if name == "raw" else result.sigma_m, outcome.truth)
        e.add_beams(result.depth_m, uv, z)
    for name, value in outcome.seconds.items():
        seconds.setdefault(name, []).append(value)


def _heldout_selector(run: str, drive: RecordedDrive) -> Callable[[int], np.ndarray] | None:
    if run == "dense":
        return None
    if run == "third":
        return every_third
    increment = drive.scans[0].angle_increment_rad if drive.scans else np.radians(0.5)
    return lambda count: every_third_block(count, increment)


def _heldout_beams(
    drive: RecordedDrive, stamp_ns: int, heldout_mask: Callable[[int], np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels uv [N, 2] and optical z [N] in m of the held-out beams at the time of an image."""
    scan = drive.scan_near(stamp_ns)
    if scan is None or heldout_mask is None:
        return np.zeros((0, 2)), np.zeros(0)
    beams = drive.beams_at(stamp_ns, ~heldout_mask(len(scan.ranges_m)))
    uv, z, _ = project_beams(beams, drive.undistort.pinhole, drive.T_body_camera)
    return uv, z
