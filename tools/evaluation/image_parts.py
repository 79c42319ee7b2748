"""Parts of an image by the height, the distance and the edges of the true surface.

Heights are computed from the true depth and the pose of the camera, so they do not depend on an estimate of
depth. They are heights above the floor of the scene.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

# Parts of each grouping, in the order of their numbers in the label maps.
PARTS: dict[str, tuple[str, ...]] = {
    "height": (
        "floor", "lower 0.25 m and lidar line", "0.25 to 1.2 m", "1.2 m to the ceiling", "ceiling",
    ),
    "distance": ("below 1 m", "1 to 2 m", "2 to 4 m", "4 to 8 m", "beyond 8 m"),
    "edges": ("depth edges", "away from edges"),
}  # fmt: skip
OUTSIDE = -1  # label of pixels without true depth

_FLOOR_M = 0.03  # pixels within this height of the floor are floor
_LOWER_M, _MIDDLE_M = 0.25, 1.2
_LIDAR_LINE_M = 0.06  # above and below the lidar plane
_CEILING_M = 0.05  # pixels this near to a ceiling belong to it
_DISTANCES_M = (1.0, 2.0, 4.0, 8.0)
_EDGE_LOG = 0.1  # step of log depth between neighbours that is an edge
_EDGE_REACH = 4 / 640  # of the image width: pixels this near to an edge belong to it

_BIN_M = 0.02  # of the histogram of heights
_LOWEST_CEILING_M, _HIGHEST_M = 1.8, 6.0
_PLANE_SHARE = 0.02  # least share of the pixels on a horizontal plane
_PLANE_CONTRAST = 3.0  # least ratio of a plane's pixels to those of a typical height


@dataclass(frozen=True)
class SceneHeights:
    """Heights (z of the frame of the poses, m) of the floor and of the ceilings of a scene."""

    floor_m: float
    ceilings_m: tuple[float, ...]  # above the floor; empty if none was found
    lidar_m: float | None  # lidar plane above the floor; None if it does not stay level


def find_scene_heights(
    heights_m: np.ndarray, *, floor_m: float | None, lidar_m: float | None
) -> SceneHeights | None:
    """Return floor and ceilings of a scene, found as peaks in the histogram of heights.

    Args:
        heights_m: z of true surface points of all images, float [N], m.
        floor_m: z of the floor if it is known; None: the lowest horizontal plane is the floor.
        lidar_m: z of the lidar plane, if it stays level.

    Returns:
        None if the floor is not known and not in view.
    """
    if floor_m is None:
        planes = _horizontal_planes(heights_m)
        floor_m = next((z for z in planes if np.mean(heights_m < z - 2 * _BIN_M) < _PLANE_SHARE), None)
        if floor_m is None:
            return None
    above = heights_m - floor_m
    high = above[(above > _LOWEST_CEILING_M) & (above < _HIGHEST_M)]
    ceilings = tuple(_horizontal_planes(high)) if len(high) >= _PLANE_SHARE * len(above) else ()
    return SceneHeights(float(floor_m), ceilings, None if lidar_m is None else lidar_m - floor_m)


def _horizontal_planes(heights_m: np.ndarray) -> list[float]:
    """Return the heights, lowest first, at which many more points are than at a typical height."""
    if len(heights_m) == 0:
        return []
    low = np.floor(heights_m.min() / _BIN_M) * _BIN_M
    counts = np.bincount(((heights_m - low) / _BIN_M).astype(np.int64)).astype(np.float64)
    near = np.convolve(counts, np.ones(3), "same")
    typical = 3.0 * float(np.median(counts[counts > 0]))
    least = max(_PLANE_SHARE * len(heights_m), _PLANE_CONTRAST * typical)
    padded = np.concatenate([[0.0], near, [0.0]])
    peaks = np.flatnonzero((near >= least) & (near > padded[:-2]) & (near >= padded[2:]))
    found = []
    for k in peaks.tolist():
        first, stop = max(k - 1, 0), min(k + 2, len(counts))
        centre = np.average(np.arange(first, stop) + 0.5, weights=counts[first:stop])
        found.append(float(low + centre * _BIN_M))
    return found


def point_heights(
    truth_m: np.ndarray,  # float32 [H, W] optical z, NaN = unknown
    rays: np.ndarray,  # float64 [H, W, 3] with z = 1
    T_map_camera: np.ndarray,
) -> np.ndarray:
    """Return z in the map frame of the true surface points, float64 [H, W] in m, NaN where unknown."""
    return (rays @ T_map_camera[2, :3]) * truth_m + T_map_camera[2, 3]


def sampled_heights(
    views: Iterable[tuple[np.ndarray, np.ndarray]], rays: np.ndarray, every_px: int = 8
) -> np.ndarray:
    """Return the heights float64 [N] (m) of true surface points of all views, in the map frame.

    Args:
        views: true depth float32 [H, W] (m, NaN = unknown) and `T_map_camera` [4, 4] of each image.
        rays: float64 [H, W, 3] with z = 1.
        every_px: distance of the pixels that are used, in each direction.
    """
    some = rays[::every_px, ::every_px]
    found = [point_heights(truth[::every_px, ::every_px], some, T).ravel() for truth, T in views]
    flat = np.concatenate(found) if found else np.zeros(0)
    return flat[np.isfinite(flat)]


def label_heights(heights_m: np.ndarray, scene: SceneHeights) -> np.ndarray:
    """Return int8 [H, W]: number of the part in `PARTS["height"]`, `OUTSIDE` where the height is NaN.

    `heights_m` float [H, W] is z in the frame of the poses.
    """
    above = heights_m - scene.floor_m
    with np.errstate(invalid="ignore"):
        label = np.digitize(above, [_LOWER_M, _MIDDLE_M]).astype(np.int8) + 1
        if scene.lidar_m is not None:
            label[np.abs(above - scene.lidar_m) <= _LIDAR_LINE_M] = 1
        label[above <= _FLOOR_M] = 0
        for ceiling in scene.ceilings_m:
            label[np.abs(above - ceiling) <= _CEILING_M] = 4
    label[~np.isfinite(heights_m)] = OUTSIDE
    return label


def label_distances(truth_m: np.ndarray) -> np.ndarray:
    """Return int8 [H, W]: number of the part in `PARTS["distance"]`, `OUTSIDE` where the depth is NaN."""
    label = np.digitize(truth_m, _DISTANCES_M).astype(np.int8)
    label[~np.isfinite(truth_m)] = OUTSIDE
    return label


def label_edges(truth_m: np.ndarray) -> np.ndarray:
    """Return int8 [H, W]: number of the part in `PARTS["edges"]`, `OUTSIDE` where the depth is NaN.

    Depth edges are the pixels within 4 px (of 640 px of width) of a step of more than 10 % of true depth.
    """
    log_z = np.log(truth_m)
    edge = np.zeros(truth_m.shape, np.uint8)
    with np.errstate(invalid="ignore"):
        edge[:, 1:] |= np.abs(np.diff(log_z, axis=1)) > _EDGE_LOG
        edge[1:] |= np.abs(np.diff(log_z, axis=0)) > _EDGE_LOG
    reach = max(1, round(_EDGE_REACH * truth_m.shape[1]))
    near = cv2.dilate(edge, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    label = np.where(near, 0, 1).astype(np.int8)
    label[~np.isfinite(truth_m)] = OUTSIDE
    return label
