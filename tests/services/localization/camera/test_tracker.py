"""Camera tracking through a textured box room: accuracy, unit, loss of tracking and relocalization."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.localization.camera.depth import DepthPrior, align_scale_to_map, resize_depth
from beamsplat.services.localization.camera.image_pyramid import tracking_camera
from beamsplat.services.localization.camera.plane_sweep import fill_unknown, sweep
from beamsplat.services.localization.camera.relocalize import thumbnail
from beamsplat.services.localization.camera.result import covisibility
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.splat_map import MapKeyframe, SplatMap
from beamsplat.services.localization.camera.tracker import CameraTracker
from tests.services.localization.camera.box import CAMERA, T_BODY_CAMERA, body, drive, pose_error, render_view

SETTINGS = CameraTrackerSettings(width_px=160, first_steps=10, steps_per_image=1)


def run(path, scale=1.0, settings=SETTINGS, with_depth=True, tracker=None):
    tracker = tracker or CameraTracker(CAMERA, T_BODY_CAMERA, settings)
    results = []
    for i, T in enumerate(path):
        rgb, z = render_view(T)
        results.append(tracker.track(i, rgb))
        if with_depth:
            tracker.add_depth(i, DepthPrior(z * np.float32(scale), 0.01, True))
        else:
            tracker.add_without_depth(i)
    return tracker, results


@pytest.fixture(scope="module")
def arc():
    path = drive(30)
    tracker, results = run(path)
    yield path, tracker, results
    tracker.close()


def test_metric_depth_yields_poses_in_metres(arc):
    path, tracker, results = arc
    assert results[0].status == "relocalizing"
    assert "first depth" in results[0].detail
    assert all(r.status == "ok" for r in results[1:])
    errors = [pose_error(T, r.T_map_body) for T, r in zip(path[1:], results[1:])]
    assert max(e[0] for e in errors) < 0.04  # of 0.87 m, with images 160 px wide
    assert max(e[1] for e in errors) < 0.015
    assert tracker.metric is True


def test_keyframes_are_added_by_covisibility_not_for_every_image(arc):
    _, tracker, results = arc
    assert 2 <= len(tracker.splats.keyframes) < 15
    assert not results[1].wants_keyframe


def test_the_covariance_grows_with_the_keyframes_and_is_plausible(arc):
    _, _, results = arc
    sigmas = [np.sqrt(np.diag(r.covariance)) for r in results[1:]]
    assert np.all(np.isfinite(sigmas))
    assert sigmas[-1][2] >= sigmas[0][2]
    assert 1e-5 < sigmas[-1][:2].max() < 0.05
    assert np.all(np.isnan(results[0].covariance))


def test_tracking_is_deterministic(arc):
    path, _, results = arc
    other, again = run(path[:12])
    other.close()
    for a, b in zip(results, again):
        assert np.array_equal(a.T_map_body, b.T_map_body)


def test_the_scale_of_the_poses_is_the_scale_of_the_depth():
    path = drive(12)
    tracker, results = run(
        path, scale=2.0, settings=CameraTrackerSettings(width_px=160, planar=False, first_steps=10)
    )
    tracker.close()
    assert np.linalg.norm(results[-1].T_map_body[:3, 3]) == pytest.approx(2 * 0.33, abs=0.04)


def test_without_depth_the_trajectory_is_right_up_to_scale():
    path = drive(36, step_m=0.04, turn_rad=0.012)
    tracker, results = run(path, with_depth=False)
    tracker.close()
    assert tracker.metric is False
    assert results[-1].status == "ok"
    found = np.array([r.T_map_body[:2, 3] for r in results[20:]])
    true = np.array([T[:2, 3] for T in path[20:]])
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    scale = np.sum(np.linalg.norm(b, axis=1)) / np.sum(np.linalg.norm(a, axis=1))
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    assert np.sqrt(np.mean(np.sum((scale * a @ R.T - b) ** 2, axis=1))) < 0.1  # over 0.8 m


def test_lost_tracking_is_reported_and_recovered():
    path = drive(10)
    tracker, _ = run(path)
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    lost, still = tracker.track(20, noise), tracker.track(21, noise)
    assert lost.status == "lost"
    assert lost.detail
    assert still.status == "relocalizing"
    assert np.all(np.isnan(lost.covariance))
    back = tracker.track(22, render_view(path[3])[0])
    tracker.close()
    assert back.status == "ok"
    assert pose_error(path[3], back.T_map_body)[0] < 0.02


def test_after_a_long_loss_the_map_continues_with_a_larger_covariance():
    settings = CameraTrackerSettings(width_px=160, first_steps=5, steps_per_image=0, restart_after=2)
    path = drive(4)
    tracker, before = run(path, settings=settings)
    far = body(-1.5, 0.8, 2.4)
    results = []
    for i in range(30, 38):
        rgb, z = render_view(far)
        results.append(tracker.track(i, rgb))
        tracker.add_depth(i, DepthPrior(z, 0.01, True))
    tracker.close()
    assert results[0].status == "lost"
    assert results[-1].status == "ok"
    assert results[-1].covariance[0, 0] > before[-1].covariance[0, 0] + 0.2


@pytest.mark.parametrize(
    ("image", "why"),
    [
        (np.zeros((60, 80, 3), np.uint8), "K belongs to another image size"),
        (np.zeros((120, 160), np.uint8), "K belongs"),
        (np.full((120, 160, 3), 90, np.uint8), "blank"),
    ],
)
def test_bad_images_are_rejected_and_do_not_affect_tracking(image, why):
    path = drive(3)
    tracker, _ = run(path)
    rejected = tracker.track(50, image)
    assert rejected.status == "rejected"
    assert why in rejected.detail
    assert tracker.track(51, render_view(path[2])[0]).status == "ok"
    assert "not after" in tracker.track(51, render_view(path[2])[0]).detail
    tracker.close()


def test_unusable_depth_is_rejected():
    path = drive(2)
    tracker, _ = run(path)
    rgb, z = render_view(body(0.5, 0.0, 0.5))
    assert "was not tracked" in tracker.add_depth(99, DepthPrior(z, 0.01, True))
    fresh = CameraTracker(CAMERA, T_BODY_CAMERA, SETTINGS)
    fresh.track(1, rgb)
    assert "no pixel" in fresh.add_depth(1, DepthPrior(np.full_like(z, np.nan), 0.01, True))
    fresh.close()
    tracker.close()


def test_depth_of_uncertain_scale_follows_the_map_and_exact_depth_keeps_its_scale():
    rendered = np.full((60, 80), 2.0, np.float32)
    rendered[:, 60:] = 0.0
    z = np.full((60, 80), 3.0, np.float32)
    followed, ratio = align_scale_to_map(z, rendered, 0.3)
    kept, _ = align_scale_to_map(z, rendered, 0.002)
    assert ratio == pytest.approx(np.log(1.5), abs=1e-3)
    assert np.median(followed[:, :50]) == pytest.approx(2.0, rel=0.03)
    assert np.median(followed[:, 70:]) == pytest.approx(2.0, rel=0.05)  # extrapolated beyond the map
    assert np.median(kept) == pytest.approx(3.0, rel=0.01)
    alone, unknown = align_scale_to_map(z, np.zeros_like(z), 0.3)
    assert np.array_equal(alone, z)
    assert np.isnan(unknown)


def test_resized_depth_has_no_mixed_pixels():
    z = np.full((120, 160), 1.0, np.float32)
    z[:, 81:], z[:20] = 3.0, np.nan
    small = resize_depth(z, 80, 60)
    assert set(np.unique(small.round(5))) == {0.0, 1.0, 3.0}
    assert small[30, 10] == 1.0
    assert small[30, 70] == pytest.approx(3.0)
    assert small[5, 40] == 0.0


def test_a_plane_sweep_finds_the_rooms_depth():
    here, there = body(0, 0, 0) @ T_BODY_CAMERA, body(0, 0, 0) @ body(0.0, 0.15, 0.0) @ T_BODY_CAMERA
    (rgb, z), (other, _) = render_view(body(0, 0, 0)), render_view(body(0.0, 0.15, 0.0))
    grey, grey_other = (p.mean(axis=2).astype(np.float32) / 255 for p in (rgb, other))
    found = sweep(grey, [(grey_other, inverse(there) @ here)], tracking_camera(CAMERA, 160), 0.5, 8.0)
    known = found > 0
    assert known.mean() > 0.15
    assert np.median(np.abs(found - z)[known] / z[known]) < 0.03
    assert np.all(fill_unknown(found, 4.0) > 0)


def test_thumbnails_ignore_brightness_and_covisibility_is_intersection_over_union():
    grey = render_view(body(0, 0, 0))[0].mean(axis=2).astype(np.float32)
    assert np.sum(thumbnail(grey) * thumbnail(grey * 0.5 + 3.0)) == pytest.approx(1.0, abs=1e-5)
    a, b = np.array([1, 2, 3, 4]), np.array([3, 4, 5, 6])
    assert covisibility(a, b) == pytest.approx(2 / 6)
    assert covisibility(a, a) == 1.0


@pytest.mark.slow
def test_house_with_recorded_depth(shared_dir):
    from beamsplat.tools.evaluation.dataset import load_dataset

    recording = load_dataset(shared_dir / "data" / "house_a")
    tracker = CameraTracker(recording.camera, recording.T_body_camera)
    T_world_map, errors = None, []
    for i in range(120):
        s = recording.posed_images[i]
        T_world_body = s.T_map_camera @ inverse(recording.T_body_camera)
        result = tracker.track(s.stamp_ns, recording.image(i))
        depth = recording.true_depth(i)
        if depth is not None:
            tracker.add_depth(s.stamp_ns, DepthPrior(depth, 0.01, True))
        if T_world_map is None:
            T_world_map = T_world_body
        else:
            assert result.status == "ok"
            errors.append(pose_error(T_world_body, T_world_map @ result.T_map_body)[0])
    tracker.close()
    assert np.sqrt(np.mean(np.square(errors))) < 0.03


def test_loss_of_tracking_during_initialisation_restarts_it():
    settings = CameraTrackerSettings(width_px=160, first_steps=2, steps_per_image=0, restart_after=1)
    tracker, _ = run(drive(2), settings=settings, with_depth=False)
    statuses = []
    for i in range(30, 36):
        statuses.append(tracker.track(i, render_view(body(-1.5, 0.8, 2.4))[0]).status)
        tracker.add_without_depth(i)
    tracker.close()
    assert statuses[0] == "lost"
    assert statuses[-1] == "ok"
    assert len(tracker.splats.keyframes) == 1


def test_the_keyframes_of_the_map_are_bounded_and_the_most_similar_ones_are_dropped():
    settings = CameraTrackerSettings(
        width_px=160, first_steps=1, steps_per_image=0, window=2, max_keyframes=4
    )
    camera = tracking_camera(CAMERA, 160)
    splats = SplatMap(camera, settings)
    stamps = []
    for number, turn in enumerate((0.0, 1.0, 2.0, 2.02, 3.0, 4.0, 4.01, 5.0)):
        T = body(0.0, 0.0, turn)
        rgb, z = render_view(T)
        planes = np.ascontiguousarray(rgb.transpose(2, 0, 1)).astype(np.float32) / 255
        small = thumbnail(rgb.mean(axis=2).astype(np.float32))
        weight, in_view = np.ones_like(z), np.zeros(0, np.int32)
        splats.add(MapKeyframe(number, T @ T_BODY_CAMERA, planes, z, weight, in_view, small))
        stamps.append([frame.stamp_ns for frame in splats.keyframes])
    splats.close()
    assert stamps[4] == [0, 1, 3, 4]  # 2 and 3 show the same
    assert [len(each) for each in stamps] == [1, 2, 3, 4, 4, 4, 4, 4]
    assert all(each[0] == 0 for each in stamps)
    assert stamps[-1][-2:] == [6, 7]
    assert [len(frame.in_view) > 0 for frame in splats.keyframes] == [False, False, False, True]
