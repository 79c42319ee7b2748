"""Pose graphs for tests of saving: a map that grows as in a drive, with scans of a room, without SLAM."""

import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.node_scan import NodeScan
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, TrajectoryNode
from beamsplat.services.localization.lidar2d.refinement import rebuild_submap

SUBMAP_NODES = 4


def room_scan(seed, returns=40):
    """Return the scan of a node: returns on the walls of a square room."""
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(-np.pi, np.pi, returns))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    points = directions * (1.5 / np.abs(directions).max(axis=1))[:, None]
    tangents = np.where(np.abs(directions[:, :1]) > np.abs(directions[:, 1:]), [0.0, 1.0], [1.0, 0.0])
    dynamic = rng.random(returns) < 0.1
    index = np.flatnonzero(~dynamic)[::2]
    return NodeScan.packed(points, tangents, np.full(returns, 0.1), dynamic, index, np.zeros(2))


def grow(graph, nodes):
    """Add nodes along a line to a graph, with submaps of four nodes of which the last is not finished."""
    for _ in range(nodes):
        number = graph.next_node_id
        pose = np.array([0.3 * number, 0.0, 0.05 * number])
        if number % SUBMAP_NODES == 0:
            finish_submap(graph)
            graph.start_submap(pose)
        submap = list(graph.submaps.values())[-1]
        pose_submap_node = se2.between(submap.pose_odom_submap, pose)
        edge = Constraint(submap.id, number, pose_submap_node, np.diag([1e4, 1e4, 1e5]), False)
        node = TrajectoryNode(number, 10**9 + number, pose, room_scan(number))
        graph.add_node(node, [edge])


def finish_submap(graph):
    """Freeze the last submap."""
    for submap in list(graph.submaps.values())[-1:]:
        members = [graph.nodes[m] for m in submap.members]
        poses = [se2.between(submap.pose_odom_submap, n.pose_odom_body) for n in members]
        submap.frozen = rebuild_submap(graph.settings, members, poses)
