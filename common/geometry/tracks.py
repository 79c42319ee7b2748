"""Helpers to draw a moving robot: rate limits, a pose buffer, a path of bounded size, deskewed scans."""

from __future__ import annotations

from collections import deque

import numpy as np

from beamsplat.common.geometry.transforms import interpolate, transform_points

RECENT_POSES = 200  # 20 s at 10 Hz
_MAX_ENTITIES = 10_000  # whose time of drawing is kept
REACH_NS = 500_000_000  # the first and last poses are held constant for this long outside the covered time


class RateLimit:
    """Limits the rate of drawing per kind of data, by measurement time."""

    def __init__(self, max_hz: dict[str, float]) -> None:
        self._period_ns = {kind: round(1e9 / hz) if hz > 0.0 else None for kind, hz in max_hz.items()}
        self._last_ns: dict[str, int] = {}

    def due(self, kind: str, stamp_ns: int, key: str = "") -> bool:
        """Return whether to draw data of this kind (and entity `key`) with this stamp (ns).

        A True result is recorded: the caller must draw.

        A kind with a limit of 0 Hz is never drawn. A stamp earlier than the last one (a recording that loops)
        resets the limit. A tenth of the period is tolerated as jitter, so that a stream whose rate equals the
        limit is drawn completely.
        """
        period_ns = self._period_ns[kind]
        if period_ns is None:
            return False
        last_ns = self._last_ns.get(kind + key)
        if last_ns is not None and 0 <= stamp_ns - last_ns < period_ns - period_ns // 10:
            return False
        self._last_ns.pop(kind + key, None)  # the entity drawn longest ago is the first one
        self._last_ns[kind + key] = stamp_ns
        if len(self._last_ns) > _MAX_ENTITIES:
            del self._last_ns[next(iter(self._last_ns))]
        return True


class PoseBuffer:
    """Buffer of the last `RECENT_POSES` poses `T_world_body` of one source, with interpolation."""

    def __init__(self) -> None:
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=RECENT_POSES)

    def __bool__(self) -> bool:
        return bool(self._poses)

    @property
    def newest(self) -> tuple[int, np.ndarray]:
        """The last pose as (stamp_ns, T_world_body [4, 4])."""
        return self._poses[-1]

    def add(self, stamp_ns: int, T_world_body: np.ndarray) -> None:
        """Append a pose [4, 4]; a stamp earlier than the last one (a looping recording) clears the buffer."""
        if self._poses and stamp_ns < self._poses[-1][0]:
            self._poses.clear()
        self._poses.append((stamp_ns, T_world_body))

    def at(self, stamp_ns: int) -> np.ndarray | None:
        """Return the interpolated `T_world_body` [4, 4] at a stamp.

        Outside the covered time the nearest pose is returned up to `REACH_NS` away, None beyond that.
        """
        if not self._poses:
            return None
        after = next((i for i, (stamp, _) in enumerate(self._poses) if stamp >= stamp_ns), None)
        if after is None or after == 0:
            stamp, T = self._poses[-1 if after is None else 0]
            return T if abs(stamp_ns - stamp) <= REACH_NS else None
        (stamp_0, T_0), (stamp_1, T_1) = self._poses[after - 1], self._poses[after]
        return interpolate(T_0, T_1, (stamp_ns - stamp_0) / (stamp_1 - stamp_0))


class BoundedPath:
    """Path of a moving object as a polyline of at most `max_points` vertices.

    Vertices are at least `step_m` apart; at `max_points`, every second vertex is removed and the step
    doubled.
    """

    def __init__(self, max_points: int, step_m: float) -> None:
        self._max_points = max_points
        self._step_m = step_m
        self._points: list[np.ndarray] = []
        self._newest: np.ndarray | None = None

    def add(self, point_m: np.ndarray) -> None:
        """Append the next position [3]."""
        point_m = np.array(point_m, dtype=np.float32)
        self._newest = point_m
        if self._points and np.linalg.norm(point_m - self._points[-1]) < self._step_m:
            return
        self._points.append(point_m)
        if len(self._points) >= self._max_points:
            self._points = self._points[::2]
            self._step_m *= 2.0

    def clear(self) -> None:
        """Remove all vertices."""
        self._points.clear()
        self._newest = None

    @property
    def points_m(self) -> np.ndarray:
        """Vertices float32 [N, 3]; the last one is the newest position."""
        ends = [] if self._newest is None else [self._newest]
        return np.array(self._points + ends, dtype=np.float32).reshape(-1, 3)


def scan_points(
    ranges_m: np.ndarray,  # float32 [N]; values that are not valid returns are omitted
    angle_min_rad: float,
    angle_increment_rad: float,
    range_limits_m: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of valid ranges, float64 [M, 3] (m, lidar frame), and their beam numbers [M]."""
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
    share: np.ndarray,  # float64 [M]: time of each beam, 0 at the start of the sweep, 1 at its end
    T_world_body0: np.ndarray,
    T_world_body1: np.ndarray,
) -> np.ndarray:
    """Deskew one lidar revolution for display: return its points float64 [M, 3] (m) in the world frame.

    Each point is interpolated linearly between its positions under the two body poses: at `share` 0 (start of
    the revolution) under `T_world_body0`, at 1 (end) under `T_world_body1`. With a rotation by `a` rad per
    revolution the error is up to a^2/8 of the range, small enough for drawing.
    """
    start, end = transform_points(T_world_body0, points_body), transform_points(T_world_body1, points_body)
    return start + share[:, None] * (end - start)
