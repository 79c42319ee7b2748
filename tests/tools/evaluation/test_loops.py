"""Wrong loop closures and recall of revisits, on constructed graphs and trajectories."""

import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, TrajectoryNode
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.tools.evaluation.loops import loop_errors, revisit_recall

NS = 1_000_000_000
SURE = np.diag([400.0, 400.0, 1e4])  # 5 cm, 0.6 degrees


def lap(time_s: np.ndarray) -> np.ndarray:
    """Poses [N, 3] of laps of 100 s on a circle with a circumference of 100 m."""
    angle = 2.0 * np.pi * time_s / 100.0
    r = 100.0 / (2.0 * np.pi)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), se2.wrap_many(angle + np.pi / 2)])


@pytest.fixture
def graph() -> PoseGraph:
    """Two submaps with ten nodes each, one second apart, at the same place in two laps."""
    graph = PoseGraph(LidarSlamSettings())
    for start in (0, 100):
        times = start + np.arange(10.0)
        truth = lap(times)
        submap = graph.start_submap(np.array([3.0, -1.0, 0.4]))  # the frame of a submap is arbitrary
        pose_submap_node = se2.compose_many(np.array([1.0, 2.0, 0.7]), se2.between_many(truth[0], truth))
        for time_s, pose in zip(times, pose_submap_node):
            node = TrajectoryNode(graph.next_node_id, int(time_s * NS), np.zeros(3), None)
            graph.add_node(node, [Constraint(submap.id, node.id, pose, SURE, False)])
    return graph


def loop(graph: PoseGraph, submap: int, node: int, off: list[float], information: np.ndarray = SURE) -> None:
    """Add a loop constraint whose pose in the submap is wrong by `off` (x, y, yaw)."""
    time_s = graph.nodes[node].stamp_ns / NS
    first = next(c for c in graph.constraints if c.submap == submap)
    start_s = graph.nodes[first.node].stamp_ns / NS
    true = se2.compose(first.pose_submap_node, se2.between(*lap(np.array([start_s, time_s]))))
    graph.constraints.append(Constraint(submap, node, true + np.array(off), information, True))


def errors(graph: PoseGraph) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.arange(0.0, 120.0, 0.05)
    return loop_errors(graph, (time_s * NS).astype(np.int64), lap(time_s))


def test_a_planted_wrong_closure_has_its_error_and_right_ones_have_none(graph):
    loop(graph, 0, 13, [0.0, 0.0, 0.0])
    loop(graph, 0, 15, [0.0, 0.6, 0.0])
    loop(graph, 1, 4, [0.0, 0.0, np.radians(6.0)])
    metres, degrees = errors(graph)
    assert metres == pytest.approx([0.0, 0.6, 0.0], abs=2e-3)
    assert degrees == pytest.approx([0.0, 0.0, 6.0], abs=0.01)


def test_a_direction_that_a_closure_does_not_determine_has_no_error(graph):
    along_x = np.diag([1.0, 400.0, 1e4])  # 1 m along x: a bare corridor
    loop(graph, 0, 13, [3.0, 0.1, 0.0], along_x)
    loop(graph, 0, 14, [3.0, 0.1, 0.0])
    metres, _ = errors(graph)
    assert metres == pytest.approx([0.1, np.hypot(3.0, 0.1)], abs=2e-3)


def test_a_closure_to_a_submap_without_own_nodes_cannot_be_checked(graph):
    loop(graph, 0, 13, [0.0, 0.0, 0.0])
    graph.constraints = [c for c in graph.constraints if c.loop or c.submap != 0]
    assert np.isnan(errors(graph)[0]).all()


def recall(bend: callable) -> dict:
    """Recall of two laps whose estimate is `bend` of the true poses and the times."""
    time_s = np.arange(0.0, 200.0, 0.1)
    truth = lap(time_s)
    return revisit_recall(
        (time_s * NS).astype(np.int64), truth, (time_s * NS).astype(np.int64), bend(truth, time_s)
    )


def test_a_second_lap_is_recalled_where_the_estimate_joins_the_first():
    # In its second half the second lap is displaced: 10 cm are recalled, 20 cm are not.
    def by(metres):
        return lambda truth, t: truth + np.where(t > 150.0, metres, 0.0)[:, None] * np.array([1.0, 0.0, 0.0])

    assert recall(by(0.0))["revisits"] == pytest.approx(200, abs=8)  # one each 0.5 m of 100 m
    assert recall(by(0.1))["revisit_recall"] == 1.0
    assert recall(by(0.2))["revisit_recall"] == pytest.approx(0.5, abs=0.03)
    assert recall(by(0.2))["revisit_error_p95_m"] == pytest.approx(0.2, abs=1e-3)


def test_the_frame_of_the_map_does_not_matter():
    pose_map_world = np.array([40.0, -7.0, 2.0])
    figures = recall(lambda truth, _: se2.compose_many(pose_map_world, truth))
    assert figures["revisit_error_p95_m"] < 1e-6


def test_revisits_without_a_pose_are_counted():
    time_s = np.arange(0.0, 200.0, 0.1)
    stamps = (time_s * NS).astype(np.int64)
    has = (time_s < 120.0) | (time_s > 140.0)
    figures = revisit_recall(stamps, lap(time_s), stamps[has], lap(time_s)[has])
    assert figures["revisits_without_pose"] == pytest.approx(38, abs=4)  # 20 s at 1 m/s
    assert figures["revisit_recall"] == 1.0


def test_a_first_lap_has_no_revisits():
    time_s = np.arange(0.0, 95.0, 0.1)
    stamps = (time_s * NS).astype(np.int64)
    assert revisit_recall(stamps, lap(time_s), stamps, lap(time_s)) == {
        "revisits": 0,
        "revisits_without_pose": 0,
    }
