"""Evaluates depth along a drive against dense true depth and against held-out beams."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import project_beams
from beamsplat.services.depth.source import DepthSource
from beamsplat.services.fusion.aggregation import Aggregation
from beamsplat.services.fusion.inputs import PlaneSweepConfig
from beamsplat.services.fusion.result import FusionResult
from beamsplat.tools.evaluation.depth_breakdown import DepthBreakdown, PairedErrors, breakdown_report
from beamsplat.tools.evaluation.depth_replay import DepthComparison, replay_depth
from beamsplat.tools.evaluation.drive import RecordedDrive
from beamsplat.tools.evaluation.metrics import (
    MethodErrors,
    confirmed_by_truth,
    every_third,
    every_third_block,
)
from beamsplat.tools.evaluation.truth_labels import TruthLabels

DEFAULT = "field"
COMPARED = {"learned": "comparison", "poisson": "poisson_comparison"}  # method -> its key in the report


def evaluate(
    drive: RecordedDrive,
    source: DepthSource,
    truth: dict[int, Path],
    *,
    heldout: bool = True,
    config: PlaneSweepConfig | None = None,
    floor: bool | None = None,
    learned: Aggregation | None = None,
    progress: Callable[[str, int, int], None] = lambda run, done, total: None,
) -> dict[str, object]:
    """Evaluate the depth of a drive; return the JSON report of `beamsplat eval depth`.

    The report contains one object of metrics per method, the name of the `default` method, and `breakdown`:
    errors by parts of the image with confidence intervals (see `DepthBreakdown`). `poisson_comparison` is
    the change from method `field` to method `poisson` on the pixels that both answer; with `learned`,
    `comparison` is that to method `learned`.

    Args:
        truth: files of the true depth, by stamp of the image.
        heldout: also process the drive with every third beam, and with every third block of beams, held out.
        config: settings of fusion; None uses the defaults.
        floor: whether the camera's height above the floor is known; None: if the poses are planar.
        learned: aggregation of the additional method `learned`; None: without it.
        progress: receives the name of the pass over the drive, the number of finished and of all images.

    Raises:
        UserError: no image of the drive has a true depth.
    """
    stamps = {image.stamp_ns for image in drive.images}
    wanted: dict[int, Path | None] = {s: p for s, p in truth.items() if s in stamps}
    if not wanted:
        raise UserError(f"{drive.path}: no image has the stamp of a truth file")
    floor_known = drive.planar if floor is None else floor
    labels = TruthLabels(drive, {s: p for s, p in truth.items() if s in stamps}, floor_known=floor_known)
    figures = _Figures(drive, labels)
    for run in ("dense", "third", "blocks") if heldout else ("dense",):
        heldout_mask = _heldout_selector(run, drive)
        outcomes = replay_depth(drive, source, wanted, heldout_mask, config, floor, learned=learned)
        for count, outcome in enumerate(outcomes):
            progress(run, count + 1, len(wanted))
            if heldout_mask is None:
                figures.add_dense(outcome)
            else:
                figures.add_held(run, outcome, heldout_mask)
    report = figures.report()
    report["default"] = DEFAULT
    report["poses"] = drive.poses_name
    report["floor_known"] = floor_known
    return report


class _Figures:
    """Errors and CPU times of all methods over the images of a drive."""

    def __init__(self, drive: RecordedDrive, labels: TruthLabels) -> None:
        self._drive, self._labels = drive, labels
        self._errors: dict[str, MethodErrors] = {}
        self._breakdowns: dict[str, DepthBreakdown] = {}
        self._pairs: dict[str, PairedErrors] = {}  # by method that is compared with the default
        self._beams: dict[str, tuple[int, int]] = {}  # by run: held-out beams, those not confirmed by truth
        self._seconds: dict[str, list[float]] = {}

    def add_dense(self, outcome: DepthComparison) -> None:
        """Add an image whose beams were all used."""
        drive = self._drive
        beams = drive.beams_at(outcome.stamp_ns)
        uv, z, _ = project_beams(beams, drive.undistort.pinhole, drive.T_body_camera)
        parts = self._labels.labels(outcome.stamp_ns, outcome.truth)
        for name, (depth, sigma) in _depths(outcome).items():
            errors = self._errors.setdefault(name, MethodErrors())
            errors.add_dense(depth, sigma, outcome.truth)
            errors.add_beams(depth, uv, z)
            self._breakdowns.setdefault(name, DepthBreakdown()).add(depth, sigma, outcome.truth, parts)
        for name, value in outcome.seconds.items():
            self._seconds.setdefault(name, []).append(value)
        methods = outcome.methods
        for name in COMPARED:
            if name not in methods or (name == "poisson" and outcome.estimate.kind == "none"):
                continue
            pairs = self._pairs.setdefault(name, PairedErrors())
            pairs.add(methods[DEFAULT].depth_m, methods[name].depth_m, outcome.truth)

    def add_held(self, run: str, outcome: DepthComparison, heldout_mask: Callable[[int], np.ndarray]) -> None:
        """Add an image for which some beams were held out."""
        uv, z = _heldout_beams(self._drive, outcome.stamp_ns, heldout_mask)
        good = confirmed_by_truth(outcome.truth, uv, z)
        total, unconfirmed = self._beams.get(run, (0, 0))
        self._beams[run] = total + len(z), unconfirmed + int((~good).sum())
        for name, (depth, sigma) in _depths(outcome).items():
            self._errors[name].add_held(run, depth, sigma, uv[good], z[good])

    def report(self) -> dict[str, object]:
        """Return the JSON report of the figures."""
        excluded = {run: unconfirmed / max(total, 1) for run, (total, unconfirmed) in self._beams.items()}
        report: dict[str, object] = {name: e.summary(excluded) for name, e in self._errors.items()}
        report["cpu_ms"] = {name: 1e3 * float(np.median(values)) for name, values in self._seconds.items()}
        report["breakdown"] = breakdown_report(self._breakdowns, self._labels.heights_report)
        for name, pairs in self._pairs.items():
            report[COMPARED[name]] = {"first": DEFAULT, "second": name, **pairs.report()}
        return report


def _depths(outcome: DepthComparison) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Return depth and standard deviation [H, W] by method; `raw` is a metric estimate, without deviation."""
    methods: dict[str, FusionResult] = outcome.methods
    depths: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
    if outcome.estimate.kind == "metric":
        depths["raw"] = outcome.estimate.values, None
    return depths | {name: (result.depth_m, result.sigma_m) for name, result in methods.items()}


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
