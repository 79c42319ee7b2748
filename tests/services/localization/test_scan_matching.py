"""Scan matching kernels against reference code, and their accuracy in metres and radians."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.branch_bound import branch_and_bound
from beamsplat.services.localization.lidar2d.cholesky import solve
from beamsplat.services.localization.lidar2d.correlative import correlate, search
from beamsplat.services.localization.lidar2d.frozen_map import freeze
from beamsplat.services.localization.lidar2d.matching_kernels import TANGENT_VARIANCE_M2, accumulate
from beamsplat.services.localization.lidar2d.scan import prepare_scan
from beamsplat.services.localization.lidar2d.scan_matching import TwistPrior, refine
from beamsplat.services.localization.lidar2d.search_pyramid import LEVELS, build_pyramid
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_kernels import merged_surfel
from beamsplat.services.localization.lidar2d.surfel_map import SurfelMap
from beamsplat.services.localization.lidar2d.twist import exp_twist
from tests.services.localization.world import RayCastLidar

SETTINGS = LidarSlamSettings()
poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.1, 3.1)).map(np.array)


def still(pose):
    return lambda t: np.tile(pose, (len(np.atleast_1d(t)), 1))


def prepared(pose, lidar=None, velocity=(0.0, 0.0, 0.0), pose_at=None):
    lidar = lidar or RayCastLidar()
    ranges = lidar.scan(pose_at or still(pose), 0.0)
    a, inc, dt, low, high = lidar.arguments()
    return prepare_scan(ranges, a, inc, dt, low, high, np.zeros(3), np.array(velocity), 0.03, 360)


def mapped(views, matchable=True, rays=True):
    surfels = SurfelMap(SETTINGS)
    for pose in views:
        scan = prepared(pose)
        use = np.ones(len(scan), dtype=bool)
        turn = np.array([0, 0, pose[2]])
        surfels.insert(
            se2.transform(pose, scan.points_body),
            se2.transform(turn, scan.tangents),
            scan.spacing_m,
            pose[:2].copy(),
            use,
            use & rays,
            matchable,
        )
    return surfels


VIEWS = [
    np.array(pose)
    for pose in (
        (2, 2, 0), (2.3, 2, 0.3), (2.6, 2.1, 0.6), (3, 2.4, 0.8), (3.3, 2.8, 1.0), (2, 3, 3.0)
    )
]  # fmt: skip


@pytest.fixture(scope="module")
def room():
    return mapped(VIEWS)


@given(poses, poses, poses)
def test_se2_is_a_group(a, b, c):
    left, right = se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c))
    assert np.allclose(left[:2], right[:2], atol=1e-9)
    assert abs(se2.wrap(left[2] - right[2])) < 1e-9
    assert np.allclose(se2_to_se3(se2.compose(a, b)), se2_to_se3(a) @ se2_to_se3(b), atol=1e-9)
    assert np.allclose(se2.compose(a, se2.between(a, b))[:2], b[:2], atol=1e-9)
    assert np.allclose(se2.compose_many(a, b)[0], se2.compose(a, b))


def test_invalid_ranges_are_no_returns():
    ranges = np.array([1, np.nan, np.inf, -np.inf, -2, 0, 0.05, 11.99, 12, 50, 2], dtype=np.float32)
    scan = prepare_scan(ranges, 0.0, 0.1, 0.0, 0.1, 12.0, np.zeros(3), np.zeros(3), 0.03, 360)
    assert scan.beams.tolist() == [0, 7, 10]
    assert np.allclose(np.hypot(*scan.points_body.T), [1, 11.99, 2], atol=1e-6)


def test_deskewing_against_integration_and_against_the_true_walls(rng):
    lidar = RayCastLidar(beams=180, sigma_m=0.0)
    start, velocity = np.array([2.0, 2.0, 0.4]), np.array([0.6, 0.1, 1.2])

    def pose_at(t):
        out = []
        for s in np.atleast_1d(t):  # many small steps of the constant twist
            pose = start
            for _ in range(200):
                pose = se2.compose(pose, velocity * s / 200)
            out.append(pose)
        return np.array(out)

    scan = prepared(start, lidar, velocity, pose_at)
    seen = se2.transform(start, scan.points_body)
    stretched = se2.transform(start, prepared(start, lidar, (0, 0, 0), pose_at).points_body)
    truth = se2.transform(start, prepared(start, RayCastLidar(beams=3600, sigma_m=0.0)).points_body)

    def distance(points):
        return np.min(np.hypot(*(points[:, None] - truth[None]).transpose(2, 0, 1)), axis=1)

    assert np.percentile(distance(seen), 95) < 0.01
    assert np.percentile(distance(stretched), 95) > 0.04


def test_tangents_lie_along_walls():
    scan = prepared(np.array([2.0, 2.0, 0.0]), RayCastLidar(sigma_m=0.005))
    on_floor_wall = np.abs(scan.points_body[:, 1] + 2.0) < 0.03
    known = np.hypot(*scan.tangents.T) > 0
    tangents = scan.tangents[on_floor_wall & known]
    assert len(tangents) > 20
    assert np.median(np.abs(tangents[:, 1])) < 0.1


def test_surfel_of_merged_cells_against_numpy(rng):
    cell_id = np.arange(9, dtype=np.int32).reshape(3, 3)
    cell_id[0, 2] = -1
    moments, points, weights = np.zeros((9, 6)), [], []
    for r in range(3):
        for c in range(3):
            p = rng.uniform([c * 0.05, r * 0.05], [(c + 1) * 0.05, (r + 1) * 0.05], size=(7, 2)) + 3.0
            m = moments[r * 3 + c]
            m[0], m[1:3] = len(p), p.sum(axis=0)
            m[3:] = (p[:, 0] ** 2).sum(), (p[:, 0] * p[:, 1]).sum(), (p[:, 1] ** 2).sum()
            if cell_id[r, c] >= 0:
                points.append(p)
                weights += [(1.0, 0.5)[r != 1] * (1.0, 0.5)[c != 1]] * len(p)
    mean, omega = np.empty(2), np.empty(3)
    merged_surfel(cell_id, moments, 1, 1, 0.015, 0.02, mean, omega)
    points, weights = np.concatenate(points), np.array(weights)
    expected = np.average(points, axis=0, weights=weights)
    C = np.cov(points.T, aweights=weights, bias=True)
    low, high = np.linalg.eigvalsh(C)
    axis = np.linalg.eigh(C)[1]
    along = np.clip((low / high - 0.1) / 0.3, 0, 1) / (high + 0.000625)
    W = axis @ np.diag([1 / (low + 0.000625), along]) @ axis.T
    assert np.allclose(mean, expected)
    assert np.allclose(omega, [W[0, 0], W[0, 1], W[1, 1]])


@pytest.mark.parametrize("size", [3, 6])
def test_normal_equations_against_numpy(room, rng, size):
    tables, pose, scale2 = room.tables(), np.array([2.52, 2.05, 0.52]), 10.0
    scan = prepared(np.array([2.5, 2.1, 0.5]))
    features = scan.features()
    times_s, twist = rng.uniform(0.0, 0.1, len(features)), np.array([0.2, -0.1, 0.3])
    H, g = np.empty((size, size)), np.empty(size)
    weights, _, cost = accumulate(
        features,
        times_s,
        scan.origin_body,
        pose,
        twist,
        tables.nearest,
        tables.means,
        tables.omegas,
        tables.views,
        tables.row0,
        tables.col0,
        tables.cell_m,
        scale2,
        H,
        g,
    )
    H2, g2, w2, c2 = np.zeros((6, 6)), np.zeros(6), 0.0, 0.0
    if size == 3:
        twist = np.zeros(3)
    R = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
    for (x, y, tx, ty, half), time_s in zip(features, times_s):
        r = R @ [x, y]
        p = r + pose[:2] + time_s * (twist[:2] + twist[2] * np.array([-r[1], r[0]]))
        row, col = int(np.floor(p[1] / 0.05)) - tables.row0, int(np.floor(p[0] / 0.05)) - tables.col0
        k = tables.nearest[row, col]
        if k < 0 or (pose[:2] - p) @ tables.views[k] < -0.3 * np.hypot(*(pose[:2] - p)):
            continue
        a, b, c = tables.omegas[k]
        W, t = np.array([[a, b], [b, c]]), R @ [tx, ty]
        S = TANGENT_VARIANCE_M2 * np.outer(t, t) if (tx, ty) != (0, 0) else half**2 * np.eye(2)
        W = np.linalg.inv(np.eye(2) + W @ S) @ W
        d = p - tables.means[k]
        J = np.column_stack([np.eye(2), R @ [-y, x]])
        J = np.hstack([J, time_s * J])
        w = (scale2 / (scale2 + d @ W @ d)) ** 2
        H2, g2, w2, c2 = H2 + w * J.T @ W @ J, g2 + w * J.T @ W @ d, w2 + w, c2 + w * d @ W @ d
    assert np.allclose(H, H2[:size, :size], rtol=1e-9)
    assert np.allclose(g, g2[:size], rtol=1e-9, atol=1e-6)
    assert (weights, cost) == pytest.approx((w2, c2))


@pytest.mark.parametrize("size", [3, 6])
def test_solve(rng, size):
    for _ in range(20):
        M = rng.normal(size=(size, size))
        A, b, x = M @ M.T + 0.1 * np.eye(size), rng.normal(size=size), np.empty(size)
        assert solve(A.copy(), b, x)
        assert np.allclose(A @ x, b)
    assert not solve(np.diag([1.0, -1.0, 1.0]), np.ones(3), np.empty(3))


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.floats(-0.12, 0.12))
def test_refinement_finds_the_pose_within_millimetres(room, dx, dy, dyaw):
    truth = np.array([2.5, 2.2, 0.5])
    scan = prepared(truth)
    match = refine(
        scan.features(), scan.origin_body, truth + np.array([dx, dy, dyaw]), room.tables(), SETTINGS
    )
    assert np.hypot(*(match.pose_target_body[:2] - truth[:2])) < 0.01
    assert abs(match.pose_target_body[2] - truth[2]) < 0.004
    assert match.inlier_ratio > 0.9


def test_search_against_brute_force_and_from_far(room):
    truth = np.array([2.5, 2.2, 0.5])
    scan, tables = prepared(truth), room.tables()
    features = scan.features()[::5]
    centre = truth + np.array([0.1, -0.1, 0.05])
    scores = np.empty((3, 5, 5), dtype=np.float32)
    correlate(features, centre, tables.field, tables.row0, tables.col0, tables.cell_m, 2, 2, 1, 0.05, scores)
    for a, iy, ix in [(0, 0, 0), (1, 2, 3), (2, 4, 1)]:
        p = se2.transform(np.array([centre[0], centre[1], centre[2] + (a - 1) * 0.05]), features[:, :2])
        cells = np.floor(p / 0.05).astype(int) - [tables.col0, tables.row0] + [(ix - 2) * 2, (iy - 2) * 2]
        assert scores[a, iy, ix] == pytest.approx(
            tables.field[cells[:, 1], cells[:, 0]].mean() / 255.0, rel=1e-5
        )
    best = search(scan.features(), truth + np.array([0.5, -0.4, 0.3]), tables, 0.8, 0.5)
    assert min(np.hypot(*(pose[:2] - truth[:2])) for _, pose in best) < 0.12


def test_a_corridor_has_no_information_along_its_direction():
    walls = np.array([[-40, 0, 40, 0], [-40, 2, 40, 2.0]])
    surfels, lidar = SurfelMap(SETTINGS), RayCastLidar(range_max=8.0)
    for x in np.linspace(0, 2, 15):
        pose = np.array([x, 1.0, 0.0])
        a, inc, _, low, high = lidar.arguments()
        scan = prepare_scan(
            lidar.scan(still(pose), 0.0, walls), a, inc, 0.0, low, high, np.zeros(3), np.zeros(3), 0.03, 360
        )
        use = np.ones(len(scan), dtype=bool)
        surfels.insert(
            se2.transform(pose, scan.points_body), scan.tangents, scan.spacing_m, pose[:2], use, use
        )
    match = refine(scan.features(), scan.origin_body, np.array([2.0, 1.02, 0.01]), surfels.tables(), SETTINGS)
    sigma = np.sqrt(np.diag(np.linalg.inv(match.information + np.diag([1e-3, 1e-3, 1e-3]))))
    assert sigma[1] < 0.01
    assert sigma[0] > 5 * sigma[1]


def test_branch_and_bound_is_exact(room):
    frozen = freeze(room)
    tables = frozen.tables(SETTINGS.reach_cells)
    pyramid = build_pyramid(tables.field, tables.row0, tables.col0, tables.cell_m)
    assert pyramid.levels.shape[0] == LEVELS
    for h in range(1, LEVELS):  # every level bounds the one below
        assert np.all(pyramid.levels[h] >= pyramid.levels[h - 1])
    truth = np.array([2.5, 2.2, 0.5])
    features = prepared(truth).features()[::4]
    centre = np.array([2.0, 3.0, 0.3])
    found = branch_and_bound(features, centre, pyramid, 1.5, 0.4, 0.2, min_step_rad=math.radians(2))
    assert np.hypot(*(found[0][1][:2] - truth[:2])) < 0.15
    best = 0.0
    step = min(
        max(pyramid.cell_m / np.percentile(np.hypot(*features[:, :2].T), 80), math.radians(2)),
        math.radians(3),
    )
    half = math.ceil(0.4 / step)
    for yaw in centre[2] + step * np.arange(-half, half + 1):
        p = se2.transform(np.array([centre[0], centre[1], yaw]), features[:, :2])
        cells = np.floor(p / pyramid.cell_m).astype(int) - [pyramid.col0, pyramid.row0]
        for dr in range(-15, 16):
            for dc in range(-15, 16):
                r, c = cells[:, 1] + dr, cells[:, 0] + dc
                inside = (r >= 0) & (c >= 0) & (r < pyramid.levels.shape[1]) & (c < pyramid.levels.shape[2])
                best = max(best, pyramid.levels[0, r[inside], c[inside]].sum() / 255.0 / len(p))
    assert found[0][0] == pytest.approx(best)
    assert branch_and_bound(features, centre, pyramid, 1.5, 0.4, 1.1) == []


def test_a_frozen_map_yields_the_same_match(room):
    frozen = freeze(room)
    live, cold = room.tables(), frozen.tables(SETTINGS.reach_cells)
    scan = prepared(np.array([2.5, 2.2, 0.5]))
    a = refine(scan.features(), scan.origin_body, np.array([2.55, 2.2, 0.5]), live, SETTINGS)
    b = refine(scan.features(), scan.origin_body, np.array([2.55, 2.2, 0.5]), cold, SETTINGS)
    assert np.hypot(*(a.pose_target_body - b.pose_target_body)[:2]) < 0.003
    hits, misses = frozen.counts()
    assert hits.sum() == room.hits.sum()
    assert misses.sum() == room.misses.sum()


def test_match_tables_with_and_without_the_likelihood_field_agree(room):
    frozen = freeze(room)
    searched, matched = frozen.tables(SETTINGS.reach_cells), frozen.tables(SETTINGS.reach_cells, False)
    assert np.mean(searched.nearest != matched.nearest) < 1e-3  # equally near, within float32
    assert not matched.field.any()
    assert searched.field.any()


def test_make_matchable_updates_postponed_tables(room):
    postponed = mapped(VIEWS, matchable=False)
    assert not postponed.field.any()
    postponed.make_matchable()
    assert np.allclose(postponed.means[: postponed.count], room.means[: room.count])
    # The live map updates its tables only when an element has moved by millimetres.
    rows, cols = np.nonzero((postponed.nearest >= 0) & (room.nearest >= 0))
    centre = (np.column_stack([cols + postponed.col0, rows + postponed.row0]) + 0.5) * postponed.cell_m
    away = [np.linalg.norm(m.means[m.nearest[rows, cols]] - centre, axis=1) for m in (postponed, room)]
    assert np.max(np.abs(away[0] - away[1])) < 0.02  # m


def test_a_rebuilt_submap_keeps_its_counts(room):
    frozen = freeze(room)
    again = freeze(mapped(VIEWS, matchable=False, rays=False), frozen)
    assert again.packed == frozen.packed
    assert np.allclose(again.means, frozen.means)


def test_the_voxel_filter_does_not_turn_noisy_walls(rng):
    # A wall seen obliquely by a dense lidar: if the filter selected the noise that leads away from the last
    # return, the wall would turn by several milliradians.
    angles, wall_m = np.radians(np.arange(20.0, 70.0, 0.25)), 2.0
    turns = []
    for _ in range(60):
        ranges = (wall_m / np.sin(angles) + rng.normal(0.0, 0.01, len(angles))).astype(np.float32)
        scan = prepare_scan(
            ranges, angles[0], np.radians(0.25), 0.0, 0.1, 12.0, np.zeros(3), np.zeros(3), 0.03, 360
        )
        x, y = scan.points_body[scan.match_index].T
        turns.append(np.polyfit(x, y, 1)[0])
    assert len(scan.match_index) < 0.7 * len(scan)  # the filter is active
    assert abs(np.mean(turns)) < 3.5 * np.std(turns) / np.sqrt(len(turns))
    assert abs(np.mean(turns)) < 0.002


def test_the_twist_is_estimated_with_the_pose(room):
    # The scan is deskewed without motion, as if the robot had just started to move.
    pose, velocity = np.array([2.5, 2.1, 0.5]), np.array([0.3, 0.0, 0.8])

    def pose_at(t):
        return np.array([se2.compose(pose, exp_twist(velocity, s)) for s in np.atleast_1d(t)])

    lidar = RayCastLidar(sigma_m=0.005, seed=3)
    scan = prepared(pose, lidar, pose_at=pose_at)
    times_s = lidar.dt * scan.beams[scan.match_index]
    plain = refine(scan.features(), scan.origin_body, pose, room.tables(), SETTINGS)
    match = refine(
        scan.features(), scan.origin_body, pose, room.tables(), SETTINGS,
        twist_prior=TwistPrior(times_s, np.zeros(3), 0.3, 1.0),
    )  # fmt: skip
    assert abs(se2.wrap(plain.pose_target_body[2] - pose[2])) > 0.02
    assert abs(se2.wrap(match.pose_target_body[2] - pose[2])) < 0.006
    assert np.hypot(*(match.pose_target_body - pose)[:2]) < 0.012
    assert match.twist_correction == pytest.approx(velocity, abs=0.12)
    assert np.linalg.eigvalsh(plain.information - match.information).min() > -1e-6 * plain.information.max()
