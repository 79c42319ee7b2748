"""Two lidar maps made one: where one lies in the other, and the loops between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.nodes import Submap
from beamsplat.services.localization.lidar2d.record import TrajectoryRecord
from beamsplat.services.localization.lidar2d.relocalization import relocalize_in
from beamsplat.services.localization.lidar2d.slam import LidarSlam

ASKED = 24  # scans of the second map that are looked for in the first
LEAST_AGREEING = 3
NEAR_M, NEAR_RAD = 0.4, math.radians(4.0)  # answers that mean the same place


@dataclass(frozen=True)
class Overlap:
    """Where map b lies in map a, and how sure that is."""

    T_a_b: np.ndarray  # float64 [3]
    agreeing: int  # scans that say so
    asked: int


def find_overlap(a: LidarSlam, b: LidarSlam) -> Overlap | None:
    """Looks for scans of b all over a. None where too few of the answers agree, or others agree as much."""
    world, nodes = a.world(), list(b.back.nodes.values())
    chosen = [nodes[i] for i in np.unique(np.linspace(0, len(nodes) - 1, ASKED).round().astype(int))]
    answers = []
    for node in chosen:
        found = relocalize_in(world, node.scan.features.astype(np.float64), node.scan.origin, a.settings)
        if found.confidence >= 0.5:
            answers.append(se2.compose(found.T_map_body, se2.inverse(b.back.T_map_node[node.id])))
    if not answers:
        return None
    same = np.array([[_same(p, q) for q in answers] for p in answers])
    votes = same.sum(axis=1)
    best = int(np.argmax(votes))
    rival = int(votes[~same[best]].max(initial=0))
    if votes[best] < LEAST_AGREEING or rival * 2 > votes[best]:
        return None
    return Overlap(answers[best], int(votes[best]), len(chosen))


def _same(p: np.ndarray, q: np.ndarray) -> bool:
    turned = abs(math.remainder(p[2] - q[2], 2.0 * math.pi))
    return bool(np.hypot(*(p[:2] - q[:2])) < NEAR_M and turned < NEAR_RAD)


def merge_into(a: LidarSlam, b: LidarSlam, T_a_b: np.ndarray, offset: int) -> int:
    """Puts map b into a at `T_a_b` [3], finds the loops between them and optimises both as one.

    Submaps of b get `offset` added to their ids. Gives the number of loop closures found. b is used up.
    """
    back, other, first = a.back, b.back, a.back.next_node_id
    for id, node in other.nodes.items():
        back.nodes[first + id] = replace(node, id=first + id)
        back.T_map_node[first + id] = se2.compose(T_a_b, other.T_map_node[id])
    for id, s in other.submaps.items():
        place, members = se2.compose(T_a_b, s.T_map_submap), [first + m for m in s.members]
        back.submaps[offset + id] = Submap(offset + id, s.T_odom_submap, place, members, s.frozen)
    back.constraints += [replace(c, submap=offset + c.submap, node=first + c.node) for c in other.constraints]
    a.record = _both(a.record, b.record, T_a_b, first)
    back.pending = [first + id for id in other.nodes]
    back.unlinked_from = None  # the whole map hangs together from now on
    back.resume_numbering()
    before = back.loop_closures
    a.finish()
    return back.loop_closures - before


def _both(a: TrajectoryRecord, b: TrajectoryRecord, T_a_b: np.ndarray, first: int) -> TrajectoryRecord:
    """The scans of both, in order of time."""
    of_a, of_b = a.arrays(), b.arrays()
    poses = of_b["extra_poses"].copy()
    poses[:, 3:] = se2.compose_many(np.tile(T_a_b, (len(poses), 1)), poses[:, 3:])
    of_b = of_b | {"extra_nodes": of_b["extra_nodes"] + first, "extra_poses": poses}
    joined = {key: np.concatenate([of_a[key], of_b[key]]) for key in of_a}
    order = np.argsort(joined["extra_stamps"], kind="stable")
    return TrajectoryRecord.of({key: array[order] for key, array in joined.items()})
