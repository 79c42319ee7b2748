"""Segments of the trajectory that no constraint connects: after a restart, or a loss of tracking."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint


def first_of_components(components: np.ndarray, fixed: list[int]) -> list[int]:
    """Return the rows of submaps to hold constant: `fixed`, and the first of each component without one.

    Args:
        components: int32 [S], label of the component of each submap.
        fixed: rows of submaps that are held constant in any case.
    """
    held = set(components[fixed].tolist())
    rows = list(fixed)
    for row, label in enumerate(components.tolist()):
        if label not in held:
            held.add(label)
            rows.append(row)
    return rows


def join_components(
    closures: list[Constraint],
    components: np.ndarray,  # int32 [S]
    main: int,  # label of the component that never moves
    submap_row: dict[int, int],
    node_row: dict[int, int],
    node_component: np.ndarray,  # int32 [N]
    submap_poses: np.ndarray,  # float64 [S, 3], changed
    node_poses: np.ndarray,  # float64 [N, 3], changed
) -> bool:
    """Move components so that the first new loop closure between each two of them is fulfilled.

    Returns whether anything moved. The labels are not changed.
    """
    label_of = {int(label): int(label) for label in np.unique(components)}
    moved = False
    for c in closures:
        a = _root(label_of, int(components[submap_row[c.submap]]))
        b = _root(label_of, int(node_component[node_row[c.node]]))
        if a == b:
            continue
        pose_map_node = se2.compose(submap_poses[submap_row[c.submap]], c.pose_submap_node)
        shift = se2.compose(pose_map_node, se2.inverse(node_poses[node_row[c.node]]))
        moving, staying = b, a
        if b == _root(label_of, main):
            moving, staying, shift = a, b, se2.inverse(shift)
        roots = {label: _root(label_of, label) for label in label_of}
        for poses, labels in ((submap_poses, components), (node_poses, node_component)):
            rows = np.flatnonzero([roots[int(label)] == moving for label in labels])
            poses[rows] = se2.compose_many(np.tile(shift, (len(rows), 1)), poses[rows])
        label_of[moving] = staying
        moved = True
    return moved


def _root(label_of: dict[int, int], label: int) -> int:
    while label_of[label] != label:
        label = label_of[label]
    return label
