"""Drawing a moving robot: rate limits, recent poses, a bounded path, a sweep in the world frame."""

from __future__ import annotations

from collections import deque

import numpy as np

from beamsplat.common.geometry.transforms import interpolate, transform_points

RECENT_POSES = 200
REACH_NS = 500_000_000  # a pose stands for times this close beyond the first and the last one


class RateLimit:
    """At most so many drawings a second of each kind, by measurement time."""

    def __init__(self, max_hz: dict[str, float]) -> None:
        self._period_ns = {kind: round(1e9 / hz) if hz > 0.0 else None for kind, hz in max_hz.items()}
        self._last_ns: dict[str, int] = {}

    def due(self, kind: str, stamp_ns: int, key: str = "") -> bool:
        """Whether to draw `kind` (of entity `key`) now; True counts as drawn. A kind at 0 Hz never is.

        A stamp before the last one (a recording that loops) starts afresh. A stream whose own rate
        is the limit passes whole: a tenth of the period is forgiven, for jitter.
        """
        period_ns = self._period_ns[kind]
        if period_ns is None:
            return False
        last_ns = self._last_ns.get(kind + key)
        if last_ns is not None and 0 <= stamp_ns - last_ns < period_ns - period_ns // 10:
            return False
        self._last_ns[kind + key] = stamp_ns
        return True


class PoseBuffer:
    """The last poses `T_world_body` of one source."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=RECENT_POSES)

    def __bool__(self) -> bool:
        return bool(self._poses)

    @property
    def newest(self) -> tuple[int, np.ndarray]:
        """(stamp_ns, T_world_body [4, 4]) of the last one."""
        return self._poses[-1]

    def add(self, stamp_ns: int, T_world_body: np.ndarray) -> None:
        """Takes the next pose [4, 4]; one from before the last (a recording that loops) starts afresh."""
        if self._poses and stamp_ns < self._poses[-1][0]:
            self._poses.clear()
        self._poses.append((stamp_ns, T_world_body))

    def at(self, stamp_ns: int) -> np.ndarray | None:
        """`T_world_body` [4, 4] at a time: interpolated, held `REACH_NS` beyond both ends, else None."""
        if not self._poses:
            return None
        after = next((i for i, (stamp, _) in enumerate(self._poses) if stamp >= stamp_ns), None)
        if after is None or after == 0:
            stamp, T = self._poses[-1 if after is None else 0]
            return T if abs(stamp_ns - stamp) <= REACH_NS else None
        (stamp_0, T_0), (stamp_1, T_1) = self._poses[after - 1], self._poses[after]
        return interpolate(T_0, T_1, (stamp_ns - stamp_0) / (stamp_1 - stamp_0))


class BoundedPath:
    """Where something has been, in at most `max_points` vertices however long it drives.

    Vertices are `step_m` apart; when there are too many, every other one goes and the step doubles.
    """

    def __init__(self, max_points: int, step_m: float) -> None:
        self._max_points = max_points
        self._step_m = step_m
        self._points: list[np.ndarray] = []
        self._newest: np.ndarray | None = None

    def add(self, point_m: np.ndarray) -> None:
        """Takes the next position [3]."""
        point_m = np.array(point_m, dtype=np.float32)
        self._newest = point_m
        if self._points and np.linalg.norm(point_m - self._points[-1]) < self._step_m:
            return
        self._points.append(point_m)
        if len(self._points) >= self._max_points:
            self._points = self._points[::2]
            self._step_m *= 2.0

    def clear(self) -> None:
        """Forgets where it was."""
        self._points.clear()
        self._newest = None

    @property
    def points_m(self) -> np.ndarray:
        """float32 [N, 3], the newest position always last."""
        ends = [] if self._newest is None else [self._newest]
        return np.array(self._points + ends, dtype=np.float32).reshape(-1, 3)


def scan_points(
    ranges_m: np.ndarray,  # float32 [N], anything that is not a return is left out
    angle_min_rad: float,
    angle_increment_rad: float,
    range_limits_m: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """(points in the lidar frame float64 [M, 3], index of each one's beam int64 [M])."""
    nearest, farthest = range_limits_m
    with np.errstate(invalid="ignore"):
        hit = np.isfinite(ranges_m) & (ranges_m > 0.0) & (ranges_m >= nearest) & (ranges_m <= farthest)
    beams = np.flatnonzero(hit)
    angles = angle_min_rad + angle_increment_rad * beams
    ranges = ranges_m[beams].astype(np.float64)
    points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(beams))], axis=-1)
    return points, beams


def sweep_to_world(
    points_body: np.ndarray,  # float64 [M, 3]
    share: np.ndarray,  # float64 [M], 0 at the first beam of the sweep .. 1 at the end
    T_world_body0: np.ndarray,
    T_world_body1: np.ndarray,
) -> np.ndarray:
    """float64 [M, 3] in the world: each point by the pose of its time, blended linearly between the poses
    at the two ends. For a turn of a within one sweep that is short by a^2/8 of the range: for the eye."""
    start, end = transform_points(T_world_body0, points_body), transform_points(T_world_body1, points_body)
    return start + share[:, None] * (end - start)
