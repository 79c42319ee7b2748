"""Complete recordings of a small GLB scene: layout, counts, stamps, faults, laps, determinism."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from beamsplat.common.geometry.transforms import make_transform, matrix_from_quat_xyzw, so3_log
from beamsplat.tools.simulator import recording
from beamsplat.tools.simulator.settings import (
    START_NS,
    CameraSettings,
    Faults,
    LidarSettings,
    SimulationSettings,
)

CAMERA = CameraSettings(width_px=96, height_px=72, rate_hz=5.0)
NS = 10**9


def run(out, settings, **options):
    return recording.simulate(
        settings, out, jobs=1, replace=False, progress=options.get("progress", lambda *_: None)
    )


def base(scene_file, **changes):
    settings = {
        "seed": 3,
        "seconds": 4.0,
        "people": 1,
        "scene": str(scene_file),
        "camera": CAMERA,
        "extra_views": 3,
        "surface_points": 3000,
    }
    return SimulationSettings(**{**settings, **changes})


def read(folder):
    messages = {}
    with AnyReader([Path(folder) / "bag"]) as reader:
        for connection, received, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            messages.setdefault(connection.topic, []).append((received, message))
    return messages


def stamp_of(message):
    header = message.header if hasattr(message, "header") else message.transforms[0].header
    return header.stamp.sec * NS + header.stamp.nanosec


@pytest.fixture(scope="module")
def recorded(scene_file, own_cache, tmp_path_factory):
    out = tmp_path_factory.mktemp("recording") / "rec"
    return out, run(out, base(scene_file))


def test_the_layout_is_complete_and_counts_are_right(recorded):
    out, summary = recorded
    bag = read(out)
    assert len(bag["/camera/image_raw/compressed"]) == len(bag["/camera/camera_info"]) == 20 == summary.images
    assert len(bag["/scan"]) == 39 == summary.scans
    assert len(bag["/odom"]) == len(bag["/tf"])
    assert 190 <= len(bag["/odom"]) <= 201
    assert len(bag["/tf_static"]) == 1
    assert summary.messages == sum(len(m) for m in bag.values())
    depth = sorted((out / "depth_gt").iterdir())
    assert len(depth) == 3
    images = {stamp_of(m) for _, m in bag["/camera/image_raw/compressed"]}
    assert {int(p.stem) for p in depth} <= images
    assert {int(p.stem) for p in (out / "moving_masks").iterdir()} <= images
    assert not list(out.parent.glob(".*part"))


def test_messages_arrive_after_their_stamp_and_in_order(recorded):
    for topic, messages in read(recorded[0]).items():
        received = [r for r, _ in messages]
        assert received == sorted(received)
        lag = np.array([r - stamp_of(m) for r, m in messages]) / 1e6
        low, high = {"/scan": (104, 140), "/tf_static": (0, 0)}.get(topic, (1.9, 60))
        assert low <= lag.min()
        assert lag.max() <= high, topic


def test_truth_covers_the_drive_and_does_not_begin_at_the_origin(recorded):
    rows = np.loadtxt(recorded[0] / "groundtruth.txt")
    assert np.abs(rows[0, 1:3]).max() > 0.1
    text = (recorded[0] / "groundtruth.txt").read_text().splitlines()[1:]
    stamps = [int(line.split()[0].replace(".", "")) for line in text]
    assert stamps[0] == START_NS
    assert set(np.diff(stamps).tolist()) == {20_000_000}


def test_depth_images_agree_with_the_scans(recorded):
    """Beams of a scan, projected into the image nearest in time, agree with its depth."""
    out, _ = recorded
    bag = read(out)
    camera = json.loads((out / "camera.json").read_text())
    T_camera_lidar = np.linalg.inv(camera["T_base_camera"]["matrix"]) @ np.array(
        camera["T_base_lidar"]["matrix"]
    )
    stamp = min(int(p.stem) for p in (out / "depth_gt").iterdir())
    depth = cv2.imread(str(out / "depth_gt" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED) / 1000.0
    scan = min((m for _, m in bag["/scan"]), key=lambda m: abs(stamp_of(m) - stamp))
    angle = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    points = np.stack([scan.ranges * np.cos(angle), scan.ranges * np.sin(angle), 0 * angle, 1 + 0 * angle])
    x, y, z, _ = T_camera_lidar @ points[:, np.isfinite(scan.ranges)]
    u = np.rint(camera["fx"] * x / z + camera["cx"]).astype(int)
    v = np.rint(camera["fy"] * y / z + camera["cy"]).astype(int)
    inside = (z > 0.1) & (u >= 0) & (u < 96) & (v >= 0) & (v < 72)
    error = np.abs(depth[v[inside], u[inside]] - z[inside])
    assert inside.sum() > 30
    assert np.median(error) < 0.03


def test_masks_mark_dynamic_objects(recorded):
    out, _ = recorded
    with np.load(out / "beams.npz") as beams:
        assert beams["moving"].shape == (39, 720)
        assert beams["stamp_ns"].tolist() == [stamp_of(m) for _, m in read(out)["/scan"]]
        assert beams["moving"].any()
        assert not beams["through_glass"].any()
    masks = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in (out / "moving_masks").iterdir()]
    assert all(set(np.unique(mask)) == {0, 255} for mask in masks)


def test_views_and_surface(recorded):
    out, summary = recorded
    views = json.loads((out / "extra_views" / "poses.json").read_text())["views"]
    assert len(views) == summary.extra_views
    for view in views:
        assert 0.15 <= view["distance_to_trajectory_m"] <= 0.6
        assert view["fraction_seen_in_sequence"] >= 0.85
        assert (out / "extra_views" / view["file"]).exists()
        depth = cv2.imread(str(out / "extra_views" / view["depth"]), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        assert depth.min() > 0
    data = (out / "gt_surface.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    assert b"element vertex 3000" in head
    points = np.frombuffer(body, dtype=[("p", "<f4", 3), ("c", "u1", 3)])["p"]
    # Every point is on a face of the room or of the block in it (z-up: the block's y is -z of the file).
    room = np.minimum(np.abs(np.abs(points[:, 0]) - 3.0), np.abs(np.abs(points[:, 1]) - 2.5))
    room = np.minimum(room, np.minimum(np.abs(points[:, 2]), np.abs(points[:, 2] - 2.5)))
    block = np.abs(np.abs(points - [0.2, -0.1, 0.4]) - [0.8, 0.5, 0.4]).min(axis=1)
    assert np.minimum(room, block).max() < 2e-3


def hashes(folder):
    bag = read(folder)
    digest = hashlib.sha256()
    for topic in ("/camera/image_raw/compressed", "/scan", "/odom"):
        for received, message in bag[topic]:
            data = getattr(message, "data", None) if topic != "/scan" else message.ranges
            digest.update(np.int64(received).tobytes() + (b"" if data is None else data.tobytes()))
    return digest.hexdigest()


def test_the_same_seed_gives_the_same_bytes_even_without_the_cache(
    recorded, scene_file, tmp_path, tmp_path_factory, monkeypatch
):
    monkeypatch.setenv("BEAMSPLAT_CACHE", str(tmp_path_factory.mktemp("other-cache")))
    run(tmp_path / "again", base(scene_file, extra_views=0, surface_points=100))
    assert hashes(tmp_path / "again") == hashes(recorded[0])


def test_planted_faults_are_in_the_bag_and_named_beside_it(recorded, scene_file, own_cache, tmp_path):
    faults = Faults(clock_offset_ms=35.0, extrinsic_yaw_deg=2.0, extrinsic_xyz_m=(0.01, -0.02, 0.03))
    run(tmp_path / "faulty", base(scene_file, faults=faults, extra_views=0, surface_points=100))
    good, bad = read(recorded[0]), read(tmp_path / "faulty")
    shift = {
        stamp_of(b) - stamp_of(g)
        for (_, g), (_, b) in zip(good["/camera/image_raw/compressed"], bad["/camera/image_raw/compressed"])
    }
    assert shift == {35_000_000}
    assert [stamp_of(m) for _, m in good["/scan"]] == [stamp_of(m) for _, m in bad["/scan"]]
    for (_, g), (_, b) in zip(good["/camera/image_raw/compressed"], bad["/camera/image_raw/compressed"]):
        np.testing.assert_array_equal(g.data, b.data)

    def mount(bag):
        link = next(
            t for t in bag["/tf_static"][0][1].transforms if t.child_frame_id == "camera_optical_frame"
        )
        q, t = link.transform.rotation, link.transform.translation
        return make_transform(matrix_from_quat_xyzw([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])

    turn = mount(bad)[:3, :3] @ mount(good)[:3, :3].T
    np.testing.assert_allclose(so3_log(turn), [0.0, 0.0, np.radians(2.0)], atol=1e-9)
    np.testing.assert_allclose(mount(bad)[:3, 3] - mount(good)[:3, 3], [0.01, -0.02, 0.03], atol=1e-12)
    written = json.loads((tmp_path / "faulty" / "camera.json").read_text())
    np.testing.assert_allclose(written["T_base_camera"]["matrix"], mount(good), atol=1e-12)
    np.testing.assert_allclose(written["published_T_base_camera"]["matrix"], mount(bad), atol=1e-12)
    assert written["camera_clock_offset_ms"] == 35.0


def test_laps_reuse_images_but_not_noise(scene_file, own_cache, tmp_path):
    tiny = CameraSettings(width_px=48, height_px=36, rate_hz=1.0)
    summary = run(
        tmp_path / "laps",
        base(scene_file, seconds=None, laps=2, people=0, camera=tiny, extra_views=0, surface_points=100),
    )
    bag = read(tmp_path / "laps")
    images = [(stamp_of(m), m.data.tobytes()) for _, m in bag["/camera/image_raw/compressed"]]
    half = len(images) // 2
    lap_ns = images[half][0] - images[0][0]
    assert lap_ns == round(summary.seconds / 2) * NS
    for (t0, first), (t1, second) in zip(images[:half], images[half:]):
        assert t1 - t0 == lap_ns
        assert first == second
    per_lap = lap_ns * 10 // NS
    scans = [m for _, m in bag["/scan"]]
    difference = scans[5].ranges - scans[5 + per_lap].ranges
    assert np.nanstd(difference[np.isfinite(difference)]) == pytest.approx(np.sqrt(2) * 0.01, rel=0.2)


def test_lidar_only_has_no_camera(scene_file, own_cache, tmp_path):
    run(tmp_path / "dark", base(scene_file, lidar_only=True, people=0, lidar=LidarSettings(beams=360)))
    assert set(read(tmp_path / "dark")) == {"/tf_static", "/tf", "/odom", "/scan"}
    assert not (tmp_path / "dark" / "depth_gt").exists()


def test_an_existing_folder_is_refused_and_an_interrupt_leaves_nothing(scene_file, own_cache, tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(FileExistsError, match="--force"):
        run(tmp_path / "there", base(scene_file))

    def stop(stage, done, total):
        if stage == "scanning":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "half", base(scene_file), progress=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["there"]


def test_an_unreadable_scene_is_reported_with_its_name(own_cache, tmp_path):
    (tmp_path / "broken.glb").write_bytes(b"not a scene")
    with pytest.raises(ValueError, match=r"broken\.glb"):
        run(tmp_path / "out", base(tmp_path / "broken.glb"))
