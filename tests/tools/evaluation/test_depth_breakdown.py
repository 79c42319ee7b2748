"""Errors by parts of the image, their confidence intervals, and the comparison of two methods."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.tools.evaluation.bootstrap import interval, resample_blocks
from beamsplat.tools.evaluation.depth_breakdown import DepthBreakdown, PairedErrors
from beamsplat.tools.evaluation.image_parts import (
    OUTSIDE,
    PARTS,
    find_scene_heights,
    label_distances,
    label_edges,
    label_heights,
    point_heights,
    sampled_heights,
)
from tests.services.fusion.room import CAMERA, LIDAR_Z, T_BODY_CAMERA, render

CEILING_M = 2.4  # of the room


@pytest.fixture(scope="module")
def views():
    """True depth and camera pose of three images of the room, from a body that looks up by 0.25 rad."""
    poses = [
        make_transform(
            so3_exp([0.0, 0.0, 0.2 * k - 0.2]) @ so3_exp([0.0, -0.25, 0.0]), np.array([0.2 * k, 0.1 * k, 0.0])
        )
        for k in range(3)
    ]
    return [(render(T)[1], T @ T_BODY_CAMERA) for T in poses]


@pytest.fixture(scope="module")
def scene(views):
    heights = sampled_heights(views, CAMERA.ray_grid())
    return find_scene_heights(heights, floor_m=0.0, lidar_m=LIDAR_Z)


def test_the_ceiling_of_a_room_is_found_to_a_centimetre(scene):
    assert scene.ceilings_m == pytest.approx([CEILING_M], abs=0.01)


def test_a_floor_of_unknown_height_is_the_lowest_plane(views):
    heights = sampled_heights(views, CAMERA.ray_grid()) + 0.73
    found = find_scene_heights(heights, floor_m=None, lidar_m=None)
    assert found.floor_m == pytest.approx(0.73, abs=0.01)
    assert found.ceilings_m == pytest.approx([CEILING_M], abs=0.02)


def test_without_a_floor_in_view_there_are_no_heights():
    heights = np.random.default_rng(0).uniform(0.5, 1.5, 5000)
    assert find_scene_heights(heights, floor_m=None, lidar_m=None) is None


def test_pixels_get_the_part_of_their_height(views, scene):
    truth, T_map_camera = views[0]
    height = point_heights(truth, CAMERA.ray_grid(), T_map_camera)
    label = label_heights(height, scene)
    for number, (low, high) in enumerate([(-1, 0.03), (0.03, 0.25), (0.25, 1.2), (1.2, 2.35), (2.35, 3)]):
        inside = height[label == number]
        assert len(inside) > 100, PARTS["height"][number]
        assert inside.min() >= low - 0.01
        assert inside.max() <= high + 0.01
    truth = truth.copy()
    truth[:10] = np.nan
    assert np.all(label_heights(point_heights(truth, CAMERA.ray_grid(), T_map_camera), scene)[:10] == OUTSIDE)


def test_distances_and_edges_are_labelled():
    truth = np.full((40, 640), 0.9, np.float32)
    truth[:, 320:] = 4.5
    truth[0, 0] = np.nan
    assert label_distances(truth)[0, 0] == OUTSIDE
    assert label_distances(truth)[5, 100] == 0
    assert label_distances(truth)[5, 500] == 3
    edge = label_edges(truth)[20] == 0
    assert edge.sum() == 9  # 4 px on each side of the first pixel beyond the step
    assert edge[316:325].all()


def _breakdown(rng, frames, near_bias, far_bias):
    """Breakdown of images whose left half is 1.5 m away and whose right half 5 m, with these biases (m)."""
    truth = np.full((8, 40), 1.5, np.float32)
    truth[:, 20:] = 5.0
    breakdown = DepthBreakdown()
    for _ in range(frames):
        bias = np.where(truth < 2.0, near_bias, far_bias + rng.normal(0.0, 0.02))
        depth = (truth + bias).astype(np.float32)
        depth[0, :20] = np.nan  # no answer
        breakdown.add(depth, np.full_like(depth, 0.1), truth, {"distance": label_distances(truth)})
    return breakdown.report()


def test_errors_are_split_by_part():
    report = _breakdown(np.random.default_rng(3), 40, 0.02, -0.2)
    rows = {row["part"]: row for row in report["distance"]}
    near, far = rows["1 to 2 m"], rows["4 to 8 m"]
    assert near["share"] == pytest.approx(0.5)
    assert near["coverage"] == pytest.approx(7 / 8)
    assert near["within_5cm"] == 1.0
    assert near["median_m"] == pytest.approx(0.02, abs=0.003)
    assert far["within_5cm"] == 0.0
    assert far["median_m"] == pytest.approx(-0.2, abs=0.02)
    assert far["share_of_l1"] == pytest.approx(0.2 * 8 / (0.2 * 8 + 0.02 * 7), abs=0.02)
    assert far["absrel"] == pytest.approx(0.04, rel=0.1)
    assert rows["beyond 8 m"]["share"] == 0.0
    assert rows["beyond 8 m"]["within_5cm"] is None
    assert report["whole"]["coverage"] == pytest.approx(15 / 16)
    assert report["whole"]["within_1sigma"] == pytest.approx(7 / 15, abs=0.05)


def test_intervals_contain_the_true_value_as_often_as_they_say():
    rng, inside = np.random.default_rng(5), []
    for _ in range(120):
        blocks = rng.normal(0.1, 0.02, 20)  # errors of the images of one block are equal
        values = np.repeat(blocks, 5)
        weights = resample_blocks(len(values))
        low, high = interval(weights @ values / weights.sum(axis=1))
        inside.append(low <= 0.1 <= high)
    assert 0.85 <= np.mean(inside) <= 0.99


def test_with_few_images_there_is_no_interval():
    assert resample_blocks(20) is None
    report = _breakdown(np.random.default_rng(3), 6, 0.02, -0.2)
    assert report["whole"]["absrel_interval"] is None
    assert report["distance"][1]["within_5cm_interval"] is None
    assert report["distance"][1]["within_5cm"] == 1.0


def test_two_methods_are_compared_on_the_pixels_that_both_answer():
    rng, pairs = np.random.default_rng(7), PairedErrors()
    truth = np.full((6, 30), 2.0, np.float32)
    for _ in range(30):
        error = rng.uniform(0.1, 0.3)
        first, second = truth + np.float32(error), truth - np.float32(0.8 * error)
        first[0], second[1] = np.nan, np.nan
        first[1] = 50.0  # must not count
        pairs.add(first, second, truth)
    report = pairs.report()
    assert report["coverage"] == pytest.approx(4 / 6)
    for name in ("absrel", "l1_m", "rmse_m"):
        assert report[name]["change"] == pytest.approx(-0.2, abs=1e-4)
        low, high = report[name]["change_interval"]
        assert low == pytest.approx(-0.2, abs=1e-3)
        assert high == pytest.approx(-0.2, abs=1e-3)
    assert report["within_5cm"]["change"] == 0.0
