"""Range data processing of a single scan: filtering, deskewing, surface tangents."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel


@dataclass(frozen=True)
class RawScan:
    """One scan (revolution or sweep) of the sensor, unprocessed; `stamp_ns` is the time of the first beam."""

    stamp_ns: int
    ranges_m: np.ndarray  # float32 [N], +inf or >= range_max_m: no return
    angle_min_rad: float
    angle_increment_rad: float
    time_increment_s: float
    range_min_m: float
    range_max_m: float


@dataclass(frozen=True)
class PreparedScan:
    """Valid returns of one scan, deskewed to the stamp of its first beam, in the body frame."""

    points_body: np.ndarray  # float64 [M, 2], metres, deskewed
    tangents: np.ndarray  # float64 [M, 2], unit direction of the surface, (0, 0) where unknown
    spacing_m: np.ndarray  # float64 [M], distance between neighbouring returns on the surface
    beams: np.ndarray  # int32 [M], index into the raw ranges
    match_index: np.ndarray  # int32 [K], evenly spread subset used for matching
    origin_body: np.ndarray  # float64 [2], the lidar in the body frame

    def features(self) -> np.ndarray:
        """Return the input of scan matching, float64 [K, 5]: x, y, tangent x, tangent y, half spacing (m)."""
        i = self.match_index
        return np.column_stack([self.points_body[i], self.tangents[i], half_spacing_m(self.spacing_m[i])])

    def __len__(self) -> int:
        return len(self.points_body)


def half_spacing_m(spacing_m: np.ndarray) -> np.ndarray:
    """Return half the distance to the neighbouring returns as it is used for matching: at most 10 cm."""
    return np.minimum(0.5 * spacing_m, 0.10)


@kernel
def _valid_points(
    ranges_m: np.ndarray,  # float32 [N]
    angle_min_rad: float,
    angle_increment_rad: float,  # negative for a lidar mounted upside down
    time_increment_s: float,
    range_min_m: float,
    range_max_m: float,  # readings at or beyond it are no returns
    pose_body_lidar: np.ndarray,  # float64 [3]
    velocity_body: np.ndarray,  # float64 [3], vx, vy (m/s), yaw rate (rad/s) during the scan
    points: np.ndarray,  # out float64 [N, 2]
    beams: np.ndarray,  # out int32 [N]
) -> int:
    """Write the valid returns, deskewed, in the body frame, and their beam indices; return their number."""
    count = 0
    cl, sl = math.cos(pose_body_lidar[2]), math.sin(pose_body_lidar[2])
    for i in range(ranges_m.shape[0]):
        r = float(ranges_m[i])
        if not (r >= range_min_m and r < range_max_m and r > 0.0):
            continue
        a = angle_min_rad + i * angle_increment_rad
        lx, ly = r * math.cos(a), r * math.sin(a)
        bx = pose_body_lidar[0] + cl * lx - sl * ly
        by = pose_body_lidar[1] + sl * lx + cl * ly
        # Exact motion after t seconds at a constant body twist (half-angle form of the exponential).
        t = i * time_increment_s
        yaw = velocity_body[2] * t
        half = 0.5 * yaw
        sinc = 1.0 - half * half / 6.0 if abs(half) < 1e-3 else math.sin(half) / half
        ch, sh = math.cos(half) * sinc, math.sin(half) * sinc
        mx = (ch * velocity_body[0] - sh * velocity_body[1]) * t
        my = (sh * velocity_body[0] + ch * velocity_body[1]) * t
        c, s = math.cos(yaw), math.sin(yaw)
        points[count, 0] = mx + c * bx - s * by
        points[count, 1] = my + s * bx + c * by
        beams[count] = i
        count += 1
    return count


@kernel
def _tangents(
    points: np.ndarray,  # float64 [M, 2] in beam order
    beams: np.ndarray,  # int32 [M]
    origin: np.ndarray,  # float64 [2]
    increment_rad: float,
    window_m: float,
    tangents: np.ndarray,  # out float64 [M, 2]
    spacing: np.ndarray,  # out float64 [M]
) -> None:
    """Compute surface direction (PCA over connected neighbours within `window_m`) and spacing of returns."""
    m = points.shape[0]
    for i in range(m):
        px, py = points[i, 0], points[i, 1]
        r = math.hypot(px - origin[0], py - origin[1])
        step = max(r * increment_rad, 1e-4)
        gap = 5.0 * step + 0.03  # a surface seen at up to ~78 degrees from its normal stays connected
        n, sx, sy, sxx, sxy, syy = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        near, found = 0.0, 0
        for side in (-1, 1):
            qx, qy, last = px, py, beams[i]
            j, taken = i + side, 0
            while 0 <= j < m and taken < 12:
                d = math.hypot(points[j, 0] - qx, points[j, 1] - qy)
                if abs(beams[j] - last) > 2 or d > gap * abs(beams[j] - last):
                    break
                dx, dy = points[j, 0] - px, points[j, 1] - py
                if taken >= 2 and dx * dx + dy * dy > window_m * window_m:
                    break
                if taken == 0:
                    near += d
                    found += 1
                n += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
                qx, qy, last = points[j, 0], points[j, 1], beams[j]
                j += side
                taken += 1
        spacing[i] = max(near / found, step) if found > 0 else step
        tangents[i, 0] = 0.0
        tangents[i, 1] = 0.0
        if n >= 3.0:
            cxx = sxx / n - (sx / n) ** 2
            cxy = sxy / n - (sx / n) * (sy / n)
            cyy = syy / n - (sy / n) ** 2
            mean = 0.5 * (cxx + cyy)
            root = math.sqrt(max(0.25 * (cxx - cyy) ** 2 + cxy * cxy, 0.0))
            if mean - root < 0.15 * (mean + root):
                angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
                tangents[i, 0] = math.cos(angle)
                tangents[i, 1] = math.sin(angle)


@kernel
def _spread(
    points: np.ndarray,  # float64 [M, 2] in beam order
    spacing: np.ndarray,  # float64 [M]
    step_m: float,
    limit: int,
    keep: np.ndarray,  # out int32 [limit + 1]
) -> int:
    """Select returns at least `step_m` apart along the surface; return the number of indices in `keep`.

    This is an adaptive voxel filter along the beam order: the step grows until at most `limit` returns are
    selected. Distances along the surface are sums of `spacing`. The distance between two returns must not
    decide: it selects the noise that leads away from the last return, which turns walls by milliradians.
    """
    step = step_m
    while True:
        count = 0
        since = 1e18
        for i in range(points.shape[0]):
            if i > 0:
                jump = math.hypot(points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1])
                since += spacing[i] if jump < 3.0 * spacing[i] else jump
            if since >= step:
                if count == limit:
                    count = limit + 1
                    break
                keep[count] = i
                count += 1
                since = 0.0
        if count <= limit:
            return count
        step *= 1.25


def prepare_scan(
    ranges_m: np.ndarray,  # float32 [N]
    angle_min_rad: float,
    angle_increment_rad: float,
    time_increment_s: float,
    range_min_m: float,
    range_max_m: float,
    pose_body_lidar: np.ndarray,  # float64 [3]
    velocity_body: np.ndarray,  # float64 [3]
    min_spacing_m: float,
    match_limit: int,
    tangent_window_m: float = 0.10,
) -> PreparedScan:
    """Filter a scan and deskew it, by the time of each beam, to the stamp of the first beam.

    `velocity_body` is the body twist during the scan (m/s, m/s, rad/s). For matching, at most `match_limit`
    returns are selected, at least `min_spacing_m` apart.
    """
    n = len(ranges_m)
    points = np.empty((n, 2))
    beams = np.empty(n, dtype=np.int32)
    count = _valid_points(
        np.ascontiguousarray(ranges_m, dtype=np.float32),
        angle_min_rad,
        angle_increment_rad,
        time_increment_s,
        range_min_m,
        range_max_m,
        pose_body_lidar,
        velocity_body,
        points,
        beams,
    )
    points, beams = points[:count].copy(), beams[:count].copy()
    tangents, spacing = np.empty((count, 2)), np.empty(count)
    _tangents(
        points,
        beams,
        pose_body_lidar[:2].copy(),
        abs(angle_increment_rad),
        tangent_window_m,
        tangents,
        spacing,
    )
    keep = np.empty(match_limit + 1, dtype=np.int32)
    kept = _spread(points, spacing, min_spacing_m, match_limit, keep)
    return PreparedScan(points, tangents, spacing, beams, keep[:kept].copy(), pose_body_lidar[:2].copy())


def duration_s(raw: RawScan) -> float:
    """Return the time from the first to after the last beam of a scan."""
    return raw.time_increment_s * len(raw.ranges_m)
