"""Background jobs as pure functions of a snapshot: loop closure, linking of segments, optimisation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays, optimise
from beamsplat.services.localization.lidar2d.loops import (
    DriftModel,
    LoopCandidate,
    match_globally,
    match_locally,
    verify_constraint,
)
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, constraint_arrays
from beamsplat.services.localization.lidar2d.refinement import refine_submaps
from beamsplat.services.localization.lidar2d.segments import link_segment
from beamsplat.services.localization.lidar2d.snapshot import Snapshot
from beamsplat.services.localization.lidar2d.surfel_map import FrozenMap

ITERATIONS, LAST_ITERATIONS = 10, 16
REJECT_CHI2 = 1e5  # loop closures above it after optimisation are deleted; others are only down-weighted


@dataclass(frozen=True)
class JobResult:
    """Result of a background job, to be passed to `LidarSlam.apply`."""

    number: int
    # All constraints up to the snapshot, or None if they have not changed.
    constraints: list[Constraint] | None
    snapshot_constraints: int  # number of constraints in the snapshot
    pose_map_submap: dict[int, np.ndarray]
    pose_map_node: dict[int, np.ndarray]
    frozen: dict[int, FrozenMap]  # rebuilt submaps
    still_pending: list[int]  # nodes whose loop closure search must be repeated
    searched: list[int]  # submaps that were searched globally
    loops_found: int
    linked: bool  # the newest segment is connected to the map
    candidate: tuple[int, np.ndarray] | None  # node id and pose_map_node of an unconfirmed relocalization


@dataclass(frozen=True)
class BackgroundJob:
    """Work on a snapshot: call `run` in any thread and pass the result to `LidarSlam.apply`."""

    number: int
    apply_at_scan: int  # number of the scan before which the result must be applied
    run: Callable[[], JobResult]


def run_job(snapshot: Snapshot, refine_rounds: int = 0) -> JobResult:
    """Search loop closures (or the pose of a new segment in the map), then optimise the pose graph.

    `refine_rounds` times, the submaps are rebuilt from the optimised poses, all constraints are measured
    again, and the pose graph is optimised again.
    """
    submap_row = {s: i for i, s in enumerate(snapshot.submap_ids)}
    node_row = {n: i for i, n in enumerate(snapshot.node_ids)}
    constraints, frozen = list(snapshot.constraints), dict(snapshot.frozen)
    searched: list[int] = []
    edges = constraint_arrays(constraints, submap_row, node_row)
    submap_poses, node_poses, link, candidate = snapshot.pose_map_submap, snapshot.pose_map_node, None, None
    if snapshot.unlinked_from is None:
        found, searched, still_pending = _find_constraints(snapshot, edges, submap_row, node_row)
    else:
        link, submap_poses, node_poses, candidate = link_segment(snapshot)
        found, searched, still_pending = [] if link is None else [link], [], list(snapshot.pending)
    constraints += found
    fixed = [submap_row[i] for i in sorted(snapshot.fixed) if i in submap_row] or [0]
    if found:
        edges = constraint_arrays(constraints, submap_row, node_row)
    # During mapping the next job continues from this solution; the final one must converge by itself.
    iterations = LAST_ITERATIONS if refine_rounds else ITERATIONS
    solution = optimise(submap_poses, node_poses, edges, fixed, iterations=iterations)
    rebuilt: dict[int, FrozenMap] = {}
    for _ in range(refine_rounds):
        rebuilt, constraints = refine_submaps(
            snapshot.settings,
            snapshot.nodes,
            snapshot.members,
            frozen,
            constraints,
            dict(zip(snapshot.submap_ids, solution.pose_map_submap)),
            dict(zip(snapshot.node_ids, solution.pose_map_node)),
        )
        frozen.update(rebuilt)
        edges = constraint_arrays(constraints, submap_row, node_row)
        solution = optimise(
            solution.pose_map_submap, solution.pose_map_node, edges, fixed, iterations=LAST_ITERATIONS
        )
    constraints = _without_outliers(constraints, solution.chi2, node_row)
    return JobResult(
        snapshot.number,
        constraints,
        len(snapshot.constraints),
        dict(zip(snapshot.submap_ids, solution.pose_map_submap)),
        dict(zip(snapshot.node_ids, solution.pose_map_node)),
        rebuilt,
        still_pending,
        searched,
        len(found),
        snapshot.unlinked_from is None or link is not None,
        candidate,
    )


def _without_outliers(
    constraints: list[Constraint], chi2: np.ndarray, node_row: dict[int, int]
) -> list[Constraint]:
    """Remove loop closures with a chi^2 above REJECT_CHI2; return all other constraints."""
    order = np.argsort([node_row[c.node] for c in constraints], kind="stable")
    keep = np.ones(len(constraints), dtype=bool)
    keep[order] = chi2 < REJECT_CHI2
    return [c for c, k in zip(constraints, keep) if k or not c.loop]


def _find_constraints(
    snapshot: Snapshot, edges: ConstraintArrays, submap_row: dict[int, int], node_row: dict[int, int]
) -> tuple[list[Constraint], list[int], list[int]]:
    """Return new loop closures, the submaps that were searched globally, and the node ids still pending."""
    s = snapshot.settings
    if not snapshot.frozen or not snapshot.pending:
        return [], [], list(snapshot.pending)
    drift = DriftModel(edges, len(snapshot.submap_ids), len(snapshot.node_ids), s)
    windows: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    selected = snapshot.pending[-3 * s.job_nodes :]
    still_pending = snapshot.pending[: -3 * s.job_nodes]
    tasks = []
    for node_id in selected:
        own = sorted(set(_submaps_of(edges, node_row[node_id]).tolist()))
        if own[0] not in windows:
            windows[own[0]] = drift.windows(own[0])
        candidates, uncertain = _loop_candidates(snapshot, edges, node_row[node_id], own, windows[own[0]])
        tasks += [(candidate.submap, node_id, candidate) for candidate in candidates]
        if uncertain and not candidates:
            still_pending.append(node_id)
    # Sorted by submap, because the cache holds few of the large match tables.
    closed = [
        match_locally(snapshot.nodes[node_id], candidate, snapshot.cache, s)
        for _, node_id, candidate in sorted(tasks, key=lambda task: task[:2])
    ]
    found = [c for c in closed if c is not None]
    newest = selected[-s.job_nodes :]
    global_found, searched = _find_global_constraints(
        snapshot, edges, node_row, newest[len(newest) // 2], windows, drift
    )
    return found + global_found, searched, sorted(still_pending)[-2000:]


def _submaps_of(edges: ConstraintArrays, row: int) -> np.ndarray:
    """Return the row numbers of the submaps that contain the node with row number `row`."""
    lo, hi = np.searchsorted(edges.node, [row, row + 1])
    return edges.submap[lo:hi][~edges.robust[lo:hi]]


def _nearest_member(snapshot: Snapshot, edges: ConstraintArrays, row: int) -> np.ndarray:
    """Return the distance (m) from the node in `row` to the nearest node of each submap, float64 [S]."""
    away = np.hypot(*(snapshot.pose_map_node[:, :2] - snapshot.pose_map_node[row, :2]).T)
    distance = np.full(len(snapshot.submap_ids), np.inf)
    inner = ~edges.robust
    np.minimum.at(distance, edges.submap[inner], away[edges.node[inner]])
    return distance


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
    distance = _nearest_member(snapshot, edges, row)
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


def _find_global_constraints(
    snapshot: Snapshot,
    edges: ConstraintArrays,
    node_row: dict[int, int],
    centre: int,
    windows: dict[int, tuple[np.ndarray, np.ndarray]],
    drift: DriftModel,
) -> tuple[list[Constraint], list[int]]:
    """Match the node `centre` globally to submaps of uncertain pose; return constraints and submap ids."""
    s = snapshot.settings
    row = node_row[centre]
    own = sorted(set(_submaps_of(edges, row).tolist()))
    window_m, window_rad = windows.setdefault(own[0], drift.windows(own[0]))
    distance = _nearest_member(snapshot, edges, row)
    distance[own] = np.inf
    half = s.merged_scans // 2
    neighbours = [snapshot.nodes[n] for n in snapshot.node_ids[max(0, row - half) : row + half + 1]]
    candidates = []
    for k in np.flatnonzero(np.isfinite(distance)).tolist():
        submap_id = snapshot.submap_ids[k]
        local = window_m[k] <= s.local_window_m and window_rad[k] <= s.local_window_rad
        if submap_id in snapshot.frozen and not local and distance[k] < s.loop_distance_m + window_m[k]:
            candidates.append((snapshot.search_counts.get(submap_id, 0), float(distance[k]), k))
    found, searched = [], []
    for _, _, k in sorted(candidates)[: s.global_searches_per_job]:
        submap_id = snapshot.submap_ids[k]
        pose = se2.between(snapshot.pose_map_submap[k], snapshot.pose_map_node[row])
        limit_m = s.max_global_window_m
        window = min(float(window_m[k]), limit_m) if math.isfinite(window_m[k]) else limit_m
        turn = min(float(window_rad[k]), math.pi) if math.isfinite(window_rad[k]) else math.pi
        candidate = LoopCandidate(submap_id, snapshot.frozen[submap_id], pose, window, turn)
        constraint = match_globally(snapshot.nodes[centre], neighbours, candidate, snapshot.cache, s)
        searched.append(submap_id)
        if constraint is not None and verify_constraint(
            constraint,
            snapshot.node_ids,
            snapshot.nodes,
            snapshot.members,
            snapshot.frozen,
            dict(zip(snapshot.submap_ids, snapshot.pose_map_submap)),
            dict(zip(snapshot.node_ids, snapshot.pose_map_node)),
            snapshot.cache,
            s,
        ):
            found.append(constraint)
    return found, searched
