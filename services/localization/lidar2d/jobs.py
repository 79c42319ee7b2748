"""Background jobs as pure functions of a snapshot: loop closure, linking of segments, optimisation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.drift_model import DriftModel
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays, optimise
from beamsplat.services.localization.lidar2d.loop_hypotheses import LoopHypothesis
from beamsplat.services.localization.lidar2d.loops import LoopCandidate, match_locally
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint
from beamsplat.services.localization.lidar2d.refinement import refine_submaps
from beamsplat.services.localization.lidar2d.revisits import find_revisits, nearest_member, submaps_of
from beamsplat.services.localization.lidar2d.segments import first_of_components, join_components
from beamsplat.services.localization.lidar2d.snapshot import Snapshot

ITERATIONS, LAST_ITERATIONS = 10, 16
MAX_JOBS_WITHOUT_OPTIMISATION = 5
FIT_CHI2 = 7.8  # 95 % of correct loop closures are below it (three degrees of freedom)
REJECT_CHI2 = 1e5  # loop closures above it after optimisation are deleted; others are only down-weighted


@dataclass(frozen=True)
class JobResult:
    """Result of a background job, to be passed to `LidarSlam.apply`."""

    number: int
    newest_node: int  # of the snapshot
    # All constraints up to the snapshot, or None if they have not changed.
    constraints: list[Constraint] | None
    snapshot_constraints: int  # number of constraints in the snapshot
    pose_map_submap: dict[int, np.ndarray]
    pose_map_node: dict[int, np.ndarray]
    frozen: dict[int, FrozenMap]  # rebuilt submaps
    still_pending: list[int]  # nodes whose loop closure search must be repeated
    loops_found: int
    linked: bool  # the newest segment is connected to the map
    hypotheses: list[LoopHypothesis]  # loop closures that nothing has confirmed yet
    drift_ratio2: float | None  # see DriftScale.add; None without a loop closure


@dataclass(frozen=True)
class BackgroundJob:
    """Work on a snapshot: call `run` in any thread and pass the result to `LidarSlam.apply`."""

    number: int
    apply_at_scan: int  # number of the scan before which the result must be applied
    run: Callable[[], JobResult]


def run_job(snapshot: Snapshot, refine_rounds: int = 0) -> JobResult:
    """Search loop closures and links between segments, then optimise the pose graph if there are new ones.

    `refine_rounds` times, the submaps are rebuilt from the optimised poses, all constraints are measured
    again, and the pose graph is optimised again.
    """
    submap_row = {s: i for i, s in enumerate(snapshot.submap_ids)}
    node_row = {n: i for i, n in enumerate(snapshot.node_ids)}
    constraints, frozen = list(snapshot.constraints), dict(snapshot.frozen)
    edges = snapshot.table.arrays(constraints, submap_row, node_row)
    drift = DriftModel(
        edges, snapshot.pose_map_submap, len(snapshot.node_ids), snapshot.settings, snapshot.drift_scale2
    )
    fixed = [submap_row[i] for i in sorted(snapshot.fixed) if i in submap_row] or [0]
    closed, still_pending = _close_loops(snapshot, edges, drift, node_row)
    revisits, hypotheses = find_revisits(snapshot, edges, drift, submap_row, node_row)
    found = closed + revisits
    ratio2 = _drift_ratio2(found, snapshot, edges, drift, submap_row, node_row)
    if not found and not refine_rounds:  # a chain without loops is its own solution
        linked = _is_linked(drift, edges, fixed)
        return _unmoved(snapshot, None, 0, still_pending, hypotheses, linked, ratio2)
    submap_poses, node_poses = snapshot.pose_map_submap.copy(), snapshot.pose_map_node.copy()
    node_component = drift.components[edges.submap[np.searchsorted(edges.node, np.arange(len(node_row)))]]
    joined_any = join_components(
        found, drift.components, int(drift.components[fixed[0]]), submap_row, node_row, node_component,
        submap_poses, node_poses,
    )  # fmt: skip
    constraints += found
    fit = not revisits and not joined_any and _fit(found, submap_poses, node_poses, submap_row, node_row)
    if fit and not refine_rounds and snapshot.jobs_since_optimisation < MAX_JOBS_WITHOUT_OPTIMISATION:
        linked = _is_linked(drift, edges, fixed)
        return _unmoved(snapshot, constraints, len(found), still_pending, hypotheses, linked, ratio2)
    edges = snapshot.table.arrays(constraints, submap_row, node_row)
    if joined_any:  # else the new constraints connect nothing that was apart
        drift = DriftModel(
            edges, submap_poses, len(snapshot.node_ids), snapshot.settings, snapshot.drift_scale2
        )
    held = first_of_components(drift.components, fixed)
    # During mapping the next job continues from this solution; the final one must converge by itself.
    iterations = LAST_ITERATIONS if refine_rounds else ITERATIONS
    anneal = not fit or refine_rounds > 0
    solution = optimise(submap_poses, node_poses, edges, held, iterations=iterations, anneal=anneal)
    for _ in range(refine_rounds):
        constraints = refine_submaps(
            snapshot.settings,
            snapshot.nodes,
            snapshot.members,
            frozen,
            constraints,
            dict(zip(snapshot.submap_ids, solution.pose_map_submap)),
            dict(zip(snapshot.node_ids, solution.pose_map_node)),
        )
        edges = snapshot.table.arrays(constraints, submap_row, node_row)
        solution = optimise(
            solution.pose_map_submap, solution.pose_map_node, edges, held, iterations=LAST_ITERATIONS
        )
    constraints = _without_outliers(constraints, solution.chi2, node_row)
    return JobResult(
        snapshot.number,
        snapshot.node_ids[-1],
        constraints,
        len(snapshot.constraints),
        dict(zip(snapshot.submap_ids, solution.pose_map_submap)),
        dict(zip(snapshot.node_ids, solution.pose_map_node)),
        frozen if refine_rounds else {},
        still_pending,
        len(found),
        _is_linked(drift, edges, fixed),
        hypotheses,
        ratio2,
    )


def _unmoved(
    snapshot: Snapshot, constraints: list[Constraint] | None, found: int, still_pending: list[int],
    hypotheses: list[LoopHypothesis], linked: bool, drift_ratio2: float | None,
) -> JobResult:  # fmt: skip
    """Return the result of a job that leaves all poses as they are."""
    return JobResult(
        snapshot.number, snapshot.node_ids[-1], constraints, len(snapshot.constraints), {}, {}, {},
        still_pending, found, linked, hypotheses, drift_ratio2,
    )  # fmt: skip


def _fit(
    found: list[Constraint], submap_poses: np.ndarray, node_poses: np.ndarray,
    submap_row: dict[int, int], node_row: dict[int, int],
) -> bool:  # fmt: skip
    """Return whether loop closures agree with the poses as they are, within their uncertainty."""
    for c in found:
        seen = se2.between(submap_poses[submap_row[c.submap]], node_poses[node_row[c.node]])
        off = se2.between(c.pose_submap_node, seen)
        if off @ c.information @ off > FIT_CHI2:
            return False
    return True


def _drift_ratio2(
    found: list[Constraint], snapshot: Snapshot, edges: ConstraintArrays, drift: DriftModel,
    submap_row: dict[int, int], node_row: dict[int, int],
) -> float | None:  # fmt: skip
    """Return the mean squared error of loop closures relative to the variance by the settings."""
    ratios = []
    for c in found:
        var_m, var_rad = drift.variances(int(submaps_of(edges, node_row[c.node]).min()))[
            :, submap_row[c.submap]
        ]
        if math.isfinite(var_m):
            pose_map_submap = snapshot.pose_map_submap[submap_row[c.submap]]
            seen = se2.between(pose_map_submap, snapshot.pose_map_node[node_row[c.node]])
            off = se2.between(c.pose_submap_node, seen)
            ratios.append(max((off[0] ** 2 + off[1] ** 2) / var_m, off[2] ** 2 / var_rad))
    return snapshot.drift_scale2 * float(np.mean(ratios)) if ratios else None


def _is_linked(drift: DriftModel, edges: ConstraintArrays, fixed: list[int]) -> bool:
    """Return whether constraints connect the newest node with the main part of the map."""
    return bool(drift.components[edges.submap[-1]] == drift.components[fixed[0]])


def _without_outliers(
    constraints: list[Constraint], chi2: np.ndarray, node_row: dict[int, int]
) -> list[Constraint]:
    """Remove loop closures with a chi^2 above REJECT_CHI2; return all other constraints."""
    order = np.argsort([node_row[c.node] for c in constraints], kind="stable")
    keep = np.ones(len(constraints), dtype=bool)
    keep[order] = chi2 < REJECT_CHI2
    return [c for c, k in zip(constraints, keep) if k or not c.loop]


def _close_loops(
    snapshot: Snapshot, edges: ConstraintArrays, drift: DriftModel, node_row: dict[int, int]
) -> tuple[list[Constraint], list[int]]:
    """Match pending nodes to near submaps of other passes; return loop closures and nodes still pending."""
    s = snapshot.settings
    if not snapshot.frozen or not snapshot.pending:
        return [], list(snapshot.pending)
    # The newest nodes, and in turn some of those that were too uncertain before.
    older, newest = snapshot.pending[: -3 * s.job_nodes], snapshot.pending[-3 * s.job_nodes :]
    turn = snapshot.number * len(newest) % max(len(older), 1)
    selected = older[turn : turn + len(newest)] + newest
    still_pending = older[:turn] + older[turn + len(newest) :]
    tasks = []
    for node_id in selected:
        own = sorted(set(submaps_of(edges, node_row[node_id]).tolist()))
        candidates, uncertain = _loop_candidates(
            snapshot, edges, node_row[node_id], own, drift.windows(own[0])
        )
        tasks += [(candidate.submap, node_id, candidate) for candidate in candidates]
        if uncertain and not candidates:
            still_pending.append(node_id)
    # Sorted by submap, because the cache holds few of the large match tables.
    closed = [
        match_locally(snapshot.nodes[node_id], candidate, snapshot.cache, s)
        for _, node_id, candidate in sorted(tasks, key=lambda task: task[:2])
    ]
    return [c for c in closed if c is not None], sorted(still_pending)[-2000:]


def _loop_candidates(
    snapshot: Snapshot,
    edges: ConstraintArrays,
    row: int,
    own: list[int],
    windows: tuple[np.ndarray, np.ndarray],
) -> tuple[list[LoopCandidate], bool]:
    """Return loop candidates for the node in `row`: near submaps of other passes through the same place.

    The second value is True if a near submap was omitted because its relative pose is too uncertain.
    """
    s = snapshot.settings
    distance = nearest_member(snapshot, edges, row)
    distance[[k for o in own for k in range(o - 2, o + 3) if 0 <= k < len(distance)]] = np.inf
    candidates: list[LoopCandidate] = []
    taken: list[int] = []
    uncertain = False
    for k in np.argsort(distance, kind="stable"):
        if distance[k] > s.loop_distance_m or len(candidates) == s.max_loops_per_node:
            break
        submap_id = snapshot.submap_ids[k]
        if submap_id not in snapshot.frozen or any(abs(int(k) - t) <= 1 for t in taken):
            continue
        if windows[0][k] > s.local_window_m or windows[1][k] > s.local_window_rad:
            uncertain = True
            continue
        taken.append(int(k))
        pose = se2.between(snapshot.pose_map_submap[k], snapshot.pose_map_node[row])
        candidates.append(
            LoopCandidate(
                submap_id, snapshot.frozen[submap_id], pose, float(windows[0][k]), float(windows[1][k])
            )
        )
    return candidates, uncertain
