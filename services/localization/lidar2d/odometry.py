"""Wheel odometry with estimated delay, tolerance to gaps, and error models learnt from matched scans."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.odometry_calibration import OdometryCalibration, OdometryReport
from beamsplat.services.localization.lidar2d.validate import StampGuard
from beamsplat.services.localization.lidar2d.wheel_gap import GapMotion, motion_over_gap

NS = 1e-9
BASELINE_NS = 80_000_000
_MAX_PENDING = 256  # matched motions that wait for odometry after them
DELAY_STEP_S = 0.02
DELAY_CANDIDATES_S = np.arange(-40, 41) * DELAY_STEP_S  # candidates for the delay of the odometry stamps
_MIN_DELAY_WEIGHT = 20.0  # turning scans before the first estimate of the delay
_DELAY_EVIDENCE = 25.0  # a change of the delay must improve the squared errors by so many of their mean
_AT_ZERO, _ELSEWHERE = 0.1, 0.5  # m, rad: an odometer that was elsewhere goes on at zero: it was restarted
_TURN_OUTLIER_RAD = 0.02  # a turn that disagrees by this much counts half


@kernel
def interpolate(
    stamps_ns: np.ndarray,  # int64 [N], increasing
    poses: np.ndarray,  # float64 [N, 3]
    at_ns: int,
    ahead_ns: int,  # extrapolate up to this time beyond the newest pose
    gap_ns: int,  # no interpolation over longer intervals
    out: np.ndarray,  # out float64 [3]
) -> bool:
    """Write the pose at the stamp `at_ns` to `out`; return False without odometry around this stamp."""
    n = stamps_ns.shape[0]
    if n < 2 or at_ns < stamps_ns[0] or at_ns > stamps_ns[n - 1] + ahead_ns:
        return False
    i = min(max(np.searchsorted(stamps_ns, at_ns), 1), n - 1)
    k = i - 1
    if at_ns > stamps_ns[n - 1]:  # stamps are irregular: use a longer baseline for the velocity
        while k > 0 and stamps_ns[n - 1] - stamps_ns[k] < BASELINE_NS:
            k -= 1
    span = stamps_ns[i] - stamps_ns[k]
    if span > gap_ns or span <= 0:
        return False
    f = (at_ns - stamps_ns[k]) / span
    for j in range(2):
        out[j] = poses[k, j] + f * (poses[i, j] - poses[k, j])
    out[2] = se2.wrap(poses[k, 2] + f * se2.wrap(poses[i, 2] - poses[k, 2]))
    return True


@kernel
def turns_at_delays(
    stamps_ns: np.ndarray,
    poses: np.ndarray,
    t0_ns: int,
    t1_ns: int,
    delays_ns: np.ndarray,
    gap_ns: int,
    turns: np.ndarray,
) -> bool:
    """Write to `turns` the rotation (rad) by odometry between two stamps for each candidate delay.

    Returns False if there is no odometry at one of the stamps.
    """
    a, b = np.empty(3), np.empty(3)
    for k in range(delays_ns.shape[0]):
        d = delays_ns[k]
        if not interpolate(stamps_ns, poses, t0_ns + d, 0, gap_ns, a):
            return False
        if not interpolate(stamps_ns, poses, t1_ns + d, 0, gap_ns, b):
            return False
        turns[k] = se2.wrap(b[2] - a[2])
    return True


class OdometryBuffer:
    """Recent wheel odometry poses and the estimated delay of their clock."""

    def __init__(self, capacity: int = 4096, gap_s: float = 0.6, bridge_s: float = 10.0) -> None:
        self._stamps = np.zeros(2 * capacity, dtype=np.int64)
        self._poses = np.zeros((2 * capacity, 3))
        self._capacity, self._count = capacity, 0
        self._gap_ns = round(gap_s / NS)  # no delay estimation over longer gaps
        self._bridge_ns = round(bridge_s / NS)  # interpolate over gaps up to this long
        self.delay_ns = 0
        self.rejected = 0
        self._delays_ns = np.round(DELAY_CANDIDATES_S / NS).astype(np.int64)
        self._sums = np.zeros((3, len(DELAY_CANDIDATES_S)))  # of matched^2, matched * wheels, wheels^2
        self._weight = 0.0
        self.calibration = OdometryCalibration()
        self._guard = StampGuard()
        self._before = (
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
        )  # poses of the time before the clock was set back
        self._new_time = True  # the poses in the buffer are of the present time
        self._pending: list[tuple[int, int, np.ndarray | None]] = []  # see observe()

    @property
    def stamps_ns(self) -> np.ndarray:
        return self._stamps[: self._count]

    @property
    def poses(self) -> np.ndarray:
        return self._poses[: self._count]

    def add(self, stamp_ns: int, x_m: float, y_m: float, yaw_rad: float) -> bool:
        """Append a pose; reject it (return False) if it is not finite or not newer than the last pose.

        If the clock was set back, the new time is followed after a few poses: one stamp from the future must
        not silence the wheels until then. See `motion_over_set_back` for the poses before.
        """
        values = (x_m, y_m, yaw_rad)
        if not all(math.isfinite(v) for v in values):
            self.rejected += 1
            return False
        fault, set_back = self._guard.check(stamp_ns)
        if fault:
            self.rejected += 1
            return False
        if set_back:
            self._end_time()
            self._new_time = True
        if self._count == 2 * self._capacity:
            self._stamps[: self._capacity] = self._stamps[self._capacity :]
            self._poses[: self._capacity] = self._poses[self._capacity :]
            self._count = self._capacity
        self._stamps[self._count] = stamp_ns
        self._poses[self._count] = values
        self._count += 1
        return True

    def clock_set_back(self, before_ns: int, now_ns: int) -> None:
        """Put the poses of the old time away: the stamps of the scans went back from `before_ns` to `now_ns`.

        They would pass for motion of the new time, whose poses may arrive later.
        """
        if self._count and self.stamps_ns[-1] - now_ns > (before_ns - now_ns) // 2:
            self._end_time()
            self._new_time = False

    def _end_time(self) -> None:
        """Put the poses in the buffer away, as the end of the time before."""
        stamps_ns, poses = self._before
        if self._new_time:
            stamps_ns, poses = stamps_ns[:0], poses[:0]
        self._before = np.append(stamps_ns, self.stamps_ns), np.append(poses, self.poses, axis=0)
        self._count = 0
        self._pending.clear()
        self.calibration.restart()

    def increment(self, t0_ns: int, t1_ns: int, ahead_s: float = 0.25) -> np.ndarray | None:
        """Return the motion [3] of the body between two scan stamps, None without odometry at them.

        The estimated delay and scales are applied.
        """
        motion = self._measured(t0_ns, t1_ns, ahead_s)
        return None if motion is None else self.calibration.apply(motion)

    def _measured(self, t0_ns: int, t1_ns: int, ahead_s: float) -> np.ndarray | None:
        a, b = np.empty(3), np.empty(3)
        ahead = round(ahead_s / NS)
        for stamp, out in ((t0_ns, a), (t1_ns, b)):
            if not interpolate(
                self.stamps_ns, self.poses, stamp + self.delay_ns, ahead, self._bridge_ns, out
            ):
                return None
        return se2.between(a, b)

    def is_continuous(self, t0_ns: int, t1_ns: int) -> bool:
        """Return whether `increment` needs no bridge over a longer silence between two stamps."""
        first = int(np.searchsorted(self.stamps_ns, t0_ns + self.delay_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamps_ns, t1_ns + self.delay_ns))
        if first < 0 or last <= first or t1_ns + self.delay_ns - self.stamps_ns[-1] > self._gap_ns:
            return False
        return bool((np.diff(self.stamps_ns[first : last + 1]) <= self._bridge_ns).all())

    def motion_over_gap(self, t0_ns: int, t1_ns: int) -> GapMotion | None:
        """Return the motion of the body over a gap of any length.

        Wheels count on while nothing is heard of them: the last pose before the gap and the first after it
        are enough. None without odometry on both sides.
        """
        first = int(np.searchsorted(self.stamps_ns, t0_ns + self.delay_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamps_ns, t1_ns + self.delay_ns, side="right")) - 1
        if first < 0 or last <= first:
            return None
        late_ns = max(
            t0_ns + self.delay_ns - self.stamps_ns[first], t1_ns + self.delay_ns - self.stamps_ns[last]
        )
        if late_ns > self._gap_ns:
            return None
        intervals_s = np.diff(self.stamps_ns[first : last + 1]) * NS
        return motion_over_gap(self.poses[first : last + 1], intervals_s, self._gap_ns * NS, self.calibration)

    def motion_over_set_back(self, before_ns: int, now_ns: int) -> np.ndarray | None:
        """Return the motion [3] from a stamp before the clock was set back to a stamp of the new time.

        Wheels do not care about clocks: their poses tell the motion, also where a recording was played again
        from an earlier place. None if the odometry's clock was not set back, it began again at zero, or there
        is none at the stamps.
        """
        a, b = np.empty(3), np.empty(3)
        stamps_ns, poses = self._before
        if not interpolate(stamps_ns, poses, before_ns + self.delay_ns, self._gap_ns, self._gap_ns, a):
            return None
        at_ns = max(now_ns + self.delay_ns, int(self.stamps_ns[0])) if self._count else now_ns
        if at_ns > now_ns + self.delay_ns + self._gap_ns:
            return None
        if not interpolate(self.stamps_ns, self.poses, at_ns, self._gap_ns, self._gap_ns, b):
            return None
        if np.abs(self.poses[0]).max() < _AT_ZERO and np.abs(a).max() > _ELSEWHERE:
            return None
        return self.calibration.apply(se2.between(a, b))

    def motion_after_gap(self, t0_ns: int, t1_ns: int) -> np.ndarray:
        """Return the motion [3] between two stamps after a gap, by the mean velocity since the gap.

        The odometry may begin after `t0_ns`. Zero where it tells nothing.
        """
        first = int(np.searchsorted(self.stamps_ns, t0_ns + self.delay_ns))
        last = int(np.searchsorted(self.stamps_ns, t1_ns + self.delay_ns, side="right")) - 1
        if last <= first or self.stamps_ns[last] - self.stamps_ns[first] < BASELINE_NS:
            return np.zeros(3)
        ratio = (t1_ns - t0_ns) / (self.stamps_ns[last] - self.stamps_ns[first])
        return ratio * self.calibration.apply(se2.between(self.poses[first], self.poses[last]))

    def observe(self, t0_ns: int, t1_ns: int, motion: np.ndarray | None) -> None:
        """Update the estimates with the motion [3] between two scans, as found by matching.

        `motion` is None if the match did not determine it. Motions wait for the odometry after them, until
        all candidates of the delay can be compared.
        """
        self._pending.append((t0_ns, t1_ns, motion))
        horizon = int(self._delays_ns[-1])
        while self._pending and self._count and self.stamps_ns[-1] >= self._pending[0][1] + horizon:
            t0, t1, matched = self._pending.pop(0)
            if matched is None:
                self.calibration.restart()
                continue
            if abs(matched[2]) > 0.01 and t1 - t0 < self._gap_ns:
                self._observe_rotation(t0, t1, float(matched[2]))
            self.calibration.observe(self._measured(t0, t1, 0.0), matched, (t1 - t0) * NS)
        if len(self._pending) > _MAX_PENDING:
            del self._pending[: _MAX_PENDING // 2]
            self.calibration.restart()

    def report(self) -> OdometryReport:
        """Return the estimated errors of the odometry."""
        return self.calibration.report(self.delay_ns * NS)

    def _observe_rotation(self, t0_ns: int, t1_ns: int, yaw_rad: float) -> None:
        """Update the delay with the rotation `yaw_rad` between two scans.

        The delay is the candidate whose rotations, times the best scale, have the lowest sum of squared
        errors, exponentially forgotten.
        """
        turns = np.empty(len(self._delays_ns))
        recent = max(0, self._count - 1024)
        if turns_at_delays(
            self.stamps_ns[recent:], self.poses[recent:], t0_ns, t1_ns, self._delays_ns, self._gap_ns, turns
        ):
            self._update_delay(yaw_rad, turns)

    def _update_delay(self, yaw_rad: float, turns: np.ndarray) -> None:
        now = int(np.argmin(np.abs(self._delays_ns - self.delay_ns)))
        # Slip is what fits no delay; the present delay may be wrong.
        error = np.abs(yaw_rad - self.calibration.turn.value * turns).min() / _TURN_OUTLIER_RAD
        weight = 1.0 / (1.0 + error**2)
        self._sums = 0.998 * self._sums + weight * np.array(
            [np.full(len(turns), yaw_rad**2), yaw_rad * turns, turns**2]
        )
        self._weight = 0.998 * self._weight + weight
        if self._weight < _MIN_DELAY_WEIGHT:
            return
        costs = self._sums[0] - self._sums[1] ** 2 / np.maximum(self._sums[2], 1e-12)
        best = int(np.argmin(costs))
        # Change only if the improvement exceeds the noise of the sum.
        if costs[now] - costs[best] > _DELAY_EVIDENCE * costs[best] / self._weight:
            self.delay_ns = int(self._delays_ns[best])
            self.calibration.restart()


class MotionErrorModel:
    """Standard deviations of motions from one source, for example wheels, scaled by their recent errors."""

    def __init__(
        self, base_m: float, per_m: float, per_s: float, base_rad: float, per_rad: float, rad_per_s: float
    ) -> None:
        self._base = (base_m, per_m, base_rad, per_rad)
        self._gap_growth = (per_s, rad_per_s)  # growth over a gap in the scans; not scaled
        self.scale2_m = self.scale2_rad = 1.0

    def sigmas(self, motion: np.ndarray, dt_s: float) -> tuple[float, float]:
        """Return the standard deviations (m, rad) of a predicted motion float64 [3]."""
        base_m, base_rad = self._unit(motion)
        gap_s = max(0.0, dt_s - 0.5)
        sigma_m = base_m * math.sqrt(self.scale2_m) + self._gap_growth[0] * gap_s
        return sigma_m, base_rad * math.sqrt(self.scale2_rad) + self._gap_growth[1] * gap_s

    def _unit(self, motion: np.ndarray) -> tuple[float, float]:
        distance, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
        base_m, per_m, base_rad, per_rad = self._base
        return base_m + per_m * distance, base_rad + per_rad * turn + 0.1 * per_rad * distance

    def update(self, motion: np.ndarray, truth: np.ndarray) -> None:
        """Update the scale with the error of a predicted motion [3] against the matched motion `truth` [3].

        The scale rises quickly and falls slowly.
        """
        error = se2.between(motion, truth)
        unit_m, unit_rad = self._unit(motion)
        ratio_m = min((error[0] ** 2 + error[1] ** 2) / (2.0 * unit_m**2), 400.0)
        ratio_rad = min(error[2] ** 2 / unit_rad**2, 400.0)
        self.scale2_m = _filter_scale(self.scale2_m, ratio_m)
        self.scale2_rad = _filter_scale(self.scale2_rad, ratio_rad)


def _filter_scale(value: float, sample: float) -> float:
    gain = 0.25 if sample > value else 0.03
    return min(max(value + gain * (sample - value), 0.05), 400.0)
