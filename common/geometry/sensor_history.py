"""Joins scans, dynamic-beam masks and poses: the beams of a moving robot at the time of any recent image."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from beamsplat.common.geometry.beams import NO_BEAMS, Beams, deskew_beams, scan_points
from beamsplat.common.geometry.transforms import interpolate, transform_points

EXTRAPOLATE_NS = 200_000_000  # poses are extrapolated this far along the last motion, no further
BEAMS_WITHIN_NS = 150_000_000  # a scan whose middle is further from an image than this is not used for it
_MAX_POSES, _MAX_SCANS = 4096, 256  # that are kept, whatever their stamps: 5 s at 800 Hz and at 50 Hz
_GAP_NS = 2_000_000_000  # poses from before a gap of this length may refer to another odom frame
_RANGE_SIGMA_M = 0.01  # standard deviation of a range, of the accuracy that lidar data sheets state


@dataclass(frozen=True)
class TimedScan:
    """One revolution of a lidar with the time of each beam."""

    stamp_ns: int  # of the first beam
    angle_min_rad: float
    angle_increment_rad: float
    time_increment_s: float
    range_min_m: float
    range_max_m: float
    ranges_m: np.ndarray  # float32 [N]
    moving: np.ndarray | None = None  # bool [N], True = return of a dynamic object; None = unknown

    @classmethod
    def of(cls, scan: Any) -> TimedScan:
        """Return the stamp, beam angles, beam times and ranges of a Scan message as a TimedScan."""
        return cls(
            scan.stamp_ns, scan.angle_min_rad, scan.angle_increment_rad, scan.time_increment_s,
            scan.range_min_m, scan.range_max_m, scan.ranges_m,
        )  # fmt: skip

    @property
    def last_ns(self) -> int:
        """Measurement time (ns) of the last beam."""
        return self.stamp_ns + round(self.time_increment_s * 1e9 * max(len(self.ranges_m) - 1, 0))

    @property
    def middle_ns(self) -> int:
        """Time (ns) halfway through the revolution: mean of the times of the first and the last beam."""
        return (self.stamp_ns + self.last_ns) // 2


class SensorHistory:
    """Poses, scans and dynamic-beam masks of the last `keep_s` seconds.

    Poses are `T_a_body`, where the body moves smoothly in frame a (odom). A scan is complete once a pose at
    or after its last beam is known; its mask, if there is one, has arrived by then, because inputs are merged
    by stamp. With `complete_only`, beams come from complete scans; without, also from the newest scan, whose
    end is placed by extrapolation: one scan earlier, and without a mask.
    """

    def __init__(self, T_body_lidar: np.ndarray, keep_s: float = 5.0, *, complete_only: bool = True) -> None:
        self._T_body_lidar = T_body_lidar
        self._keep_ns = round(keep_s * 1e9)
        self._complete_only = complete_only
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=_MAX_POSES)
        self._incomplete: deque[TimedScan] = deque()
        self._scans: deque[TimedScan] = deque(maxlen=_MAX_SCANS)
        self.expired = 0  # scans dropped because no pose came for them within `keep_s`

    @property
    def newest_pose_ns(self) -> int:
        """Stamp (ns) of the newest pose; -1 if there is no pose."""
        return self._poses[-1][0] if self._poses else -1

    def add_scan(self, scan: TimedScan) -> None:
        """Add a scan; with `complete_only`, the scan is not used before a pose at or after its last beam."""
        if not self._complete_only:
            self._insert(scan)
            return
        if self._incomplete and scan.stamp_ns < self._incomplete[-1].stamp_ns:  # the clock was set back
            self.expired += len(self._incomplete)
            self._incomplete.clear()
        self._incomplete.append(scan)
        while (
            scan.stamp_ns - self._incomplete[0].stamp_ns > self._keep_ns or len(self._incomplete) > _MAX_SCANS
        ):
            self._incomplete.popleft()
            self.expired += 1

    def add_mask(
        self,
        stamp_ns: int,
        moving: np.ndarray,  # bool [N]
    ) -> None:
        """Mark the beams on dynamic objects in the scan with this stamp (ns).

        `moving` is True for these beams. A mask without a matching incomplete scan is ignored.
        """
        for i, scan in enumerate(self._incomplete):
            if scan.stamp_ns == stamp_ns and len(scan.ranges_m) == len(moving):
                self._incomplete[i] = replace(scan, moving=moving)

    def add_pose(self, stamp_ns: int, T_a_body: np.ndarray) -> list[TimedScan]:
        """Add the pose `T_a_body` [4, 4] at a stamp (ns); return the scans that it completes, oldest first.

        A pose that is not newer than the last one (the clock was set back) restarts the history. After a gap
        of 2 s older poses are dropped: a restarted process may use another odom frame.
        """
        if stamp_ns <= self.newest_pose_ns:
            self._poses.clear()
            self._scans.clear()
        if stamp_ns - self.newest_pose_ns > _GAP_NS:
            self._poses.clear()
        self._poses.append((stamp_ns, T_a_body))
        while stamp_ns - self._poses[0][0] > self._keep_ns:
            self._poses.popleft()
        completed = []
        while self._incomplete and self._incomplete[0].last_ns <= stamp_ns:
            completed.append(self._incomplete.popleft())
            self._insert(completed[-1])
        return completed

    def forget_incomplete(self) -> None:
        """Drop the scans that wait for a pose; call it when a new process localizes, in a new odom frame."""
        self._incomplete.clear()

    def _insert(self, scan: TimedScan) -> None:
        if self._scans and scan.stamp_ns < self._scans[-1].stamp_ns:  # the clock was set back
            self._scans.clear()
        self._scans.append(scan)
        while scan.stamp_ns - self._scans[0].stamp_ns > self._keep_ns:
            self._scans.popleft()

    def pose(self, stamp_ns: int) -> np.ndarray | None:
        """Return `T_a_body` float64 [4, 4] at a stamp (ns), interpolated, or extrapolated by at most 0.2 s.

        Return None if the stamp is outside this time range.
        """
        if not self._poses or stamp_ns < self._poses[0][0]:
            return None
        before = self._poses[0]
        for after in self._poses:
            if after[0] >= stamp_ns:
                break
            before = after
        else:
            if stamp_ns - self._poses[-1][0] > EXTRAPOLATE_NS:
                return None
            if len(self._poses) == 1:
                return self._poses[0][1]
            before, after = self._poses[-2], self._poses[-1]
        if after[0] == before[0]:
            return after[1]
        return interpolate(before[1], after[1], (stamp_ns - before[0]) / (after[0] - before[0]))

    def scan_near(self, stamp_ns: int) -> TimedScan | None:
        """Return the scan whose middle time is nearest to a stamp (ns), or None if none is within 0.15 s."""
        if not self._scans:
            return None
        scan = min(self._scans, key=lambda s: abs(s.middle_ns - stamp_ns))
        return scan if abs(scan.middle_ns - stamp_ns) <= BEAMS_WITHIN_NS else None

    def beams(self, stamp_ns: int) -> tuple[Beams, int]:
        """Return the static returns of the scan nearest to a stamp (ns), and its age.

        The returns are in the body frame at the stamp (motion-compensated). The age is the stamp minus the
        middle time of the scan, in ns; it can be negative.
        """
        scan = self.scan_near(stamp_ns)
        if scan is None:
            return NO_BEAMS, 0
        return self.beams_of(scan, stamp_ns), stamp_ns - scan.middle_ns

    def beams_of(self, scan: TimedScan, stamp_ns: int) -> Beams:
        """Return the static returns of a scan in the body frame at a stamp (ns).

        The result is empty if the pose at the first beam, at the last beam or at the stamp is unknown.
        """
        points, index = scan_points(
            scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m
        )
        if scan.moving is not None and len(scan.moving) == len(scan.ranges_m):
            still = ~scan.moving[index]
            points, index = points[still], index[still]
        first, last, then = self.pose(scan.stamp_ns), self.pose(scan.last_ns), self.pose(stamp_ns)
        if first is None or last is None or then is None:
            return NO_BEAMS
        fraction = index / max(len(scan.ranges_m) - 1, 1)
        moved = deskew_beams(points, fraction, first, last, then, self._T_body_lidar)
        return Beams(moved, index, np.full(len(index), _RANGE_SIGMA_M))

    def moving_returns(self, stamp_ns: int) -> np.ndarray:
        """Return lidar points on dynamic objects, float64 [N, 3] (m), in the body frame at a stamp (ns)."""
        scan = self.scan_near(stamp_ns)
        if scan is None or scan.moving is None or not scan.moving.any():
            return np.zeros((0, 3))
        return self.beams_of(replace(scan, moving=~scan.moving), stamp_ns).points_body_m

    def decided_scan_near(self, stamp_ns: int) -> bool:
        """Return whether the result of `scan_near` for a stamp (ns) is final.

        It is not final while an incomplete scan, which waits for a pose, is nearer to the stamp.
        """
        if not self._incomplete:
            return True
        known = self.scan_near(stamp_ns)
        best_ns = BEAMS_WITHIN_NS if known is None else abs(known.middle_ns - stamp_ns)
        return all(abs(scan.middle_ns - stamp_ns) >= best_ns for scan in self._incomplete)

    def scan_points_a(self, scan: TimedScan) -> np.ndarray:
        """Return the static returns of a scan, float64 [N, 3] (m), in frame a (odom)."""
        T_a_body = self.pose(scan.middle_ns)
        if T_a_body is None:
            return np.zeros((0, 3))
        return transform_points(T_a_body, self.beams_of(scan, scan.middle_ns).points_body_m)
