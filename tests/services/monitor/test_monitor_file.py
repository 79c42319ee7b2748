"""Messages in, a .rrd file out: entities, frames, times and rates."""

import cv2
import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import inverse, matrix_from_quat_xyzw, se2_to_se3
from beamsplat.common.messages import (
    Anchors,
    CameraModel,
    Correction,
    ExternalPose,
    Health,
    Image,
    InputHealth,
    LidarModel,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)  # fmt: skip
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.topics import TOPICS
from beamsplat.services.monitor.node import DEPTH, GRID, SCENE, MonitorConfig, MonitorNode
from tests.common.tiles import tiles

NS = 1_000_000_000
T0 = 1_700_000_000 * NS
HALF_M = np.array([5.0, 4.0])  # of the room
T_MAP_ODOM = se2_to_se3(np.array([0.5, -0.3, 0.2]))
T_BODY_LIDAR = lidar_mount(0.1, 0.0, 0.18, yaw_left_rad=0.3)
T_BODY_CAMERA = camera_mount(0.1, 0.02, 0.45, pitch_down_rad=0.1)


def _T_map_body(t_s):
    """Return the pose of a robot that drives a circle at 0.5 m/s and turns at 0.5 rad/s."""
    return se2_to_se3(np.array([np.sin(0.5 * t_s), -np.cos(0.5 * t_s), 0.5 * t_s]))


def _scan(t_s):
    """Return a scan with motion distortion: each beam starts at the lidar's pose at the beam's time."""
    beams, sweep_s = 360, 0.1
    ranges = np.zeros(beams, np.float32)
    increment = 2.0 * np.pi / beams
    for i in range(beams):
        T = _T_map_body(t_s + i * sweep_s / beams) @ T_BODY_LIDAR
        direction = T[:2, :2] @ [np.cos(-np.pi + i * increment), np.sin(-np.pi + i * increment)]
        with np.errstate(divide="ignore"):
            walls = (np.sign(direction) * HALF_M - T[:2, 3]) / direction
        ranges[i] = walls.min()
    ranges[::7] = np.inf
    return Scan(stamp_ns=_ns(t_s), angle_min_rad=-np.pi, angle_increment_rad=increment,
                time_increment_s=sweep_s / beams, scan_time_s=sweep_s, range_min_m=0.1, range_max_m=12.0,
                ranges_m=ranges)  # fmt: skip


def _ns(t_s):
    return T0 + round(t_s * NS)


def _jpeg():
    rng = np.random.default_rng(3)
    return cv2.imencode(".jpg", rng.integers(0, 255, (48, 64, 3)).astype(np.uint8))[1].ravel()


JPEG = _jpeg()


class RoomRecording(Node):
    """Publishes three seconds of a drive in the room."""

    name = "replay"
    outputs = ("rig", "camera/image", "lidar/scan", "wheel/odometry", "external/pose")

    def source(self):
        camera = CameraModel(width_px=64, height_px=48, fx_px=50.0, fy_px=51.0, cx_px=31.5, cy_px=23.5,
                             T_body_camera=T_BODY_CAMERA)  # fmt: skip
        rig = Rig(stamp_ns=0, camera=camera, lidar=LidarModel(T_body_lidar=T_BODY_LIDAR),
                  assumed=("camera height: assumed 0.45 m",))  # fmt: skip
        yield SourceItem(T0, "rig", rig)
        T_wheel_map = inverse(_T_map_body(0.0))
        for i in range(150):
            t_s = 0.02 * i
            wheel = WheelOdometry(stamp_ns=_ns(t_s), T_odom_body=T_wheel_map @ _T_map_body(t_s),
                                  velocity_m_s=np.zeros(3), angular_velocity_rad_s=np.zeros(3))  # fmt: skip
            yield SourceItem(_ns(t_s), "wheel/odometry", wheel)
            if i % 5 == 0:
                yield SourceItem(_ns(t_s), "lidar/scan", _scan(t_s))
                pose = ExternalPose(stamp_ns=_ns(t_s), T_map_body=_T_map_body(t_s))
                yield SourceItem(_ns(t_s), "external/pose", pose)
            picture = Image(stamp_ns=_ns(t_s), width_px=64, height_px=48, encoding="jpeg", data=JPEG)
            yield SourceItem(_ns(t_s), "camera/image", picture)


TILES = "-1_-1", "-1_0"  # entities of the tiles of the grid: row and column


class TrueLocalization(Node):
    """Publishes the true pose."""

    name = "localization"
    inputs = ("lidar/scan",)
    outputs = ("localization/odometry", "localization/correction", "localization/anchors",
               "localization/grid")  # fmt: skip

    def on_lidar_scan(self, scan):
        t_s = (scan.stamp_ns - T0) / NS
        if t_s == 0.0:
            yield "localization/correction", Correction(stamp_ns=T0 - 1, T_map_odom=T_MAP_ODOM)
        yield (
            "localization/odometry",
            Odometry(stamp_ns=scan.stamp_ns, T_odom_body=inverse(T_MAP_ODOM) @ _T_map_body(t_s),
                     covariance=np.eye(3), status="ok" if t_s < 2.0 else "lost", detail="dark"),
        )  # fmt: skip
        if round(t_s * 10) % 10 == 0:
            occupancy = np.full((40, 60), -1, np.int8)
            occupancy[10:20, 15:45] = 0
            occupancy[10, 15:45] = 100
            occupancy[15, 16 + round(t_s)] = 50  # a change in one tile
            for part in tiles(scan.stamp_ns, occupancy, (-20, -30), 64):
                yield "localization/grid", part
            anchors = Anchors(stamp_ns=scan.stamp_ns, anchor_ids=np.array([0, 3]),
                              T_map_anchor=np.stack([_T_map_body(0.0), _T_map_body(1.0)]))  # fmt: skip
            yield "localization/anchors", anchors


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    from tests.services.monitor.conftest import RrdFile

    path = tmp_path_factory.mktemp("monitor") / "room.rrd"
    monitor = MonitorNode(MonitorConfig(view="none", save=path, image_hz=10.0))
    Lockstep(
        [RoomRecording(RoomRecording.Config()), TrueLocalization(TrueLocalization.Config()), monitor]
    ).run()
    assert monitor.detail == f"writing {path}"
    return RrdFile(path)


def test_the_file_has_all_entities_and_a_layout(saved):
    body = "map/odom/body"
    expected = {
        "map", "map/grid", *(f"map/grid/{tile}" for tile in TILES), "map/anchors", "map/scan", "map/odom", body, f"{body}/shape", f"{body}/heading",
        f"{body}/camera", f"{body}/camera/image", "map/path/localization", "map/path/external",
        "map/path/wheel", "map/odom/path", "log", "health/state/localization",
    }  # fmt: skip
    assert saved.entities == expected
    assert saved.application == "beamsplat"
    assert saved.blueprints == 1


def test_rates_are_limited_and_time_is_that_of_measurement(saved):
    assert len(saved.stamps("map/odom/body/camera/image")) == 30  # of 150, at 10 Hz
    assert saved.stamps("map/scan") == [_ns(0.1 * i) for i in range(30)]
    assert saved.stamps("map/odom/body")[-30:] == [_ns(0.1 * i) for i in range(30)]
    assert 3 <= len(saved.stamps("map/path/localization")) <= 4
    assert len(saved.stamps(f"map/grid/{TILES[0]}")) == 2  # of 3, at 0.5 Hz
    assert len(saved.stamps(f"map/grid/{TILES[1]}")) == 1  # unchanged
    assert len(saved.stamps("map/anchors")) == 3


def test_images_are_stored_unchanged(saved):
    blobs = saved.column("map/odom/body/camera/image", "EncodedImage:blob")
    assert len(blobs) == 30
    for blob in blobs:
        assert blob.astype(np.uint8).tobytes() == JPEG.tobytes()


def test_scan_points_are_on_the_walls_while_the_robot_moves(saved):
    """The robot moves 5 cm and turns 2.9 degrees within each scan; deskewed points are within a
    centimetre.
    """
    scans = saved.column("map/scan", "Points3D:positions")
    assert len(scans) == 30
    for points in scans[:-1]:  # the last sweep has no pose at its end
        points = points.reshape(-1, 3)
        assert len(points) == 308
        np.testing.assert_allclose(points[:, 2], 0.18, atol=1e-5)
        off_wall = np.min(np.abs(np.abs(points[:, :2]) - HALF_M), axis=1)
        assert np.max(off_wall) < 0.01


def test_the_robot_is_drawn_at_the_localized_pose(saved):
    positions = saved.column("map/odom/body", "Transform3D:translation")
    quaternions = saved.column("map/odom/body", "Transform3D:quaternion")
    for i, (position, quat_xyzw) in enumerate(zip(positions[-30:], quaternions[-30:])):
        T_odom_body = inverse(T_MAP_ODOM) @ _T_map_body(0.1 * i)
        np.testing.assert_allclose(position.ravel(), T_odom_body[:3, 3], atol=1e-5)
        R = matrix_from_quat_xyzw(quat_xyzw.ravel())
        np.testing.assert_allclose(R, T_odom_body[:3, :3], atol=1e-5)
    (correction,) = saved.column("map/odom", "Transform3D:translation")
    np.testing.assert_allclose(correction.ravel(), T_MAP_ODOM[:3, 3], atol=1e-6)


def test_paths_are_in_the_map_frame(saved):
    """The wheels' frame is aligned to the map at the first known pose."""
    for source in ("localization", "external", "wheel"):
        points = saved.column(f"map/path/{source}", "LineStrips3D:strips")[-1].reshape(-1, 3)
        assert len(points) > 10, source
        radius_m = np.linalg.norm(points[1:, :2], axis=1)  # the first pose came before the correction
        np.testing.assert_allclose(radius_m, 1.0, atol=1e-4, err_msg=source)
    smooth = saved.column("map/odom/path", "LineStrips3D:strips")[-1].reshape(-1, 3)
    centre = inverse(T_MAP_ODOM)[:3, 3]
    np.testing.assert_allclose(np.linalg.norm((smooth - centre)[:, :2], axis=1), 1.0, atol=1e-4)


def test_the_camera_is_a_pinhole_on_the_body(saved):
    (K,) = saved.column("map/odom/body/camera", "Pinhole:image_from_camera")
    K = K.reshape(3, 3).T  # rerun stores columns
    np.testing.assert_allclose(K, [[50.0, 0.0, 31.5], [0.0, 51.0, 23.5], [0.0, 0.0, 1.0]])
    (position,) = saved.column("map/odom/body/camera", "Transform3D:translation")
    np.testing.assert_allclose(position.ravel(), [0.1, 0.02, 0.45], atol=1e-6)


def test_the_grid_is_cropped_to_known_cells_with_row_0_at_the_bottom(saved):
    data = saved.column(f"map/grid/{TILES[0]}", "GridMap:data")[0].astype(np.uint8).reshape(10, 15)
    assert np.all(data[-1] == 100)
    assert np.count_nonzero(data[:-1]) == 1  # the cell that changes
    corner = saved.column(f"map/grid/{TILES[0]}", "GridMap:translation")[0].ravel()
    np.testing.assert_allclose(corner[:2], [-3.0 + 1.5, -2.0 + 1.0], atol=1e-6)


def test_assumptions_and_faults_are_logged(saved):
    lines = [str(text.ravel()[0]) for text in saved.column("log", "TextLog:text")]
    assert lines == ["rig: camera height: assumed 0.45 m", "localization: ok", "localization: lost (dark)"]


def _monitor(tmp_path, **options):
    monitor = MonitorNode(MonitorConfig(view="none", save=tmp_path / "m.rrd", **options))
    monitor.configure()
    return monitor


def _tell(monitor, topic, message):
    assert list(monitor.handle(topic, message)) == []


@pytest.mark.parametrize(
    ("encoding", "row_bytes"),
    [("rgb8", 12), ("bgr8", 12), ("rgba8", 16), ("bgra8", 16), ("mono8", 4), ("yuv422_yuy2", 8)],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_padding_of_raw_images_is_removed(tmp_path, read_rrd, encoding, row_bytes, padding):
    rows = np.random.default_rng(5).integers(0, 255, (3, row_bytes + padding)).astype(np.uint8)
    monitor = _monitor(tmp_path)
    step = row_bytes + padding if padding else 0
    picture = Image(stamp_ns=T0, width_px=4, height_px=3, encoding=encoding, step_bytes=step,
                    data=rows.ravel()[: rows.size - padding])  # fmt: skip
    _tell(monitor, "camera/image", picture)
    monitor.close()
    (buffer,) = read_rrd(tmp_path / "m.rrd").column("map/odom/body/camera/image", "Image:buffer")
    np.testing.assert_array_equal(buffer.ravel().astype(np.uint8), rows[:, :row_bytes].ravel())


def test_a_raw_image_with_too_few_bytes_is_rejected(tmp_path, read_rrd):
    monitor = _monitor(tmp_path)
    short = Image(stamp_ns=T0, width_px=4, height_px=3, encoding="rgb8", data=np.zeros(35, np.uint8))
    _tell(monitor, "camera/image", short)
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    assert "map/odom/body/camera/image" not in saved.entities
    assert "too few for 3 rows of 12" in str(saved.column("log", "TextLog:text")[0])


def test_without_localization_the_best_other_source_is_used(tmp_path, read_rrd):
    monitor = _monitor(tmp_path)
    still = {"velocity_m_s": np.zeros(3), "angular_velocity_rad_s": np.zeros(3)}
    wheel_at = se2_to_se3(np.array([0.2, 0.0, 0.0]))
    _tell(monitor, "lidar/scan", _scan(0.0))  # no pose yet: drawn at the origin
    _tell(monitor, "wheel/odometry", WheelOdometry(stamp_ns=_ns(0.1), T_odom_body=wheel_at, **still))
    map_at = se2_to_se3(np.array([3.0, 1.0, 0.5]))
    _tell(monitor, "external/pose", ExternalPose(stamp_ns=_ns(0.2), T_map_body=map_at))
    _tell(monitor, "wheel/odometry", WheelOdometry(stamp_ns=_ns(0.3), T_odom_body=wheel_at, **still))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    positions = [p.ravel().tolist() for p in saved.column("map/odom/body", "Transform3D:translation")]
    assert positions == [pytest.approx([0.2, 0.0, 0.0]), pytest.approx([3.0, 1.0, 0.0])]
    assert saved.stamps("map/scan") == [_ns(0.0)]


def _health(i, **fields):
    inputs = InputHealth(topic="lidar/scan", received=10 * i, dropped=4 * i, lost=fields.pop("lost", 0),
                         undecodable=0, stale=0, age_ms=2.0)  # fmt: skip
    defaults = {"node": "depth", "instance": "a", "epoch": 0, "state": "active", "step_p95_ms": 3.0 + i}
    return Health(stamp_ns=5_000 * NS + 2 * i * NS, inputs=(inputs,), **{**defaults, **fields})


def test_health_becomes_curves_states_a_table_and_a_log(tmp_path, read_rrd):
    monitor = _monitor(tmp_path)
    monitor.on_health(_health(0, state="standby"))
    _tell(monitor, "external/pose", ExternalPose(stamp_ns=T0, T_map_body=np.eye(4)))
    monitor.on_health(_health(1))
    monitor.on_health(_health(2, lost=3, detail="warm"))
    monitor.on_health(_health(3, instance="b"))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    curve = [float(v.ravel()[0]) for v in saved.column("plots/step_p95_ms/depth", "Scalars:scalars")]
    assert curve == [3.0, 4.0, 5.0, 6.0]
    assert saved.stamps("plots/step_p95_ms/depth") == [T0] * 3  # measurement time, once there is one
    rates = [float(v.ravel()[0]) for v in saved.column("plots/dropped_hz/depth", "Scalars:scalars")]
    assert rates == [0.0, 2.0, 3.5, 0.0]
    states = [str(v.ravel()[0]) for v in saved.column("health/state/depth", "StateChange:state")]
    assert states == ["standby", "active", "active"]
    lines = [str(v.ravel()[0]) for v in saved.column("log", "TextLog:text")]
    assert lines == ["depth is standby", "depth is active", "depth: warm", "depth lost 3 messages",
                     "depth was restarted", "depth is active"]  # fmt: skip
    assert "| **depth** | active |" in str(saved.column("health/table", "TextDocument:text")[-1])


def test_a_monitor_without_output_is_rejected():
    with pytest.raises(UserError, match="choose a view"):
        MonitorNode(MonitorConfig(view="none")).configure()


def test_every_row_is_a_topic_and_none_blocks_a_publisher():
    for entry in (*SCENE, *GRID, *DEPTH):
        assert entry.topic in TOPICS
        assert entry.effective_delivery in ("latest", "latched") or entry.row.history, entry.topic
