"""Loop closure over large drift: windows, place search, sets of hypotheses, segments."""

from dataclasses import replace

import numpy as np
import pytest

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.drift_model import DriftModel, DriftScale
from beamsplat.services.localization.lidar2d.graph_optimisation import ConstraintArrays
from beamsplat.services.localization.lidar2d.look_alikes import is_ambiguous
from beamsplat.services.localization.lidar2d.loop_hypotheses import LoopHypothesis, select
from beamsplat.services.localization.lidar2d.place_search import SearchTarget, search_places
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint, TableCache
from beamsplat.services.localization.lidar2d.refinement import rebuild_submap
from beamsplat.services.localization.lidar2d.segments import first_of_components, join_components
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from tests.services.localization.world import RayCastLidar, SimulatedDrive

SETTINGS = LidarSlamSettings()
STEP_M = 6.0  # distance between submaps


def chain(links, settings=SETTINGS):
    """Return constraints of a chain of submaps: node k belongs to the submaps k and k + 1 of each link."""
    submap = np.array([s for pair in links for s in pair], dtype=np.int32)
    node = np.repeat(np.arange(len(links), dtype=np.int32), 2)
    # As tightly measured as possible, so that what remains is the drift between submaps.
    information = np.tile(np.diag([1e8, 1e8, 1e10]), (len(submap), 1, 1))
    return ConstraintArrays(
        submap, node, np.zeros((len(submap), 3)), information, np.zeros(len(submap), bool)
    )


def test_windows_follow_the_levers_of_the_path(rng):
    turns = np.where(np.arange(30) % 10 == 9, np.pi / 2, 0.0)  # a path with corners
    poses = [np.zeros(3)]
    for turn in turns:
        poses.append(se2.compose(poses[-1], np.array([STEP_M, 0.0, turn])))
    edges = chain([(k, k + 1) for k in range(30)])
    model = DriftModel(edges, np.array(poses), 30, SETTINGS)
    var_m, var_rad = model.variances(0)
    # Monte Carlo: the same chain, where each link errs by the drift between two submaps (twice: each of its
    # two constraints carries it).
    sigma_m, sigma_rad = (
        np.sqrt(2.0) * s for s in (SETTINGS.submap_drift_sigma_m, SETTINGS.submap_drift_sigma_rad)
    )
    ends = []
    for _ in range(1500):
        pose = np.zeros(3)
        for turn in turns:
            middle = np.array([0.5 * STEP_M, 0.0, 0.0])
            error = np.array([*(sigma_m * rng.standard_normal(2)), sigma_rad * rng.standard_normal()])
            pose = se2.compose(
                se2.compose(se2.compose(pose, middle), error), middle + np.array([0.0, 0.0, turn])
            )
        ends.append(pose - poses[-1])
    ends = np.array(ends)
    measured = np.sqrt((ends[:, :2] ** 2).sum(axis=1).mean())
    assert np.sqrt(var_rad[-1]) == pytest.approx(ends[:, 2].std(), rel=0.1)
    assert measured / 1.1 < np.sqrt(var_m[-1]) < 1.1 * measured


def test_what_nothing_connects_has_no_window():
    edges = chain([(0, 1), (2, 3)])
    model = DriftModel(edges, np.zeros((4, 3)), 2, SETTINGS)
    window_m, window_rad = model.windows(0)
    assert np.isfinite(window_m[1])
    assert np.isinf(window_m[2:]).all()
    assert np.isinf(window_rad[2:]).all()
    assert model.components[0] == model.components[1] != model.components[2] == model.components[3]
    assert first_of_components(model.components, [1]) == [1, 2]


@pytest.fixture(scope="module")
def mapped():
    drive, lidar = SimulatedDrive(), RayCastLidar(seed=21)
    slam = LidarSlam(SETTINGS, np.eye(4))
    for t in np.arange(0.0, drive.duration_s, 0.1):
        slam.add_scan(round(1e9 + t * 1e9), lidar.scan(drive, t), *lidar.arguments())
        if slam._pending_job is not None:
            slam.apply(slam._pending_job.run())
    slam.active_submaps.freeze_active()
    return slam


@pytest.mark.parametrize("known_m", [np.inf, 1.5])
def test_a_chunk_is_found_in_the_submap_it_belongs_to(mapped, rng, known_m):
    graph, cache = mapped.pose_graph, TableCache(SETTINGS.reach_cells)
    node = graph.nodes[60]
    members = graph.submaps[1].members
    submap = rebuild_submap(
        SETTINGS, [graph.nodes[m] for m in members], [graph.nodes[m].pose_odom_body for m in members]
    )
    wrong = node.pose_odom_body + np.array([0.8, -0.6, 0.4])
    path = np.array([graph.nodes[m].pose_odom_body[:2] for m in members])
    target = SearchTarget(1, submap, path, wrong, known_m, np.pi if np.isinf(known_m) else 0.6)
    features = node.scan.features.astype(np.float64)
    found = search_places(features, node.scan.origin, [target], cache, SETTINGS, 0.5, 0.4, 0.6)
    off = se2.between(node.pose_odom_body, found[0].match.pose_target_body)
    assert np.hypot(*off[:2]) < 0.03
    assert abs(off[2]) < np.radians(0.5)


def hypothesis(own_submap, submap, pose, *, evidence=1, needed=4):
    """Return a match of a chunk at the start of `own_submap`, whose node has ten times its number."""
    constraint = Constraint(submap, 10 * own_submap, np.asarray(pose, dtype=float), np.eye(3), True)
    return LoopHypothesis(constraint, own_submap, evidence, needed)


class Corridor:
    """A straight drive along submaps 6 m apart, of which 20 and more run along 0 and more again."""

    poses = {k: np.array([STEP_M * k, 0.0, 0.0]) for k in range(40)}  # as odometry says
    nodes = {10 * k: pose for k, pose in poses.items()}

    def variances(self, a, b):
        return 0.02**2 * abs(a - b) + 1e-6, np.radians(0.3) ** 2 * abs(a - b) + 1e-8

    def select(self, pool):
        return select(pool, self.poses, self.nodes, self.variances)


def test_a_consistent_set_is_accepted_and_a_single_match_is_not():
    true = [hypothesis(20 + k, k, [0.03 * k, 0.02, 0.0]) for k in range(4)]
    corridor = Corridor()
    assert corridor.select(true[:1]) == []
    assert corridor.select(true[:3]) == []
    assert set(map(id, corridor.select(true))) == set(map(id, true))


def test_chunks_that_share_most_of_their_scans_count_once():
    corridor = Corridor()
    true = [hypothesis(20, 0, [0.02 * k, 0.0, 0.0]) for k in range(5)]
    near = [replace(h, constraint=replace(h.constraint, node=200 + k)) for k, h in enumerate(true)]
    nodes = corridor.nodes | {
        200 + k: se2.compose(corridor.nodes[200], np.array([0.02 * k, 0.0, 0.0])) for k in range(5)
    }
    assert select(near, corridor.poses, nodes, corridor.variances) == []


def test_matches_that_contradict_each_other_are_not_accepted():
    pool = [hypothesis(20 + k, k, [1.5 * k, 0.0, 0.0]) for k in range(6)]  # each is 1.5 m off the one before
    assert Corridor().select(pool) == []
    pool = [hypothesis(20 + k, k, [0.0, 0.0, np.radians(6.0) * k]) for k in range(6)]
    assert Corridor().select(pool) == []


def test_two_places_that_look_the_same_are_not_decided():
    here = [hypothesis(20 + k, k, [0.02, 0.0, 0.0]) for k in range(5)]
    there = [hypothesis(20 + k, 10 + k, [0.0, 0.01, 0.0]) for k in range(5)]
    corridor = Corridor()
    assert corridor.select([h for pair in zip(here, there) for h in pair]) == []
    longer = [hypothesis(25 + k, 5 + k, [0.0, 0.01, 0.0]) for k in range(5)]  # only one of them goes on
    accepted = corridor.select(here + there + longer)
    assert {h.own_submap - h.constraint.submap for h in accepted} == {20}
    assert len(accepted) >= 8


def test_of_two_similar_places_the_one_that_fits_better_is_accepted():
    here = [
        replace(hypothesis(20 + k, k, [0.02, 0.0, 0.0]), inlier_ratio=0.97, measurements=50.0)
        for k in range(6)
    ]
    there = [
        replace(hypothesis(20 + k, 10 + k, [0.0, 0.01, 0.0]), inlier_ratio=0.90, measurements=50.0)
        for k in range(6)
    ]
    assert {h.own_submap - h.constraint.submap for h in Corridor().select(here + there)} == {20}


@pytest.mark.parametrize("main", [0, 1])
def test_components_are_joined_where_they_met_and_the_main_one_stays(main):
    submaps = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [50.0, 5.0, 1.0], [52.0, 5.0, 1.0]])
    nodes = submaps + np.array([0.5, 0.2, 0.1])
    before = submaps.copy(), nodes.copy()
    components = np.array([0, 0, 1, 1])
    closure = Constraint(1, 3, np.array([0.3, -0.4, 0.2]), np.eye(3), True)
    row = {k: k for k in range(4)}
    assert join_components([closure], components, main, row, row, components, submaps, nodes)
    assert se2.between(submaps[1], nodes[3]) == pytest.approx(closure.pose_submap_node)
    stayed = components == main
    assert np.array_equal(submaps[stayed], before[0][stayed])
    assert np.array_equal(nodes[stayed], before[1][stayed])
    for a, b in ((2, 3), (0, 1)):  # rigidly
        assert se2.between(submaps[a], submaps[b]) == pytest.approx(se2.between(before[0][a], before[0][b]))


def test_the_drift_of_this_drive_is_learnt_from_its_loops():
    accurate, poor = DriftScale(), DriftScale()
    for _ in range(12):
        accurate.add(0.01)
        poor.add(1.0)
    assert np.sqrt(accurate.scale2) == pytest.approx(0.5, abs=0.02)  # four jobs of prior against twelve
    assert poor.scale2 == 1.0
    edges = chain([(k, k + 1) for k in range(10)])
    poses = np.column_stack([STEP_M * np.arange(11), np.zeros((11, 2))])
    wide, narrow = (DriftModel(edges, poses, 10, SETTINGS, scale2).variances(0) for scale2 in (1.0, 0.25))
    assert narrow[:, -1] == pytest.approx(0.25 * wide[:, -1], rel=0.01)


def test_a_match_outside_of_its_window_is_no_match(mapped):
    graph, cache = mapped.pose_graph, TableCache(SETTINGS.reach_cells)
    node, members = graph.nodes[60], graph.submaps[1].members
    poses = [graph.nodes[m].pose_odom_body for m in members]
    submap = rebuild_submap(SETTINGS, [graph.nodes[m] for m in members], poses)
    features = node.scan.features.astype(np.float64)
    path = np.array(poses)[:, :2]
    for off_m, found in ((2.0, True), (6.0, False)):
        predicted = node.pose_odom_body + np.array([off_m, 0.0, 0.0])
        target = SearchTarget(1, submap, path, predicted, 4.0, 0.5)
        matches = search_places(features, node.scan.origin, [target], cache, SETTINGS, 0.5, 0.4, 0.8)
        assert bool(matches) == found


AREA_M2 = 3000.0
ROOM_M = 13.0  # rooms of a corridor of identical rooms are so far apart


@pytest.mark.parametrize(
    ("off_m", "sigma_m", "copies", "ambiguous"),
    [
        (9.0, 4.0, (1,), True),  # the copy on the other side, mapped or not, is only 4 m from the prediction
        (9.0, 4.0, (-1,), True),
        (1.0, 1.5, (1, 2), False),  # the drift rules all copies out
        (1.0, 1.5, tuple(range(1, 12)), True),  # one of many: another is to be expected nearby
        (9.0, 4.0, (), False),  # nothing else in the building looks like this
    ],
)
def test_a_room_with_copies_is_recognised_only_where_the_drift_decides(off_m, sigma_m, copies, ambiguous):
    predicted = np.array([20.0, 3.0, 0.1])
    matched = np.array([20.0 + off_m, 3.0, 0.1])
    others = [matched + np.array([n * ROOM_M, 0.0, 0.0]) for n in copies]
    assert is_ambiguous(matched, predicted, sigma_m, np.radians(3.0), others, AREA_M2) is ambiguous


def test_a_copy_that_is_turned_around_is_told_apart_by_the_heading():
    matched = np.array([1.0, 0.0, 0.0])
    turned = [np.array([4.5, 0.0, np.pi])]
    assert not is_ambiguous(matched, np.zeros(3), 4.0, np.radians(5.0), turned, AREA_M2)
    assert is_ambiguous(matched, np.zeros(3), 4.0, np.radians(90.0), turned, AREA_M2)
