"""Lidar beams: deskewing to the time of an image, projection into the camera, and the depth they predict.

A planar lidar takes about 0.1 s per revolution while the robot moves, so each beam is transformed by the
robot's motion between the beam's time and the image's time (deskewing). The `stixel` depth prior assumes a
vertical surface at each beam (`wall_depth`) and a horizontal floor (`plane_depth`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse, so3_log, transform_points


@dataclass(frozen=True)
class Beams:
    """Lidar returns of one or more scans, as points in the body frame at one common time."""

    points_body_m: np.ndarray  # float64 [N, 3]
    index: np.ndarray  # int64 [N]: number of the beam within its scan
    sigma_m: np.ndarray  # float64 [N]: standard deviation, range noise and motion uncertainty combined

    def __len__(self) -> int:
        return len(self.index)

    def take(self, keep: np.ndarray) -> Beams:
        """Return the beams selected by a boolean mask [N] or an index array."""
        return Beams(self.points_body_m[keep], self.index[keep], self.sigma_m[keep])


NO_BEAMS = Beams(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))


def scan_points(
    ranges_m: np.ndarray,  # float32 [N], no return = inf
    angle_min_rad: float,
    angle_increment_rad: float,
    range_min_m: float,
    range_max_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Convert the valid ranges of a planar scan to points in the lidar frame.

    Returns:
        Points float64 [M, 3] (m) in the lidar frame, and int64 [M]: the number of the beam of each point.
    """
    ranges = np.asarray(ranges_m, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        index = np.flatnonzero((ranges > range_min_m) & (ranges < range_max_m))
    angle = angle_min_rad + index * angle_increment_rad
    r = ranges[index]
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.zeros_like(r)], axis=1), index


def deskew_beams(
    points_lidar_m: np.ndarray,  # float64 [N, 3]
    fraction: np.ndarray,  # float64 [N]: time of each beam, 0 at T_map_body_first, 1 at T_map_body_last
    T_map_body_first: np.ndarray,
    T_map_body_last: np.ndarray,
    T_map_body_image: np.ndarray,
    T_body_lidar: np.ndarray,
) -> np.ndarray:
    """Return lidar points float64 [N, 3] (m) in the body frame of the image's time (motion compensation).

    Between the first and the last beam the rotation is interpolated on the geodesic, the translation
    linearly.
    """
    on_body = transform_points(T_body_lidar, np.asarray(points_lidar_m, dtype=np.float64))
    T_image_map = inverse(T_map_body_image)
    first, last = T_image_map @ T_map_body_first, T_image_map @ T_map_body_last
    turn = so3_log(first[:3, :3].T @ last[:3, :3])
    turned = rotate_by_fraction(on_body, turn, fraction)
    shift = first[:3, 3] + fraction[:, None] * (last[:3, 3] - first[:3, 3])
    return turned @ first[:3, :3].T + shift


def rotate_by_fraction(
    points: np.ndarray, rotation_vector_rad: np.ndarray, fraction: np.ndarray
) -> np.ndarray:
    """Rotate each point [N, 3] by its own fraction [N] of one rotation vector [3] (Rodrigues' formula)."""
    angle = float(np.linalg.norm(rotation_vector_rad))
    if angle < 1e-12:
        return points.copy()
    axis = rotation_vector_rad / angle
    cos, sin = np.cos(angle * fraction)[:, None], np.sin(angle * fraction)[:, None]
    along = (points @ axis)[:, None] * axis
    return points * cos + np.cross(axis, points) * sin + along * (1.0 - cos)


def project_beams(
    beams: Beams, camera: Pinhole, T_body_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project lidar returns into the image; omit returns outside the image or occluded from the camera.

    Returns:
        Pixels (u, v) float64 [M, 2], optical z (m) float64 [M], and indices int64 [M] into `beams`.
    """
    points_camera = transform_points(inverse(T_body_camera), beams.points_body_m)
    uv, inside = camera.project(points_camera)
    inside &= ~occluded_beams(beams.points_body_m, T_body_camera)
    seen = np.flatnonzero(inside)
    return uv[seen], points_camera[seen, 2], seen


def occluded_beams(
    points_body_m: np.ndarray, T_body_camera: np.ndarray, half_width_rad: float = 0.006, gap: float = 0.10
) -> np.ndarray:
    """Return a mask bool [N] of the beams that a nearer surface occludes from the camera.

    Camera and lidar have different positions, so the lidar measures points that the camera cannot see. A beam
    is occluded if another beam within `half_width_rad` of its azimuth, seen from the camera, is nearer by
    more than the fraction `gap` of its range (at least 5 cm).
    """
    count = len(points_body_m)
    if count == 0:
        return np.zeros(0, dtype=bool)
    azimuth, range_m = azimuth_and_range(points_body_m, T_body_camera)
    order = np.argsort(azimuth, kind="stable")
    a, r = azimuth[order], range_m[order]
    first = np.searchsorted(a, a - half_width_rad, side="left")
    stop = np.searchsorted(a, a + half_width_rad, side="right")
    # Sliding-window minimum by direct comparison: a window holds only a few beams.
    nearest = r.copy()
    i = np.arange(count)
    for step in range(1, int(max((stop - i).max(), (i - first).max())) + 1):
        left, right = i - step, i + step
        ok = left >= first
        nearest[ok] = np.minimum(nearest[ok], r[left[ok]])
        ok = right < stop
        nearest[ok] = np.minimum(nearest[ok], r[right[ok]])
    hidden = np.zeros(count, dtype=bool)
    hidden[order] = nearest < r - np.maximum(gap * r, 0.05)
    return hidden


def azimuth_and_range(points_body_m: np.ndarray, T_body_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth (rad) [N] and horizontal range (m) [N] of points [N, 3] from the camera centre.

    Azimuths are in the x-y plane of the body frame: 0 = body x axis, positive to the left.
    """
    x = points_body_m[:, 0] - T_body_camera[0, 3]
    y = points_body_m[:, 1] - T_body_camera[1, 3]
    return np.arctan2(y, x), np.hypot(x, y)


def wall_ranges(
    azimuth_rad: np.ndarray,  # float64 [M]: query azimuths
    beam_azimuth_rad: np.ndarray,  # float64 [N]
    beam_range_m: np.ndarray,  # float64 [N]
    max_gap_rad: float = 0.03,
) -> np.ndarray:
    """Return the horizontal range float64 [M] of the surface at each azimuth, interpolated between beams.

    Between two beams on the same surface, 1/r is interpolated linearly in the angle, which is a good
    approximation of a straight wall. At a range discontinuity the beam nearest in angle is used. The result
    is NaN where no beam is within `max_gap_rad`.
    """
    if len(beam_azimuth_rad) == 0:
        return np.full(np.shape(azimuth_rad), np.nan)
    order = np.argsort(beam_azimuth_rad, kind="stable")
    a, r = beam_azimuth_rad[order], beam_range_m[order]
    right = np.clip(np.searchsorted(a, azimuth_rad), 1, max(len(a) - 1, 1))
    if len(a) == 1:
        return np.where(np.abs(azimuth_rad - a[0]) < max_gap_rad, r[0], np.nan)
    left = right - 1
    span = np.maximum(a[right] - a[left], 1e-9)
    f = np.clip((azimuth_rad - a[left]) / span, 0.0, 1.0)
    smooth = np.abs(r[right] - r[left]) < np.maximum(0.05, 0.15 * np.minimum(r[left], r[right]))
    inverse_r = (1.0 - f) / r[left] + f / r[right]
    value = np.where(smooth, 1.0 / inverse_r, np.where(f < 0.5, r[left], r[right]))
    distance = np.minimum(np.abs(azimuth_rad - a[left]), np.abs(azimuth_rad - a[right]))
    return np.where(distance < max_gap_rad, value, np.nan)


def wall_depth(
    rays_body: np.ndarray,  # float64 [..., 3]: camera rays (z_camera = 1) rotated into the body frame
    beam_azimuth_rad: np.ndarray,
    beam_range_m: np.ndarray,
) -> np.ndarray:
    """Return the optical z (m) [...] where each ray meets the vertical surface at its azimuth.

    The result is NaN where no beam is near (see `wall_ranges`).
    """
    across = np.hypot(rays_body[..., 0], rays_body[..., 1])
    azimuth = np.arctan2(rays_body[..., 1], rays_body[..., 0])
    flat = wall_ranges(azimuth.ravel(), beam_azimuth_rad, beam_range_m).reshape(azimuth.shape)
    return flat / np.maximum(across, 1e-9)


def plane_depth(rays_body: np.ndarray, camera_z_m: float, plane_z_m: float = 0.0) -> np.ndarray:
    """Return the optical z (m) [...] where each ray meets the plane z = `plane_z_m` of the body frame.

    `rays_body` [..., 3] are camera rays (z_camera = 1) rotated into the body frame, `camera_z_m` is the
    camera's height in it. The result is NaN where a ray does not meet the plane.
    """
    rise = rays_body[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (plane_z_m - camera_z_m) / rise
    return np.where(np.isfinite(z) & (z > 0.0), z, np.nan)
