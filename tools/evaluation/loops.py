"""Wrong loop closures in a saved map, and recall of true revisits, both against a true trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.metrics import interpolate_poses
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import load_state

WRONG_M, WRONG_DEG = 0.5, 5.0  # a loop constraint with a larger error is wrong
PLACE_M = 2.0  # the robot is at a place again if it comes as near as this to an earlier position,
APART_S, APART_M = 60.0, 20.0  # after so much time and travel
RECALLED_M = 0.15  # largest error of the relative pose of two passes that the map joins
SAMPLE_M = 0.5  # travel between two sampled positions
POSE_GAP_NS = 500_000_000  # poses farther apart are not interpolated


def loop_figures(
    state: Path | None,
    true_stamps_ns: np.ndarray,  # int64 [N], increasing
    pose_world_body: np.ndarray,  # float64 [N, 3]
    stamps_ns: np.ndarray,  # int64 [M], of the estimated trajectory
    pose_map_body: np.ndarray,  # float64 [M, 3], after the last optimisation
) -> dict[str, Any]:
    """Return the counts of right and wrong loop closures and the recall of revisits, by name.

    The loop closures are those of the map saved in the folder `state`; None: only the recall is returned.
    """
    figures: dict[str, Any] = {}
    if state is not None:
        graph, _ = load_state(state, LidarSlamSettings())
        error_m, error_deg = loop_errors(graph, true_stamps_ns, pose_world_body)
        checked = np.isfinite(error_m)
        figures = {
            "loops_in_graph": len(error_m),
            "loops_wrong": int(((error_m[checked] > WRONG_M) | (error_deg[checked] > WRONG_DEG)).sum()),
            "loops_unchecked": int((~checked).sum()),
            "loop_error_max_m": float(error_m[checked].max(initial=0.0)),
            "loop_error_max_deg": float(error_deg[checked].max(initial=0.0)),
        }
    return figures | revisit_recall(true_stamps_ns, pose_world_body, stamps_ns, pose_map_body)


def loop_errors(
    graph: PoseGraph,
    true_stamps_ns: np.ndarray,  # int64 [N], increasing
    pose_world_body: np.ndarray,  # float64 [N, 3]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of all L loop constraints: metres float64 [L] and degrees float64 [L].

    A submap has no true pose of its own. It is placed by that of its own nodes which is truly nearest to the
    node of the loop, with the constraint between the two. Directions in which the constraint itself states a
    standard deviation above WRONG_M do not count: along a bare corridor it does not claim a position. The
    error is NaN if the submap has no own node or a stamp is outside of the true trajectory.
    """
    ids = np.array(list(graph.nodes), dtype=np.int64)
    node_stamps_ns = np.array([n.stamp_ns for n in graph.nodes.values()], dtype=np.int64)
    truth = dict(zip(ids.tolist(), interpolate_poses(true_stamps_ns, pose_world_body, node_stamps_ns)))
    inside = (node_stamps_ns >= true_stamps_ns[0]) & (node_stamps_ns <= true_stamps_ns[-1])
    known = set(ids[inside].tolist())
    own: dict[int, list[Constraint]] = {}
    members = {i: set(s.members) for i, s in graph.submaps.items()}
    for c in graph.constraints:
        if not c.loop and c.node in members[c.submap] and c.node in known:
            own.setdefault(c.submap, []).append(c)
    loops = [c for c in graph.constraints if c.loop]
    error_m, error_deg = np.full(len(loops), np.nan), np.full(len(loops), np.nan)
    for k, loop in enumerate(loops):
        if loop.node not in known or loop.submap not in own:
            continue
        near = own[loop.submap]
        at = truth[loop.node]
        reference = near[int(np.argmin([np.hypot(*(truth[c.node] - at)[:2]) for c in near]))]
        true_pose = se2.compose(reference.pose_submap_node, se2.between(truth[reference.node], at))
        off = loop.pose_submap_node - true_pose
        error_m[k] = _claimed(off[:2], loop.information)
        error_deg[k] = np.degrees(abs(se2.wrap(off[2])))
    return error_m, error_deg


def _claimed(off_m: np.ndarray, information: np.ndarray) -> float:
    """Return the length of a position error [2] in the directions that an information [3, 3] determines."""
    position = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / information[2, 2]
    values, vectors = np.linalg.eigh(position)
    return float(np.linalg.norm((vectors.T @ off_m)[values >= WRONG_M**-2]))


def revisit_recall(
    true_stamps_ns: np.ndarray,  # int64 [N], increasing
    pose_world_body: np.ndarray,  # float64 [N, 3]
    stamps_ns: np.ndarray,  # int64 [M], of the estimated trajectory
    pose_map_body: np.ndarray,  # float64 [M, 3]
) -> dict[str, Any]:
    """Return the number of true revisits, and the share of them that the final map joins.

    The true path is sampled each SAMPLE_M of travel. A sample is a revisit if an earlier sample, at least
    APART_S and APART_M of travel before, is within PLACE_M. It is compared with the nearest such sample, and
    recalled if the estimated relative pose is within RECALLED_M of the true one. Samples in gaps of the
    estimate of more than POSE_GAP_NS are left out, and counted as `revisits_without_pose`.
    """
    steps = np.hypot(*np.diff(pose_world_body[:, :2], axis=0).T)
    travel = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.arange(0.0, travel[-1], SAMPLE_M)
    samples = np.unique(np.searchsorted(travel, wanted))
    truth, stamps, travel = pose_world_body[samples], true_stamps_ns[samples], travel[samples]
    after = np.clip(np.searchsorted(stamps_ns, stamps), 1, len(stamps_ns) - 1)
    has_pose = stamps_ns[after] - stamps_ns[after - 1] <= POSE_GAP_NS
    has_pose &= (stamps >= stamps_ns[0]) & (stamps <= stamps_ns[-1])
    estimate = interpolate_poses(stamps_ns, pose_map_body, stamps)
    pairs = []
    near = cKDTree(truth[:, :2]).query_ball_point(truth[:, :2], PLACE_M)
    without = 0
    for k, others in enumerate(near):
        before = np.array(others)
        before = before[
            (stamps[k] - stamps[before] >= APART_S * 1e9) & (travel[k] - travel[before] >= APART_M)
        ]
        usable = before[has_pose[before]]
        if len(usable) and has_pose[k]:
            pairs.append((usable[np.argmin(np.hypot(*(truth[usable] - truth[k])[:, :2].T))], k))
        elif len(before):
            without += 1
    figures = {"revisits": len(pairs), "revisits_without_pose": without}
    if not pairs:
        return figures
    a, b = np.array(pairs).T
    off = se2.between_many(estimate[a], estimate[b]) - se2.between_many(truth[a], truth[b])
    error_m = np.hypot(off[:, 0], off[:, 1])
    return figures | {
        "revisit_recall": float((error_m <= RECALLED_M).mean()),
        "revisit_error_p50_m": float(np.median(error_m)),
        "revisit_error_p95_m": float(np.percentile(error_m, 95)),
    }
