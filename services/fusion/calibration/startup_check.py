"""Calibration check at every start: camera clock, camera mount and lidar mounting against the images.

During the first metres of a drive, corners are tracked between images and a few scans are stored. One
background job then compares what could be wrong by its evidence (diagnosis.py), and, if the model explains
the data, estimates the clock offset and the orientation of the camera.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.trajectory import Trajectory
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.fusion.calibration.diagnosis import (
    SMALL,
    Evidence,
    WheelEvidence,
    compare_with_wheels,
    sentence,
    weigh,
)
from beamsplat.services.fusion.calibration.hypotheses import CornerProblem
from beamsplat.services.fusion.calibration.motion import (
    MotionCalibration,
    TrackedPair,
    apply_correction,
    solve_motion,
)
from beamsplat.services.fusion.calibration.mounting import check_mounting
from beamsplat.services.fusion.relative_pose import detect_corners, track_corners

_WIDTH_PX = 320  # working size
_EVERY_NS = 250_000_000  # between the images used
_APART_NS = (500_000_000, 1_200_000_000)  # least and largest time between the images of a pair
_LEAST_TURN_RAD, _LEAST_WAY_M = 0.02, 0.05  # between the images of a pair
_LEAST_CORNERS = 12
_POSE_GAP_NS = 1_000_000_000
_SCANS = 24
_MAX_POSES = 12_000  # 20 min at 10 Hz
# Drift of the yaw in odom over the 20 s of the pairs: RMS on simulated drives of seeds 101 and 102 and on
# house_a; verified on other seeds by `bench uncertainties`.
_DRIFT_RAD_S = np.radians(0.012)
_FREE = ("clock_s", "roll_rad", "pitch_rad", "yaw_rad")
_CLOCK_MS, _ANGLE_DEG, _SIGMAS = 20.0, 0.7, 5.0  # least errors that are reported, and sigmas
_MISFIT_PX = 1.5  # a larger residual is a fault
_LARGE_TURN_RAD = 0.1  # beyond the prior of `solve_motion`: its start is corrected first
_LEAST_EXPLAINED = 0.4  # of the corners: fewer, and no hypothesis is trusted
_UNEXPLAINED = 0.3  # cost (mean of log(1 + r^2)) of the best hypothesis: none explains the data


@dataclass(frozen=True)
class CalibrationHealth:
    """Result of the calibration check. `status` is "ok", or one sentence: the fault and the remedy."""

    status: str
    misfit_px: float  # median distance of tracked corners from their prediction by the poses, 320 px wide
    clock_ms: float  # to be added to image stamps; NaN = not observable
    clock_sigma_ms: float
    turn_deg: np.ndarray  # float64 [3]: roll, pitch, yaw to add to the mount; NaN = not observable
    turn_sigma_deg: np.ndarray  # float64 [3], standard errors
    pairs: int
    cause: str = "ok"  # of the fault, see `diagnosis.HYPOTHESES`; "clock", "mount", "unknown", "unchecked"

    @property
    def line(self) -> str:
        """Return one line for the status display."""
        if self.status != "ok":
            return f"calibration: {self.status}"
        observable = np.isfinite(self.clock_ms)
        clock = f", clock {self.clock_ms:+.0f} +- {self.clock_sigma_ms:.0f} ms" if observable else ""
        return f"calibration ok: {self.misfit_px:.2f} px in {self.pairs} pairs of images{clock}"


class StartupCheck:
    """Collector of image pairs, scans and poses; `job` returns the check once there are enough data."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, T_body_lidar: np.ndarray, pairs: int = 60
    ) -> None:
        height = round(camera.height_px * _WIDTH_PX / camera.width_px)
        self._camera, self._full = camera.resized(_WIDTH_PX, height), camera
        self._T_body_camera, self._T_body_lidar = T_body_camera, T_body_lidar
        self._wanted = pairs
        self._pairs: list[TrackedPair] = []
        self._images: deque[tuple[int, np.ndarray, np.ndarray]] = deque()
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []
        self._scans: list[tuple[np.ndarray, np.ndarray]] = []
        self._wheels: deque[tuple[int, np.ndarray]] = deque(maxlen=_MAX_POSES)
        self.done = False

    @property
    def progress(self) -> str:
        return f"calibration not checked yet: {len(self._pairs)} of {self._wanted} pairs of images"

    def add_pose(self, stamp_ns: int, T_map_body: np.ndarray) -> None:
        """Add a pose of localization. A stamp earlier than the previous one restarts the check."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            for kept in (self._pairs, self._images, self._stamps, self._poses, self._scans, self._wheels):
                kept.clear()
        self._stamps.append(stamp_ns)
        self._poses.append(T_map_body)
        if not self._pairs and len(self._stamps) > 600:  # robot at rest: keep only the last poses
            del self._stamps[:300], self._poses[:300]
        elif len(self._stamps) > _MAX_POSES:  # too few pairs for long: the check uses the newest ones
            del self._stamps[: _MAX_POSES // 2], self._poses[: _MAX_POSES // 2]
            self._pairs = [pair for pair in self._pairs if pair.stamp_a_ns >= self._stamps[0]]

    def add_wheels(self, stamp_ns: int, T_odom_body: np.ndarray) -> None:
        """Add a pose of the wheel odometry; those not later than the newest one are ignored."""
        if not self.done and (not self._wheels or stamp_ns > self._wheels[-1][0]):
            self._wheels.append((stamp_ns, T_odom_body))

    def add_scan(self, points_lidar_m: np.ndarray, T_map_body: np.ndarray) -> None:
        """Add the returns float64 [N, 3] of a scan, lidar frame; scans nearer than 0.25 m are ignored."""
        if self.done or len(points_lidar_m) < 50 or len(self._scans) >= _SCANS:
            return
        if self._scans and not _apart(self._scans[-1][1], T_map_body, 0.25, 0.3):
            return
        self._scans.append((points_lidar_m, T_map_body))

    def add_image(self, stamp_ns: int, image_rgb: np.ndarray, T_map_body: np.ndarray) -> None:
        """Add an undistorted image uint8 [H, W, 3]; at most four per second are used."""
        if self.done or (self._images and stamp_ns - self._images[-1][0] < _EVERY_NS):
            return
        grey = cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY)
        size = (self._camera.width_px, self._camera.height_px)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        while self._images and stamp_ns - self._images[0][0] > _APART_NS[1]:
            self._images.popleft()
        if self._images and stamp_ns - self._images[0][0] >= _APART_NS[0]:
            then_ns, then, T_then = self._images[0]
            if _apart(T_then, T_map_body, _LEAST_WAY_M, _LEAST_TURN_RAD):
                self._add_pair(then_ns, then, stamp_ns, small)
        self._images.append((stamp_ns, small, T_map_body))

    def _add_pair(self, a_ns: int, a: np.ndarray, b_ns: int, b: np.ndarray) -> None:
        uv = detect_corners(a, 80)
        moved, good = track_corners(a, b, uv, uv)
        if good.sum() >= _LEAST_CORNERS:
            rays = self._camera.rays
            self._pairs.append(TrackedPair(a_ns, b_ns, rays(uv[good]), rays(moved[good])))

    def job(self) -> Callable[[], CalibrationHealth] | None:
        """Return the check as a function, once, when there are enough data; None before and after.

        The function uses copies of the data, so it may run in another thread.
        """
        if self.done or len(self._pairs) < self._wanted:
            return None
        self.done = True
        pairs, scans = self._pairs, self._scans
        trajectory = Trajectory(np.array(self._stamps, dtype=np.int64), np.array(self._poses))
        self._pairs, self._scans = [], []
        self._stamps, self._poses = [], []
        self._images.clear()
        wheels = _trajectory_of(self._wheels)
        self._wheels.clear()
        T_body_camera, T_body_lidar, camera = self._T_body_camera, self._T_body_lidar, self._full

        def pose_at(stamp_ns: int) -> np.ndarray | None:
            return trajectory.at(stamp_ns, max_gap_ns=_POSE_GAP_NS, max_extrapolation_ns=0)

        def check() -> CalibrationHealth:
            compared = None
            if wheels is not None:
                compared = compare_with_wheels(
                    trajectory.stamps_ns, trajectory.T_a_b,
                    lambda at: wheels.at(at, max_gap_ns=_POSE_GAP_NS, max_extrapolation_ns=0), T_body_lidar,
                )  # fmt: skip
            return check_calibration(pairs, scans, pose_at, T_body_camera, T_body_lidar, camera, compared)

        return check


def check_calibration(
    pairs: list[TrackedPair],
    scans: list[tuple[np.ndarray, np.ndarray]],  # (points in the lidar frame, T_map_body)
    pose_at: Callable[[int], np.ndarray | None],
    T_body_camera: np.ndarray,
    T_body_lidar: np.ndarray,
    camera: Pinhole,  # undistorted, of the images before they were scaled down
    wheels: WheelEvidence | None = None,
) -> CalibrationHealth:
    """Return the health of the calibration: the cause with the best evidence, or an error of clock or mount.

    An offset is named only if the model with it explains the corners: with another fault, the offset that
    fits best would be wrong advice. `wheels`: None = no wheel odometry.
    """
    nothing = np.full(3, np.nan)

    def fault(cause: str, status: str, misfit_px: float) -> CalibrationHealth:
        return CalibrationHealth(status, misfit_px, np.nan, np.nan, nothing, nothing, len(pairs), cause)

    small = camera.resized(_WIDTH_PX, round(camera.height_px * _WIDTH_PX / camera.width_px))
    corner = ((-0.5 - small.cx_px) / small.fx_px, (-0.5 - small.cy_px) / small.fy_px)
    problem = CornerProblem(pairs, pose_at, T_body_camera, T_body_lidar, small.fx_px, corner)
    evidence = weigh(problem, wheels)
    against_poses = check_mounting([p for p, _ in scans], [T for _, T in scans], T_body_lidar)
    if (
        against_poses.pairs
        and against_poses.status != "ok"
        and (wheels is None or evidence.cause not in SMALL)
    ):
        return fault("lidar", against_poses.status, evidence.best.residual_px)
    if evidence.cause not in SMALL:
        text = sentence(evidence, (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px))
        return fault(evidence.cause, text, evidence.best.residual_px)
    if evidence.best.cost > _UNEXPLAINED or evidence.explained_share < _LEAST_EXPLAINED:
        return fault(
            "unknown",
            f"images and poses do not fit ({evidence.best.residual_px:.1f} px), and no error of clock, "
            "mount, K, lens or lidar explains it: check the poses, and whether camera and lidar are of the "
            "same drive",
            evidence.best.residual_px,
        )
    turn_rad, mount = _large_turn(evidence), T_body_camera
    if np.any(turn_rad):
        mount = apply_correction(T_body_camera, turn_rad)
    try:
        found = solve_motion(pairs, pose_at, mount, small.fx_px, _FREE, _DRIFT_RAD_S)
    except ValueError as error:
        return fault("unchecked", f"cannot be checked: {error}", evidence.best.residual_px)
    found = replace(found, values=found.values + turn_rad)
    observable = found.observable
    cause, status = describe_calibration(found, _CLOCK_MS, _ANGLE_DEG, _SIGMAS, evidence.clock_first)
    return CalibrationHealth(
        status, found.residual_px,
        1e3 * found.values[0] if observable[0] else np.nan, 1e3 * found.sigma[0] if observable[0] else np.nan,
        np.where(observable[1:4], np.degrees(found.values[1:4]), np.nan),
        np.where(observable[1:4], np.degrees(found.sigma[1:4]), np.nan), len(pairs), cause,
    )  # fmt: skip


def _large_turn(evidence: Evidence) -> np.ndarray:
    """Return the turn of the mount by the best fit, float64 [6] as `PARAMETERS`; zeros if it is small."""
    turn = np.zeros(6)
    turn[1:4] = [evidence.best.values.get(name, 0.0) for name in ("roll", "pitch", "yaw")]
    return turn if np.abs(turn).max() > _LARGE_TURN_RAD else np.zeros(6)


def _trajectory_of(poses: deque[tuple[int, np.ndarray]]) -> Trajectory | None:
    if len(poses) < 2:
        return None
    return Trajectory(np.array([at for at, _ in poses], dtype=np.int64), np.array([T for _, T in poses]))


def describe_calibration(
    found: MotionCalibration,
    clock_ms: float = 10.0,
    angle_deg: float = 0.5,
    sigmas: float = 4.0,
    clock_first: bool = True,
) -> tuple[str, str]:
    """Return (cause, status): ("ok", "ok"), or the larger error of clock or mount with one sentence about it.

    Errors below `clock_ms` or `angle_deg`, or below `sigmas` standard errors, are ignored. `clock_first`:
    whether the clock is named if both are wrong.
    """
    errors = []
    off_ms, sigma_ms = 1e3 * found.values[0], 1e3 * found.sigma[0]
    if found.observable[0] and abs(off_ms) > max(clock_ms, sigmas * sigma_ms):
        text = f"the camera's clock is wrong: add {off_ms:.0f} +- {sigma_ms:.0f} ms to its stamps"
        errors.append(("clock", text))
    turn_deg, turn_sigma = np.degrees(found.values[1:4]), np.degrees(found.sigma[1:4])
    turns = [
        (abs(value), f"the camera's {name} is wrong: turn its mount by {value:.2f} +- {sigma:.2f} degrees")
        for name, value, sigma, sure in zip(
            ("roll", "pitch", "yaw"), turn_deg, turn_sigma, found.observable[1:4]
        )
        if sure and abs(value) > max(angle_deg, sigmas * sigma)
    ]
    if turns:
        errors.append(("mount", max(turns)[1]))
    if errors:
        return errors[0] if clock_first else errors[-1]
    if found.residual_px > _MISFIT_PX:
        return "unknown", f"images and poses do not fit ({found.residual_px:.1f} px): wrong K, or wrong poses"
    return "ok", "ok"


def _apart(T_a: np.ndarray, T_b: np.ndarray, way_m: float, turn_rad: float) -> bool:
    T = inverse(T_a) @ T_b
    turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return bool(np.linalg.norm(T[:3, 3]) > way_m or turn > turn_rad)
