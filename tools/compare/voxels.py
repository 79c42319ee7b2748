"""Evidence of the camera: surfaces of one session in space that the other one has seen to be free."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.tools.compare.drive import DepthView

VOXEL_M = 0.05
MAX_RANGE_M = 4.0  # farther, the standard deviation of the depth is larger than furniture
# A view looks through a point if its depth is behind it by so many standard deviations of the difference: for
# evidence that stands alone, and for evidence that the lidar confirms.
STRONG_SIGMAS, WEAK_SIGMAS = 2.0, 1.0
_NEAR_M = 0.2  # nearer, a surface fills the image
MIN_VIEWS = 2  # keyframes that saw the surface
MIN_THROUGH = 3  # keyframes of the other session that looked through it
THERE_RATIO, GONE_RATIO = 0.5, 0.25  # of the views that decide: above it a surface is there, below it is not


@dataclass(frozen=True)
class SurfaceVoxels:
    """Voxels with a surface: the means of its points and of their colours in each."""

    points_m: np.ndarray  # float64 [N, 3] in the common frame
    colours: np.ndarray  # uint8 [N, 3]
    sigma_m: np.ndarray  # float64 [N], standard deviation of the depth in the view that measured it best


@dataclass(frozen=True)
class ChangedVoxels:
    """Voxels of one kind that changed, with the number of keyframes that say so."""

    points_m: np.ndarray  # float64 [N, 3]
    strong: np.ndarray  # bool [N], the evidence stands alone; else it needs that of the lidar
    seen: np.ndarray  # int32 [N], keyframes that saw the surface
    through: np.ndarray  # int32 [N], keyframes of the other session that looked through it


@dataclass(frozen=True)
class ViewVotes:
    """How many keyframes of a session saw a surface at each of N voxels, and how many looked through it."""

    hits: np.ndarray  # int32 [N]
    through: np.ndarray  # int32 [N]


def surface_voxels(views: Iterable[DepthView]) -> SurfaceVoxels:
    """Return the voxels on the surfaces that the map of a session shows at its keyframes within range."""
    keys, means, sigmas = [np.zeros(0, np.int64)], [np.zeros((0, 6))], [np.zeros(0)]
    for view in views:
        rows, sigma_m = _points(view)
        x, y, z = (np.floor(rows[:, :3] / VOXEL_M).astype(np.int64) + (1 << 20)).T
        key, mean, least = _by_key((x << 42) | (y << 21) | z, rows, sigma_m)
        keys.append(key)
        means.append(mean)
        sigmas.append(least)
    joined = np.concatenate(keys)
    key, mean, least = _by_key(joined, np.concatenate(means), np.concatenate(sigmas))
    many = np.unique(joined, return_counts=True)[1] >= MIN_VIEWS
    return SurfaceVoxels(mean[many, :3], (mean[many, 3:] + 0.5).astype(np.uint8), least[many])


def _by_key(
    keys: np.ndarray, rows: np.ndarray, sigma_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unique keys [M], ascending, the mean row [M, 6] and the smallest sigma [M] of each."""
    unique, which, count = np.unique(keys, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(which, column, len(unique)) for column in rows.T], axis=1)
    least = np.full(len(unique), np.inf)
    np.minimum.at(least, which, sigma_m)
    return unique, mean / np.maximum(count, 1)[:, None], least


def _points(view: DepthView) -> tuple[np.ndarray, np.ndarray]:
    """Return the rendered surface of a view within range, where the depth was measured too.

    Returns:
        Rows float64 [N, 6]: x, y, z (m) in the common frame, red, green, blue; and the standard deviations of
        the measured depth [N] (m).
    """
    with np.errstate(invalid="ignore"):
        v, u = np.nonzero((view.rendered_m < MAX_RANGE_M) & np.isfinite(view.sigma_m))
    c, z = view.camera, view.rendered_m[v, u].astype(np.float64)
    local = np.stack([(u - c.cx_px) / c.fx_px * z, (v - c.cy_px) / c.fy_px * z, z], axis=1)
    points = local @ view.T_map_camera[:3, :3].T + view.T_map_camera[:3, 3]
    return np.column_stack([points, view.rgb[v, u]]), view.sigma_m[v, u].astype(np.float64)


def changed_voxels(
    surface: SurfaceVoxels, own: list[DepthView], other: list[DepthView], sigma_m: float
) -> ChangedVoxels:
    """Return the voxels that their own session saw as surface, and the other one as free space.

    Args:
        own, other: views of both sessions.
        sigma_m: standard deviation of the distance between equal surfaces of both maps: the alignment.
    """
    seen = count_views(surface, own, 0.0, STRONG_SIGMAS)
    there = (seen.hits >= MIN_VIEWS) & (seen.hits > THERE_RATIO * (seen.hits + seen.through))
    gone = []
    for sigmas in (STRONG_SIGMAS, WEAK_SIGMAS):
        votes = count_views(surface, other, sigma_m, sigmas)
        passed = (votes.through >= MIN_THROUGH) & (votes.hits < GONE_RATIO * (votes.hits + votes.through))
        gone.append(there & passed)
    chosen = gone[1] | gone[0]
    return ChangedVoxels(surface.points_m[chosen], gone[0][chosen], seen.hits[chosen], votes.through[chosen])


def count_views(
    surface: SurfaceVoxels, views: Iterable[DepthView], sigma_m: float, sigmas: float
) -> ViewVotes:
    """Return how many views hit, and how many look through, each voxel.

    A view looks through a voxel if the depth that it measured, and the depth of its own map, are both behind
    it by `sigmas` standard deviations of the difference, also in the neighbouring pixels.

    Args:
        sigma_m: standard deviation of the distance between equal surfaces of both maps; 0: one map.
    """
    hits, through = (np.zeros(len(surface.points_m), np.int32) for _ in range(2))
    for view in views:
        index, z, row, column = _in_sight(surface.points_m, view)
        sigma = np.nan_to_num(view.sigma_m[row, column].astype(np.float64), nan=np.inf)
        both = np.sqrt(sigma**2 + surface.sigma_m[index] ** 2 + sigma_m**2)
        passed = _nearest(view)[row, column] - z > sigmas * both + 0.5 * VOXEL_M
        with np.errstate(invalid="ignore"):
            near = np.abs(view.rendered_m[row, column] - z) <= STRONG_SIGMAS * sigma_m + VOXEL_M
        hits[index[near & ~passed]] += 1
        through[index[passed]] += 1
    return ViewVotes(hits, through)


def _in_sight(points_m: np.ndarray, view: DepthView) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices [M] of the points [N, 3] that a view has in sight, their z (m), row and column."""
    T, c = inverse(view.T_map_camera), view.camera
    x, y, z = (points_m @ T[:3, :3].T + T[:3, 3]).T
    ahead = np.maximum(z, 1e-3)
    u = np.round(x / ahead * c.fx_px + c.cx_px)
    v = np.round(y / ahead * c.fy_px + c.cy_px)
    index = np.flatnonzero(
        (z > _NEAR_M) & (z < MAX_RANGE_M) & (u >= 0) & (v >= 0) & (u < c.width_px) & (v < c.height_px)
    )
    return index, z[index], v[index].astype(int), u[index].astype(int)


def _nearest(view: DepthView) -> np.ndarray:
    """Return float32 [H, W]: the least depth (m), measured or rendered, in 3 x 3 pixels.

    It is 0 where one of them is unknown; unknown neighbours are ignored.
    """
    measured, rendered = view.depth_m.astype(np.float32), view.rendered_m.astype(np.float32)
    nearest = np.minimum(measured, rendered)  # NaN if one of them is
    known = np.isfinite(nearest)
    least = cv2.erode(np.where(known, nearest, np.float32(np.inf)), np.ones((3, 3), np.uint8))
    return np.where(known, least, np.float32(0.0))
