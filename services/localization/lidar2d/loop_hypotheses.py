"""Loop closures far from their prediction: hypotheses that wait until others confirm them.

One look-alike place is common, several that agree with each other and with the driven path are not. A
hypothesis is accepted only as part of a set whose members are consistent in pairs (Mangelson et al. 2018),
and only if no other set explains the same scans nearly as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint

MAX_HYPOTHESES = 64
CHI2_LIMIT = 11.3  # 99 % of consistent pairs are below it (three degrees of freedom)
SIGMA_M, SIGMA_RAD = 0.08, math.radians(1.0)  # of the pose of a chunk in a submap
SURE_LOG_RATIO = 4.6  # a set that is a hundred times as likely has no rival
RIVAL_RATIO = 0.6  # a set is ambiguous if a rival has this ratio of its evidence
MIN_SPACING = 6  # nodes between two chunks that both count
MAX_SET = 24  # larger sets are evidence enough


@dataclass(frozen=True)
class LoopHypothesis:
    """A match of a chunk of scans to a submap that nothing has confirmed yet."""

    constraint: Constraint
    own_submap: int  # a submap that contains the node of the constraint
    evidence: int  # 1: the chunk fits; 2: scans before and after it fit as well
    needed: int  # evidence that accepts a set with this hypothesis
    inlier_ratio: float = 1.0
    measurements: float = 0.0  # independent ones among the returns of the chunk


Variances = Callable[[int, int], tuple[float, float]]  # ids of two submaps -> m^2, rad^2


def consistent(
    a: LoopHypothesis,
    b: LoopHypothesis,
    pose_map_submap: dict[int, np.ndarray],
    pose_map_node: dict[int, np.ndarray],
    variances: Variances,
) -> bool:
    """Return whether two hypotheses agree: the loop over both of them closes within its uncertainty."""
    ca, cb = a.constraint, b.constraint
    between_submaps = se2.between(pose_map_submap[cb.submap], pose_map_submap[ca.submap])
    between_nodes = se2.between(pose_map_node[ca.node], pose_map_node[cb.node])
    predicted = se2.compose(se2.compose(between_submaps, ca.pose_submap_node), between_nodes)
    off = se2.between(cb.pose_submap_node, predicted)
    submap_m2, submap_rad2 = variances(ca.submap, cb.submap)
    node_m2, node_rad2 = variances(a.own_submap, b.own_submap)
    if not math.isfinite(submap_m2 + node_m2):
        return False
    lever_m = math.hypot(between_nodes[0], between_nodes[1])
    var_rad = submap_rad2 + node_rad2 + 2.0 * SIGMA_RAD**2
    var_m = submap_m2 + node_m2 + 2.0 * SIGMA_M**2 + (SIGMA_RAD * lever_m) ** 2
    return (off[0] ** 2 + off[1] ** 2) / var_m + off[2] ** 2 / var_rad < CHI2_LIMIT


def select(
    pool: list[LoopHypothesis],
    pose_map_submap: dict[int, np.ndarray],
    pose_map_node: dict[int, np.ndarray],
    variances: Variances,
) -> list[LoopHypothesis]:
    """Return a set of hypotheses to accept: consistent in pairs, with enough evidence and without a rival.

    Only sets that contain the newest hypotheses of the pool are looked at, so call it after each addition.
    """
    n = len(pool)
    agrees = np.zeros((n, n), dtype=bool)
    for i in range(n):
        for j in range(i):
            same_chunk = pool[i].constraint.node == pool[j].constraint.node
            if same_chunk and pool[i].constraint.submap == pool[j].constraint.submap:
                continue  # two poses in one submap
            agrees[i, j] = agrees[j, i] = consistent(
                pool[i], pool[j], pose_map_submap, pose_map_node, variances
            )
    newest = max((h.constraint.node for h in pool), default=-1)
    best: list[int] = []
    for i in range(n):
        if pool[i].constraint.node == newest:
            found = _grow(i, agrees, pool)
            if _evidence(found, pool) > _evidence(best, pool):
                best = found
    if not best or _evidence(best, pool) < max(pool[i].needed for i in best):
        return []
    nodes = {pool[i].constraint.node for i in best}
    for i in range(n):
        if i in best or pool[i].constraint.node not in nodes or all(agrees[i, j] for j in best):
            continue
        rival = _grow(i, agrees, pool)
        if _evidence(rival, pool) >= RIVAL_RATIO * _evidence(best, pool) and (
            _log_likelihood_ratio(best, rival, pool) < SURE_LOG_RATIO
        ):
            return []
    return [pool[i] for i in best]


def _evidence(members: list[int], pool: list[LoopHypothesis]) -> int:
    """Return the evidence of a set: of each chunk, the best of its hypotheses counts.

    Chunks that share most of their scans count as one.
    """
    by_node: dict[int, int] = {}
    for i in members:
        node = pool[i].constraint.node
        by_node[node] = max(by_node.get(node, 0), pool[i].evidence)
    total, last = 0, -MIN_SPACING
    for node in sorted(by_node):
        if node - last >= MIN_SPACING:
            total, last = total + by_node[node], node
    return total


def _log_likelihood_ratio(best: list[int], rival: list[int], pool: list[LoopHypothesis]) -> float:
    """Return how much better the first set explains the chunks of both sets (nats).

    The inliers of a chunk are taken as binomial, with the inlier ratio of each set as the true one.
    """
    total = 0.0
    for node in {pool[i].constraint.node for i in best} & {pool[i].constraint.node for i in rival}:
        chosen, other = (
            max((pool[i] for i in members if pool[i].constraint.node == node), key=lambda h: h.inlier_ratio)
            for members in (best, rival)
        )
        p, q = (min(max(h.inlier_ratio, 0.01), 0.99) for h in (chosen, other))
        n = chosen.measurements
        total += (
            n * (p * math.log(p / q) + (1.0 - p) * math.log((1.0 - p) / (1.0 - q))) * (1 if p > q else -1)
        )
    return total


def _grow(start: int, agrees: np.ndarray, pool: list[LoopHypothesis]) -> list[int]:
    """Return a large set that contains `start` and is consistent in pairs.

    Greedy: the member with the most partners among the remaining ones comes next. With the few tens of
    hypotheses here, its sets are as large as those of an exact search.
    """
    members = [start]
    rest = np.flatnonzero(agrees[start])
    while len(rest) and len(members) < MAX_SET:
        partners = agrees[np.ix_(rest, rest)].sum(axis=1)
        chosen = int(rest[np.argmax(partners)])
        members.append(chosen)
        rest = rest[agrees[chosen, rest]]
    return members
