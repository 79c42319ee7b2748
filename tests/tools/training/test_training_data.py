"""Simulated training data: image formation against the renderer, samples against the true room."""

import numpy as np
import pytest

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.services.fusion.learned_inputs import CANDIDATES, LABELS
from beamsplat.tools.simulator.render import RayTable, SceneRenderer
from beamsplat.tools.simulator.shade import shading_tables
from beamsplat.tools.training.carriers import random_sensors
from beamsplat.tools.training.exposure import Shutter, render_exposed
from beamsplat.tools.training.generate import HomeTask, home_samples
from beamsplat.tools.training.homes import _support_heights, build_training_home, stretched
from beamsplat.tools.training.motion import HandMotion, RobotMotion, image_times
from beamsplat.tools.training.sample_files import load_sample, samples_in
from tests.tools.training.conftest import SEED, TABLE_M

YAW_RATE = 1.2  # rad/s


@pytest.fixture(scope="module")
def renderer(room_home):
    world = room_home.world
    return SceneRenderer(room_home.caster, shading_tables(world.mesh, world.atlas, world.light))


@pytest.fixture(scope="module")
def table():
    return random_sensors("robot", np.random.default_rng(0)).table


def _turning(time_s):
    R = so3_exp([0.0, 0.0, YAW_RATE * time_s])
    return make_transform(R, np.array([-2.0, 0.0, 0.0])) @ camera_mount(0.0, 0.0, 0.5)


def test_a_rolling_shutter_shows_each_row_at_its_time(renderer, table):
    readout = 0.05
    image, depth = render_exposed(renderer, table, _turning, 1.0, Shutter(0.0, readout), None)
    for strip in (0, 7):
        rows = slice(30 * strip, 30 * strip + 30)
        part = RayTable(table.rays[rows], table.rays_x[rows], table.rays_y[rows])
        view = renderer.render(_turning(1.0 + readout * ((strip + 0.5) / 8 - 0.5)), part)
        np.testing.assert_array_equal(image[rows], view.radiance)
        np.testing.assert_array_equal(depth[rows], view.depth_z_m)


def test_motion_blur_is_the_average_of_the_views_during_the_exposure(renderer, table):
    exposure = 0.02  # 6 px of motion
    sharp, _ = render_exposed(renderer, table, _turning, 0.1, Shutter(0.0, 0.0), None)
    blurred, _ = render_exposed(renderer, table, _turning, 0.1, Shutter(exposure, 0.0), None)
    views = [renderer.render(_turning(0.1 + exposure * s), table).radiance for s in np.linspace(-0.5, 0.5, 5)]
    average = np.mean(views, axis=0)
    inner = (slice(10, -10), slice(20, -20))
    error = np.abs(blurred - average)[inner].mean()
    assert error < 0.4 * np.abs(sharp - average)[inner].mean()


def test_objects_stand_on_level_surfaces(room_home):
    xy = np.array([[-0.5, 0.0], [2.0, 1.0], [0.8, 0.0]])  # on the table, on the floor, on the table's edge
    level = _support_heights(room_home.caster, xy, np.full(3, 0.1))
    assert level[0] == pytest.approx(TABLE_M, abs=1e-3)
    assert level[1] == pytest.approx(0.0, abs=1e-3)
    assert np.isnan(level[2])


def test_a_stretched_home_has_another_ceiling_and_unit_normals(room_home):
    mesh = stretched(room_home.world.mesh, 1.2)
    assert mesh.vertices_m[:, 2].max() == pytest.approx(1.2 * 2.5, abs=1e-5)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)


def test_images_follow_the_motion_of_the_sensors(room_home):
    motion = RobotMotion(room_home.drive, 0.0)
    times = list(image_times(motion, 0.18, np.radians(9.0), 50, np.random.default_rng(0)))
    T = np.array([motion.pose_at(t) for t in times])
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    assert 5 < len(times) <= 50
    assert step.max() < 0.18 * 1.15 + 0.02
    hand = HandMotion(np.eye(4), 10.0, 0.0, np.random.default_rng(1))
    speed = [np.linalg.norm(hand.pose_at(t + 0.02)[:3, 3] - hand.pose_at(t)[:3, 3]) / 0.02 for t in range(9)]
    assert 0.02 < np.median(speed) < 1.0  # m/s


def test_samples_hold_inputs_and_true_depth(samples):
    folder, record = samples
    assert (record["robot"], record["hand"]) == (2, 2)
    for carrier in ("robot", "hand"):
        files = samples_in(folder, carrier)
        assert len(files) == 2
        for file in files:
            sample = load_sample(file)
            assert sample.carrier == carrier
            assert sample.inputs.cost.shape == (120, 160, LABELS)
            truth = sample.truth_mm[::2, ::2] / 1000.0
            known = truth > 0.0
            assert known.mean() > 0.99
            assert truth[known].min() > 0.2
            assert truth.max() < 7.5
            matched = np.exp(sample.matched_log_depth.astype(np.float64))
            assert np.median(np.abs(matched - truth)[known] / truth[known]) < 0.2
            floor = sample.inputs.log_depth[CANDIDATES.index("floor")]
            assert np.isfinite(floor).any() == (carrier == "robot")


def test_the_same_seed_gives_the_same_samples(samples, room_home):
    folder, _ = samples
    again, _ = next(home_samples(HomeTask(SEED, 2, ""), room_home))
    first = load_sample(samples_in(folder, "robot")[0])
    np.testing.assert_array_equal(first.inputs.cost, again.inputs.cost)
    np.testing.assert_array_equal(first.inputs.log_depth, again.inputs.log_depth)
    np.testing.assert_array_equal(first.inputs.rgb, again.inputs.rgb)
    np.testing.assert_array_equal(first.truth_mm, again.truth_mm)


@pytest.mark.slow
def test_a_home_has_near_clutter_and_another_ceiling_each_time():
    homes = [build_training_home(seed) for seed in (1, 2)]
    ceilings = [home.world.mesh.vertices_m[:, 2].max() for home in homes]
    assert abs(ceilings[0] - ceilings[1]) > 0.01
    assert min(ceilings) > 2.3
    assert max(ceilings) < 3.3
