"""Pose of one lidar map in another one of the same place, although furniture has moved between them.

Relocalization of single scans gives the pose roughly and says whether it is unique. A point-to-line ICP over
all scans (Chen and Medioni 1991) with a robust weight refines it, then once more for each submap, because
each map is bent by centimetres. Walls outnumber what has moved, whose distances the weight suppresses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.common.errors import UserError
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.merge import find_alignment
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam

_SETTINGS = LidarSlamSettings()
_REACH_M = (0.5, 0.25, 0.15, 0.15, 0.15)  # search radius for the nearest return, by ICP iteration
_POINTS = 20_000  # returns of map b in the ICP of the whole map
_SUBMAP_POINTS = 3_000
# Bend of a map of some rooms between its submaps: prior of the correction of one submap.
_BEND_SIGMA_M, _BEND_SIGMA_RAD = 0.03, math.radians(0.4)
_INLIER_M = 0.05  # a return of b on a surface of a; three times `range_sigma_m`
MIN_INLIER_RATIO = 0.5  # of the returns of b, in a place where furniture has moved
_MIN_AGREEING = 1 / 3  # of the scans that are relocalized: others are in rooms that only one drive has seen
_MIN_OVERLAP = 0.3  # of the returns of b within reach of a surface of a: the drives share that much


@dataclass(frozen=True)
class DriveAlignment:
    """Pose of map b in map a, and the pose of each submap of b in a."""

    pose_a_b: np.ndarray  # float64 [3]
    pose_a_submap: dict[int, np.ndarray]  # by submap id of b, float64 [3]; a little off pose_a_b @ its pose
    sigma_m: float  # standard deviation of the distance between a surface of b and the same surface of a
    inlier_ratio: float  # returns of b on a surface of a, of those within reach of one
    agreeing: int  # scans of b whose relocalization in a agrees
    queried: int  # scans of b that were relocalized; 0 = both are one lidar map, or the pose was given


@dataclass(frozen=True)
class _Lines:
    """Returns of a map as short lines: a point and a normal each."""

    points: np.ndarray  # float64 [N, 2]
    normals: np.ndarray  # float64 [N, 2], (0, 0) where unknown
    submap: np.ndarray  # int64 [N], the first submap that contains the scan

    def some(self, limit: int) -> _Lines:
        """Return at most `limit` of the lines, evenly spread over the drive."""
        step = max(-(-len(self.points) // limit), 1)
        return _Lines(self.points[::step], self.normals[::step], self.submap[::step])


def align_drives(a: LidarSlam, b: LidarSlam, given_pose_a_b: np.ndarray | None = None) -> DriveAlignment:
    """Return the alignment of map b to map a.

    Args:
        given_pose_a_b: float64 [3], roughly (0.3 m, 3 degrees) the pose of map b in map a; None: identity if
            both are states of the same map (same UUID), else by relocalization.

    Raises:
        UserError: the scans do not agree on one pose, or do not fit the map at it; the text says what to do.
    """
    for which, slam in (("first", a), ("second", b)):
        if not any(s.frozen is not None for s in slam.pose_graph.submaps.values()):
            raise UserError(f"the lidar map of the {which} session has no finished submap: drive farther")
    pose_a_b, agreeing, queried = _rough_pose(a, b, given_pose_a_b)
    lines_a, lines_b = _lines_of(a.pose_graph), _lines_of(b.pose_graph)
    tree, some = cKDTree(lines_a.points), lines_b.some(_POINTS)
    pose_a_b = _fit(tree, lines_a, some, pose_a_b, None)
    off = np.abs(_residuals(tree, lines_a, se2.transform(pose_a_b, some.points), _REACH_M[0])[0])
    near = off[np.isfinite(off)]
    inlier_ratio = float((near < _INLIER_M).mean()) if len(near) else 0.0
    if len(near) < _MIN_OVERLAP * len(off) or inlier_ratio < MIN_INLIER_RATIO:
        share = len(near) / max(len(off), 1)
        raise UserError(
            f"{share:.0%} of the returns of the second session are near surfaces of the first, and "
            f"{inlier_ratio:.0%} of these on them: the pose is wrong, or the sessions are of different "
            "places; nothing is compared. Give the pose of the second map with --place X,Y,DEG"
        )
    poses, left = {}, [np.zeros(0)]
    for id, submap in b.pose_graph.submaps.items():
        mine, fitted = _members(lines_b, id).some(_SUBMAP_POINTS), pose_a_b
        if len(mine.points):
            fitted = _fit(tree, lines_a, mine, pose_a_b, pose_a_b)
            left.append(_residuals(tree, lines_a, se2.transform(fitted, mine.points), _REACH_M[-1])[0])
        poses[id] = se2.compose(fitted, submap.pose_map_submap)
    residual = np.abs(np.concatenate(left))
    residual = residual[residual < 2 * _INLIER_M]  # what has moved is farther; NaN is dropped too
    spread_m = 1.4826 * float(np.median(residual)) if len(residual) else 0.0
    sigma_m = max(spread_m, _SETTINGS.range_sigma_m)
    return DriveAlignment(pose_a_b, poses, sigma_m, inlier_ratio, agreeing, queried)


def _rough_pose(a: LidarSlam, b: LidarSlam, given: np.ndarray | None) -> tuple[np.ndarray, int, int]:
    """Return the rough pose of map b in map a, and how many scans of b agree on it, of how many.

    Raises:
        UserError: the scans do not agree on one pose.
    """
    if given is not None:
        return given, 0, 0
    if a.pose_graph.uuid and a.pose_graph.uuid == b.pose_graph.uuid:
        return np.zeros(3), 0, 0
    found = find_alignment(a, b)
    if found is None or _MIN_AGREEING * found.queried > found.agreeing:
        said = "no" if found is None else f"only {found.agreeing} of {found.queried}"
        raise UserError(
            f"{said} scans of the second session agree on one place in the first: nothing is compared, "
            "because every difference could be a wrong place; give the pose of the second map with "
            "--place X,Y,DEG"
        )
    return found.pose_a_b, found.agreeing, found.queried


def _lines_of(graph: PoseGraph) -> _Lines:
    """Return the static returns of all scans in the map frame."""
    owner: dict[int, int] = {}
    for id, submap in graph.submaps.items():
        for member in submap.members:
            owner.setdefault(member, id)
    points, normals, submaps = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for id, node in graph.nodes.items():
        static = ~node.scan.dynamic
        pose, tangents = graph.pose_map_node[id], node.scan.tangents[static]
        turned = se2.transform(np.array([0.0, 0.0, pose[2]]), tangents)
        points.append(se2.transform(pose, node.scan.points[static]))
        normals.append(np.column_stack([-turned[:, 1], turned[:, 0]]))
        submaps.append(np.full(len(tangents), owner.get(id, -1)))
    return _Lines(np.concatenate(points), np.concatenate(normals), np.concatenate(submaps))


def _members(lines: _Lines, submap: int) -> _Lines:
    chosen = lines.submap == submap
    return _Lines(lines.points[chosen], lines.normals[chosen], lines.submap[chosen])


def _fit(
    tree: cKDTree, a: _Lines, b: _Lines, pose_a_b: np.ndarray, prior_pose_a_b: np.ndarray | None
) -> np.ndarray:
    """Return the pose float64 [3] of lines b in lines a by ICP, with a Gaussian prior if there is one."""
    centre = b.points.mean(axis=0)  # rotation about the middle of the points: well conditioned
    for reach_m in _REACH_M:
        moved = se2.transform(pose_a_b, b.points)
        residual, normal = _residuals(tree, a, moved, reach_m)
        used = np.isfinite(residual)
        r, n = residual[used], normal[used]
        arm = moved[used] - se2.transform(pose_a_b, centre[None])[0]
        J = np.column_stack([n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]])
        # Geman-McClure; neighbouring returns have correlated errors.
        w = (1.0 + (r / _SETTINGS.outlier_m) ** 2) ** -2 / _SETTINGS.range_sigma_m**2
        w /= _SETTINGS.returns_per_measurement
        H, g = (J * w[:, None]).T @ J + 1e-6 * np.eye(3), (J * w[:, None]).T @ r
        if prior_pose_a_b is not None:
            P = np.diag([_BEND_SIGMA_M**-2, _BEND_SIGMA_M**-2, _BEND_SIGMA_RAD**-2])
            shift = se2.transform(pose_a_b, centre[None])[0] - se2.transform(prior_pose_a_b, centre[None])[0]
            H, g = H + P, g + P @ np.array([*shift, se2.wrap(pose_a_b[2] - prior_pose_a_b[2])])
        dx, dy, turn = np.linalg.solve(H, -g)
        at = se2.transform(pose_a_b, centre[None])[0] + (dx, dy)
        yaw = se2.wrap(pose_a_b[2] + turn)
        c, s = math.cos(yaw), math.sin(yaw)
        pose_a_b = np.array([*(at - np.array([[c, -s], [s, c]]) @ centre), yaw])
    return pose_a_b


def _residuals(tree: cKDTree, a: _Lines, points: np.ndarray, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances [N] (m) of points to the line of the nearest return of a, and its normals [N, 2].

    The distance is NaN where there is no return within reach, or its direction is unknown.
    """
    _, index = tree.query(points, distance_upper_bound=reach_m)
    found = index < len(a.points)
    index = np.where(found, index, 0)
    normal = a.normals[index]
    distance = np.einsum("ij,ij->i", points - a.points[index], normal)
    return np.where(found & (np.abs(normal).max(axis=1) > 0.0), distance, np.nan), normal
