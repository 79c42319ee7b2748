"""Lidar ranges against analytic geometry: motion, noise, glass, dynamic objects."""

import numpy as np
import pytest

from beamsplat.tools.simulator.lidar import SimulatedLidar
from beamsplat.tools.simulator.mesh import Material, MeshBuilder, merge
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.settings import LidarSettings
from tests.tools.simulator.room import draw_room, room_distance

QUIET = LidarSettings(noise_m=0.0, dropout=0.0)


def turning(times):
    """Poses of a robot that drives and turns fast: 0.5 m/s, 1.5 rad/s."""
    return np.stack([-1.0 + 0.5 * times, 0.3 + 0.2 * times, 1.5 * times], axis=1)


def beam_rays(settings, pose):
    angle = pose[:, 2] + settings.angle_min_rad + settings.angle_increment_rad * np.arange(settings.beams)
    origin = np.column_stack([pose[:, :2], np.full(len(pose), settings.z_m)])
    return origin, np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])


def test_each_beam_measures_from_where_the_robot_is_at_its_own_time(room):
    lidar = SimulatedLidar(room, RayCaster.of(room), QUIET)
    start = 0.7
    measured, _ = lidar.measure(lidar.revolution(start, turning), np.random.default_rng(0))
    times = start + QUIET.time_increment_s * np.arange(QUIET.beams)
    truth = room_distance(*beam_rays(QUIET, turning(times)))
    np.testing.assert_allclose(measured, truth, atol=1e-3)
    # Without the motion during the scan the ranges differ by centimetres, so this test detects it.
    skewed = room_distance(*beam_rays(QUIET, turning(np.full(QUIET.beams, start))))
    assert np.abs(measured - skewed).max() > 0.05


def test_noise_has_the_stated_deviation_and_dropouts_the_stated_rate(room):
    settings = LidarSettings(noise_m=0.02, dropout=0.05)
    lidar = SimulatedLidar(room, RayCaster.of(room), settings)
    revolution = lidar.revolution(0.0, turning)
    rng = np.random.default_rng(1)
    scans = np.stack([lidar.measure(revolution, rng)[0] for _ in range(60)])
    error = scans - revolution.range_m
    upright = revolution.cosine > 0.2
    assert np.std(error[np.isfinite(error)]) == pytest.approx(0.02, rel=0.05)
    assert np.mean(np.isinf(scans[:, upright])) == pytest.approx(0.05, abs=0.01)


def test_glass_lets_some_beams_pass_and_reports_which(sizes):
    builder = MeshBuilder(sizes, edge_m=0.5)
    draw_room(builder, east=Material("plain", glass=True))
    outside = MeshBuilder(sizes, edge_m=0.5)
    outside.quad((5.0, 2.0, 0), (0, -4.0, 0), (0, 0, 2.5), Material("plain"))
    mesh = merge([builder.build(), outside.build()])
    still = lambda times: np.tile([0.0, 0.0, 0.0], (len(times), 1))  # noqa: E731
    for glass, share in ((False, 0.0), (True, 0.7)):
        settings = LidarSettings(noise_m=0.0, dropout=0.0, glass=glass)
        lidar = SimulatedLidar(mesh, RayCaster.of(mesh), settings)
        revolution = lidar.revolution(0.0, still)
        rng = np.random.default_rng(2)
        ahead = np.abs(settings.angle_min_rad + settings.angle_increment_rad * np.arange(720)) < 0.3
        scans, through = zip(*(lidar.measure(revolution, rng) for _ in range(40)))
        assert np.mean(np.stack(through)[:, ahead]) == pytest.approx(share, abs=0.05)
        assert not np.stack(through)[:, ~ahead & (np.abs(revolution.range_m) < 2.5)].any()
        x = (
            np.stack(scans)[:, ahead]
            * np.cos(settings.angle_min_rad + settings.angle_increment_rad * np.arange(720))[ahead]
        )
        np.testing.assert_allclose(np.where(np.stack(through)[:, ahead], x, 5.0), 5.0, atol=1e-3)
        np.testing.assert_allclose(np.where(np.stack(through)[:, ahead], 3.0, x), 3.0, atol=1e-3)


def test_beams_on_a_dynamic_object_are_marked_and_follow_it_within_the_revolution(room, sizes):
    settings = LidarSettings(noise_m=0.0, dropout=0.0)
    lidar = SimulatedLidar(room, RayCaster.of(room), settings)
    still = lambda times: np.zeros((len(times), 3))  # noqa: E731

    class Wall:
        """A wall that approaches at 1 m/s."""

        def bounding_circles(self, time_s):
            return np.array([[2.0 - time_s, 0.0, 0.6]])

        def ray_caster_of(self, index, time_s):
            b = MeshBuilder(sizes)
            b.quad((2.0 - time_s, 0.5, 0), (0, -1.0, 0), (0, 0, 1.0), Material("plain"))
            return RayCaster.of(b.build())

    revolution = lidar.revolution(0.0, still, Wall())
    angle = settings.angle_min_rad + settings.angle_increment_rad * np.arange(720)
    np.testing.assert_array_equal(revolution.moving, np.abs(angle) < np.arctan2(0.5, 1.95) - 1e-3)
    # Beams straight ahead are the middle of the revolution: 50 ms after its start, within half a slice.
    x = (revolution.range_m * np.cos(angle))[revolution.moving]
    np.testing.assert_allclose(x, 1.95, atol=0.02)


def test_ranges_do_not_change_the_noise_of_the_next_scan(room):
    lidar = SimulatedLidar(room, RayCaster.of(room), LidarSettings())
    here, there = lidar.revolution(0.0, turning), lidar.revolution(2.0, turning)
    a, b = np.random.default_rng(5), np.random.default_rng(5)
    lidar.measure(here, a), lidar.measure(there, b)
    np.testing.assert_array_equal(lidar.measure(here, a)[0], lidar.measure(here, b)[0])
