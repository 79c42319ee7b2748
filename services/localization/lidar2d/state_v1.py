"""Saved maps of version 1: all arrays in one npz file. They are read, but not written any more."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.node_scan import NodeScan
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, Submap, TrajectoryNode


def unpack(a: dict[str, np.ndarray], graph: PoseGraph) -> dict[str, np.ndarray]:
    """Add the nodes, submaps and constraints of a map to an empty pose graph.

    Returns:
        The arrays of its trajectory record.

    Raises:
        KeyError, ValueError, IndexError, TypeError: the arrays are incomplete.
    """
    p, f = np.r_[0, np.cumsum(a["node_points"])], np.r_[0, np.cumsum(a["node_features"])]
    for k, node_id in enumerate(a["node_id"].tolist()):
        here = slice(p[k], p[k + 1])
        scan = NodeScan.packed(
            a["points"][here],
            a["tangents"][here],
            a["spacing"][here],
            a["moving"][here],
            _feature_index(a["points"][here], a["features"][f[k] : f[k + 1]]),
            a["node_origin"][k],
        )
        graph.nodes[node_id] = TrajectoryNode(node_id, int(a["node_stamp_ns"][k]), a["node_odom"][k], scan)
        graph.pose_map_node[node_id] = a["node_map"][k]
    m, s, b = (np.r_[0, np.cumsum(a[key])] for key in ("submap_members", "submap_surfels", "submap_packed"))
    for k, submap_id in enumerate(a["submap_id"].tolist()):
        row0, col0, rows, cols = a["submap_grid"][k].tolist()
        frozen = FrozenMap(
            a["means"][s[k] : s[k + 1]],
            a["omegas"][s[k] : s[k + 1]],
            a["views"][s[k] : s[k + 1]],
            a["packed"][b[k] : b[k + 1]].tobytes(),
            (rows, cols),
            row0,
            col0,
            graph.settings.cell_m,
        )
        graph.submaps[submap_id] = Submap(
            submap_id, a["submap_odom"][k], a["submap_map"][k], a["members"][m[k] : m[k + 1]].tolist(), frozen
        )
    graph.constraints = [
        Constraint(int(i), int(j), z, w, bool(loop))
        for i, j, z, w, loop in zip(
            a["edge_submap"], a["edge_node"], a["edge_pose"], a["edge_information"], a["edge_loop"]
        )
        if int(i) in graph.submaps and int(j) in graph.nodes
    ]
    return {key: value for key, value in a.items() if key.startswith("extra_")}


def _feature_index(points: np.ndarray, features: np.ndarray) -> np.ndarray:
    """Return which of the returns float32 [M, 2] the features float32 [K, 5] are, both in order of the beams.

    Raises:
        ValueError: a feature is none of the returns.
    """
    # Features are copies of returns: they have the same coordinates.
    row_of = {point: i for i, point in enumerate(map(tuple, points.tolist()))}
    try:
        return np.array([row_of[point] for point in map(tuple, features[:, :2].tolist())], dtype=np.int64)
    except KeyError as error:
        raise ValueError(f"feature at {error} is none of the returns") from error
