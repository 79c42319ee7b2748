"""Runs depth estimation and fusion over a recorded drive, with all methods that are compared."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import Beams, project_beams
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.depth.recorded import read_depth
from beamsplat.services.depth.source import DepthInput, DepthSource, Estimate
from beamsplat.services.fusion.aggregation import Aggregation
from beamsplat.services.fusion.fuse import ExaminedImage, Fusion, SweptKeyframe
from beamsplat.services.fusion.inputs import FusionInput, PlaneSweepConfig
from beamsplat.services.fusion.result import FusionResult, rejected
from beamsplat.services.fusion.scaling import affine, ratio
from beamsplat.tools.evaluation.drive import RecordedDrive

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
    learned: Aggregation | None = None,
) -> Iterator[DepthComparison]:
    """Run depth estimation and fusion over a drive in order of time; yield the results of the wanted images.

    An image is processed without later data, except the scan during which it was taken. Wanted images are
    processed as keyframes (method `field`). Method `field_carried` is the depth of the same image if it were
    not a keyframe: then only earlier keyframes contribute. Method `poisson` completes the depth of `field`.

    Args:
        wanted: stamps of the wanted images, each with the file of its true depth, or None.
        heldout_mask: returns bool [beams] for a number of beams; True beams are held out. None: no beams are.
        config: settings of fusion; None uses the defaults.
        floor: whether the camera's height above the floor is known; None: if the poses are planar.
        refuse: receives the reason for each image that cannot be decoded; None: it is an error.
        learned: aggregation of a second fusion of the same images, method `learned`; None: there is none.

    Raises:
        UserError: an image cannot be decoded, and `refuse` is None.
    """
    known = drive.planar if floor is None else floor
    replay = _Replay(drive, source, config, known, learned, heldout_mask)
    for number, image in enumerate(drive.images):
        T_map_body = drive.pose(image.stamp_ns)
        if T_map_body is None:
            continue
        replay.add_scans_until(image.stamp_ns)
        try:
            rgb = drive.rgb(number)
        except UserError as error:
            if refuse is None:
                raise
            refuse(str(error))
            continue
        if image.stamp_ns in wanted:
            yield replay.compare(image.stamp_ns, rgb, T_map_body, wanted[image.stamp_ns])
        else:
            replay.process(image.stamp_ns, rgb, T_map_body)


class _Replay:
    """State of the fusions of one drive: the default one and, if wanted, one with the learned aggregation."""

    def __init__(
        self, drive: RecordedDrive, source: DepthSource, config: PlaneSweepConfig | None, floor_known: bool,
        learned: Aggregation | None, heldout_mask: Callable[[int], np.ndarray] | None,
    ) -> None:  # fmt: skip
        self._drive, self._source, self._floor_known = drive, source, floor_known
        self._heldout_mask = heldout_mask
        chosen: dict[str, Aggregation | None] = {"field": None}
        if learned is not None:
            chosen["learned"] = learned
        self._fusions = {
            name: Fusion(
                drive.undistort.pinhole, drive.T_body_camera, floor_known=floor_known, planar=drive.planar,
                config=config, aggregation=aggregation,
            )
            for name, aggregation in chosen.items()
        }  # fmt: skip
        self._next_scan = 0
        self._last_keyframe: np.ndarray | None = None

    def add_scans_until(self, stamp_ns: int) -> None:
        """Add the scans that are complete at a time."""
        scans = self._drive.scans
        while self._next_scan < len(scans) and scans[self._next_scan].last_ns <= stamp_ns:
            due = scans[self._next_scan]
            points = self._drive.scan_in_map(due, self._heldout(len(due.ranges_m)))
            for fusion in self._fusions.values():
                fusion.add_scan(points)
            self._next_scan += 1

    def _heldout(self, beams: int) -> np.ndarray | None:
        return None if self._heldout_mask is None else self._heldout_mask(beams)

    def process(self, stamp_ns: int, rgb: np.ndarray, T_map_body: np.ndarray) -> None:
        """Process an image without truth: as a keyframe if the camera has moved, else for later sweeps."""
        if self._last_keyframe is not None and not _moved(self._last_keyframe, T_map_body):
            for fusion in self._fusions.values():
                fusion.look(rgb, T_map_body)
            return
        _, frame, _ = self._estimated(stamp_ns, rgb, T_map_body, self._beams(stamp_ns))
        for fusion in self._fusions.values():
            fusion.fuse(frame, keyframe=True)
        self._last_keyframe = T_map_body

    def compare(
        self, stamp_ns: int, rgb: np.ndarray, T_map_body: np.ndarray, truth_file: Path | None
    ) -> DepthComparison:
        """Return the depth of an image by all methods; the image becomes a keyframe."""
        beams = self._beams(stamp_ns)
        estimate, frame, source_s = self._estimated(stamp_ns, rgb, T_map_body, beams)
        seconds = {"source": source_s}
        methods: dict[str, FusionResult] = {}
        started = time.process_time()
        methods["field_carried"] = self._fusions["field"].fuse(frame, keyframe=False)
        seconds["field_carried"] = time.process_time() - started
        for name, fusion in self._fusions.items():
            started = time.process_time()
            examined = fusion.examine(frame, keyframe=True)
            swept = examined if isinstance(examined, FusionResult) else fusion.begin_keyframe(examined)()
            methods[name] = swept if isinstance(swept, FusionResult) else fusion.finish_keyframe(swept)
            seconds[name] = time.process_time() - started
            if name == "field":
                started = time.process_time()
                methods["poisson"] = _completed(fusion, frame, examined, swept)
                seconds["poisson"] = time.process_time() - started
        self._last_keyframe = T_map_body
        uv, z, _ = project_beams(beams, self._drive.undistort.pinhole, self._drive.T_body_camera)
        for name, correct in (("ratio", ratio), ("affine", affine)):
            started = time.process_time()
            done = None if frame.estimate is None else correct(frame.estimate, estimate.kind, uv, z)
            methods[name] = done or rejected(rgb.shape[:2], estimate.status)
            seconds[name] = time.process_time() - started
        unknown = np.full(rgb.shape[:2], np.nan, np.float32)
        truth = unknown if truth_file is None else read_depth(truth_file)
        return DepthComparison(stamp_ns, rgb, estimate, methods, truth, seconds)

    def _beams(self, stamp_ns: int) -> Beams:
        scan = self._drive.scan_near(stamp_ns)
        return self._drive.beams_at(stamp_ns, None if scan is None else self._heldout(len(scan.ranges_m)))

    def _estimated(
        self, stamp_ns: int, rgb: np.ndarray, T_map_body: np.ndarray, beams: Beams
    ) -> tuple[Estimate, FusionInput, float]:
        """Return the estimate of the depth source, the input of fusion, and the source's CPU time (s)."""
        camera = self._drive.undistort.pinhole
        started = time.process_time()
        view = DepthInput(stamp_ns, rgb, camera, self._drive.T_body_camera, beams, self._floor_known)
        estimate = self._source.estimate(view)
        seconds = time.process_time() - started
        values = estimate.values if estimate.ok and estimate.kind != "none" else None
        return estimate, FusionInput(stamp_ns, rgb, T_map_body, beams, values, estimate.kind), seconds


def _completed(
    fusion: Fusion, frame: FusionInput, examined: ExaminedImage | FusionResult,
    swept: SweptKeyframe | FusionResult,
) -> FusionResult:  # fmt: skip
    """Return the depth of a keyframe by method `poisson`; no depth without a sweep or an estimate."""
    if isinstance(examined, FusionResult) or isinstance(swept, FusionResult):
        return rejected(frame.image_rgb.shape[:2], "there is no plane sweep to complete")
    if frame.estimate is None:
        return rejected(frame.image_rgb.shape[:2], "there is no depth estimate")
    return fusion.complete(examined, swept)


def _moved(T_before: np.ndarray, T_now: np.ndarray) -> bool:
    T = inverse(T_before) @ T_now
    turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return bool(np.linalg.norm(T[:3, 3]) > KEYFRAME_M or turn > KEYFRAME_RAD)
