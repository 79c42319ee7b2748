"""A ROS 2 recording, replayed with rmw_zenoh's keys by another process, through a router."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.messages import Cloud, Correction, Odometry
from beamsplat.common.runtime.live import Live, LiveSettings
from beamsplat.common.runtime.node import Input
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.services.ros2.config import Ros2Config
from beamsplat.services.ros2.node import Ros2Node
from beamsplat.services.ros2_out.config import Ros2OutConfig
from beamsplat.services.ros2_out.node import Ros2OutNode
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.tiles import tile
from tests.services.replay.make_bags import START_NS, T_BASE_CAMERA, T_BASE_LIDAR, Drive, write_bag

ROOT = Path(__file__).resolve().parents[3]


class RobotProcess:
    def __init__(self, endpoint, domain, bag, rate=1.0, seconds=1e9, now=False, tf=False):
        self.lines = []
        command = [sys.executable, "-m", "tests.services.ros2.robot_process", endpoint, str(domain), str(bag),
                   str(rate), str(seconds), str(int(now)), str(int(tf))]  # fmt: skip
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(json.loads(line))

    def on(self, topic):
        return [line for line in list(self.lines) if line["topic"] == topic]

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.process.kill()
        self.process.wait()


class RunningNodes:
    """Runs nodes on the bus, each in a thread."""

    def __init__(self, endpoint, folder, *nodes):
        settings = LiveSettings("test", (endpoint,), folder)
        self.lives = [Live(node, settings) for node in nodes]
        self.faults = []
        self.threads = [threading.Thread(target=self._run, args=(live,), daemon=True) for live in self.lives]

    def _run(self, live):
        try:
            live.run()
        except ValueError as error:
            self.faults.append(str(error))

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *exception):
        for live in self.lives:
            live.stop()
        for thread in self.threads:
            thread.join(10)
            assert not thread.is_alive()


def _wait(until, timeout=30.0, say=lambda: ""):
    deadline = time.monotonic() + timeout
    while not until():
        assert time.monotonic() < deadline, say()
        time.sleep(0.02)


def _collect(bus, *topics):
    got = {topic: [] for topic in topics}
    for topic in topics:
        delivery = "latched" if topic == "rig" else "every"
        bus.subscribe(Input(topic, delivery), lambda x, t=topic: got[t].append(x.message), lambda *a: None,
                      lambda *a: None)  # fmt: skip
    return got


def test_a_ros2_robot_needs_no_options(tmp_path, free_endpoint):
    """With only the domain set, calibration, scans, images and odometry arrive with unchanged stamps
    and bytes.
    """
    bag = write_bag(tmp_path, "mcap", Drive(seconds=6.0))
    node = Ros2Node(Ros2Config(domain=3, router=free_endpoint))
    topics = ("rig", "lidar/scan", "camera/image", "wheel/odometry")
    with open_router((free_endpoint,)), Bus(open_session((free_endpoint,)), "test", "x", "cd" * 8, 1) as bus:
        got = _collect(bus, *topics)
        with (
            RunningNodes(free_endpoint, tmp_path / "state", node),
            RobotProcess(free_endpoint, 3, bag) as robot,
        ):
            _wait(lambda: all(len(got[t]) >= (1 if t == "rig" else 20) for t in topics),
                  say=lambda: f"{node.robot.status} {[(t, len(v)) for t, v in got.items()]}")  # fmt: skip
            tokens = [str(r.ok.key_expr) for r in bus.session.liveliness().get("@ros2_lv/3/**")]
    (rig,) = got["rig"]
    assert rig.camera.T_body_camera == pytest.approx(T_BASE_CAMERA, abs=1e-9)
    assert rig.lidar.T_body_lidar == pytest.approx(T_BASE_LIDAR, abs=1e-9)
    assert rig.camera.fx_px == 50.0
    scans = got["lidar/scan"]
    steps = [round((s.stamp_ns - START_NS) / 1e8) for s in scans]
    assert steps == list(range(steps[0], steps[0] + len(steps)))  # every one, in order
    for step, scan in zip(steps, scans):
        assert scan.ranges_m[2:] == pytest.approx(2.0 + 0.01 * step, abs=1e-6)
    assert all(bytes(image.data[:2]) == b"\xff\xd8" for image in got["camera/image"])
    assert got["wheel/odometry"][-1].velocity_m_s.tolist() == [1.0, 0.0, 0.0]
    assert any("/NN/%/%/beamsplat" in token for token in tokens)  # `ros2 node list` shows us
    assert robot.process.returncode is not None


@pytest.mark.parametrize(
    ("drive", "said"),
    [
        (Drive(seconds=60.0, tf=""), "calibration is missing: the position of the"),
        (Drive(seconds=60.0, info_px=None), "no sensor_msgs/CameraInfo was received"),
        (Drive(seconds=60.0, odometry=False, extra_scan="/scan_back"), "several topics for scan: /scan, /scan_back"),
        (Drive(seconds=60.0, info_px=(32, 24)), "K is for 32x24 px"),
    ],
)  # fmt: skip
def test_missing_or_contradicting_topics_are_reported(tmp_path, free_endpoint, drive, said):
    bag = write_bag(tmp_path, "mcap", drive)
    node = Ros2Node(Ros2Config(domain=0, router=free_endpoint, settle_s=0.5))
    with open_router((free_endpoint,)), Bus(open_session((free_endpoint,)), "test", "x", "cd" * 8, 1) as bus:
        got = _collect(bus, "lidar/scan", "camera/image")
        running = RunningNodes(free_endpoint, tmp_path / "state", node)
        with running, RobotProcess(free_endpoint, 0, bag):
            _wait(lambda: said in node.detail or any(said in fault for fault in running.faults),
                  say=lambda: f"{node.detail} {running.faults}")  # fmt: skip
    assert got == {"lidar/scan": [], "camera/image": []}


def test_images_of_another_size_and_damaged_ones_are_rejected():
    import cv2
    from rosbags.typesys import Stores, get_typestore

    from beamsplat.services.ros2.robot import RosRobot, RosRobotOptions

    robot = RosRobot(RosRobotOptions(assume_mounts=True, settle_s=0.0, without=frozenset({"scan"})))
    store = get_typestore(Stores.ROS2_HUMBLE)
    new = lambda name, **fields: store.types[name](**fields)  # noqa: E731
    header = lambda ns: new("std_msgs/msg/Header", frame_id="camera",  # noqa: E731
                            stamp=new("builtin_interfaces/msg/Time", sec=0, nanosec=ns))  # fmt: skip

    def picture(width, height, ns, cut=0):
        data = cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8))[1].ravel()
        message = new("sensor_msgs/msg/CompressedImage", header=header(ns), format="jpeg",
                      data=data[: len(data) - cut])  # fmt: skip
        return bytes(store.serialize_cdr(message, message.__msgtype__))

    K = np.array([50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1])
    roi = new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    info = new("sensor_msgs/msg/CameraInfo", header=header(1), height=48, width=64, distortion_model="plumb_bob",
               d=np.zeros(5), k=K, r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi)  # fmt: skip
    take = lambda topic, kind, data: robot.convert(topic, f"sensor_msgs/msg/{kind}", data, 7, 0.0)  # noqa: E731
    take("/cam/camera_info", "CameraInfo", bytes(store.serialize_cdr(info, info.__msgtype__)))
    name = ("/cam/image/compressed", "CompressedImage")
    assert [t for t, _ in take(*name, picture(64, 48, 5))] == ["rig"]
    assert [m.stamp_ns for _, m in take(*name, picture(64, 48, 6))] == [6]
    assert take(*name, picture(32, 24, 7)) == []
    assert "32x24" in robot.status
    assert take(*name, picture(64, 48, 8, cut=20)) == []
    assert take(*name, b"\x00\x01\x00\x00rubbish") == []
    assert [m.stamp_ns for _, m in take(*name, picture(64, 48, 0))] == [7]  # no stamp: when it came
    assert robot.rejected[name[0]] == 3


def test_results_are_published_with_attachments_and_tokens(tmp_path, free_endpoint):
    bag = write_bag(tmp_path, "mcap", Drive(seconds=0.1, odometry=False))
    node = Ros2OutNode(Ros2OutConfig(domain=5, router=free_endpoint))
    rng = np.random.default_rng(0)
    with (
        open_router((free_endpoint,)),
        Bus(open_session((free_endpoint,)), "test", "all", "cd" * 8, 1) as bus,
        RunningNodes(free_endpoint, tmp_path / "state", node),
    ):
        _wait(lambda: "ros2_out" in bus.alive_nodes())
        said = {t: bus.publish(t) for t in ("localization/correction", "localization/odometry",
                                           "localization/grid", "fusion/cloud", "wheel/odometry")}  # fmt: skip
        T = np.eye(4)
        T[0, 3] = 2.0
        said["localization/grid"].put(tile(4, np.zeros((8, 8), np.int8)))
        time.sleep(0.5)
        with RobotProcess(free_endpoint, 5, bag, seconds=0.05) as robot:
            _wait(lambda: robot.on("end"))
            said["localization/correction"].put(Correction(stamp_ns=4, T_map_odom=T))
            time.sleep(0.3)
            for i in range(3):
                stamp_ns = 10**9 * (i + 1)
                status = "lost" if i == 1 else "ok"
                said["localization/odometry"].put(
                    Odometry(stamp_ns=stamp_ns, T_odom_body=T, covariance=np.eye(3), status=status)
                )
            points = rng.uniform(-1, 1, (9, 3)).astype(np.float32)
            said["fusion/cloud"].put(
                Cloud(stamp_ns=5, points_odom_m=points, colours=np.zeros((9, 3), np.uint8))
            )
            said["localization/grid"].put(tile(6, np.zeros((8, 8), np.int8), row=1, remaining=1))
            said["localization/grid"].put(tile(6, np.full((8, 8), 100, np.int8), row=2))
            said["localization/grid"].put(tile(7, np.full((8, 8), 50, np.int8), row=1))
            _wait(lambda: len(robot.on("/beamsplat/pose")) == len(robot.on("/tf")) == 2 and robot.on("/beamsplat/cloud")
                  and robot.on("/map_updates"), say=lambda: str(robot.lines))  # fmt: skip
        tokens = [str(r.ok.key_expr) for r in bus.session.liveliness().get("@ros2_lv/5/**")]
    poses = robot.on("/beamsplat/pose")
    assert [p["x"] for p in poses] == [4.0, 4.0]
    assert [p["stamp_ns"] for p in poses] == [10**9, 3 * 10**9]  # nothing while it is lost
    assert [p["sequence"] for p in poses] == [1, 2]
    assert all(line["same_bytes"] and line["hash_right"] for line in robot.lines if line["topic"] != "end")
    assert all(abs(line["source_age_s"]) < 60 for line in poses)
    assert robot.on("/map")[-1]["cells"] == [24, 8, 192]
    assert robot.on("/map_updates")[-1]["cells"] == [8, 0, 8, 8, 64]  # row, column, height, width
    assert robot.on("/beamsplat/cloud")[0]["points"] == 9
    assert robot.on("/tf")[0]["edges"] == [["map", "odom", 2.0], ["odom", "base_link", 2.0]]
    import xxhash

    gids = {xxhash.xxh3_128(t.encode()).intdigest().to_bytes(16, "little").hex() for t in tokens}
    assert {line["gid"] for line in robot.lines if line["topic"] != "end"} <= gids


@pytest.mark.slow
def test_a_recorded_drive_runs_the_whole_system_over_ros2(tmp_path, free_endpoint, shared_dir):
    """house_a's bag, replayed with ROS 2's keys: SLAM, depth and fusion run, and ROS receives map and
    poses.
    """
    nodes = {
        "ros2": {"domain": 9, "router": free_endpoint}, "localization": {"kind": "lidar", "grid_every_scans": 20},
        "depth": {"source": "stixel"}, "fusion": {}, "ros2_out": {"domain": 9, "router": free_endpoint},
    }  # fmt: skip
    deployment = Deployment(
        robot="test", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes=nodes
    )
    with (
        Supervisor(deployment) as supervisor,
        Bus(open_session((free_endpoint,)), "test", "x", "cd" * 8, 1) as bus,
    ):
        got = _collect(bus, "localization/odometry", "fusion/depth")
        _wait(lambda: {"ros2_out", "fusion", "localization"} <= bus.alive_nodes(), 60.0)
        with RobotProcess(free_endpoint, 9, shared_dir / "data" / "house_a" / "bag", seconds=14.0) as robot:
            _wait(lambda: robot.on("end"), 60.0, say=lambda: supervisor.log_dir)
    ok = [x for x in got["localization/odometry"] if x.status == "ok"]
    assert len(ok) > 80
    assert [x.status for x in got["fusion/depth"]].count("ok") > 5
    assert len(robot.on("/beamsplat/pose")) > 80
    assert robot.on("/map")
    assert {edge[0] + ">" + edge[1] for line in robot.on("/tf") for edge in line["edges"]} == {"map>odom"}


def test_wheel_odometry_is_taken_from_tf(tmp_path, free_endpoint):
    """Without an Odometry topic, odom -> base_link on /tf is the odometry; our own /tf is ignored."""
    bag = write_bag(tmp_path, "mcap", Drive(seconds=8.0, odometry=False, tf="repeated"))
    node = Ros2Node(Ros2Config(domain=5, router=free_endpoint))
    out = Ros2OutNode(Ros2OutConfig(domain=5, router=free_endpoint))
    with open_router((free_endpoint,)), Bus(open_session((free_endpoint,)), "test", "x", "cd" * 8, 1) as bus:
        got = _collect(bus, "rig", "wheel/odometry")
        said = bus.publish("localization/odometry")
        with (
            RunningNodes(free_endpoint, tmp_path / "state", node, out),
            RobotProcess(free_endpoint, 5, bag, tf=True),
        ):
            elsewhere = np.eye(4)
            elsewhere[0, 3] = 50.0
            for i in range(10_000):  # what ros2_out publishes on /tf must not be taken for the robot's
                if len(got["wheel/odometry"]) >= 20 or i == 600:
                    break
                said.put(Odometry(stamp_ns=START_NS + i * 10**8, T_odom_body=elsewhere, covariance=np.eye(3)))
                time.sleep(0.05)
    assert got["rig"][0].lidar.T_body_lidar == pytest.approx(T_BASE_LIDAR, abs=1e-9)
    wheels = got["wheel/odometry"]
    assert len(wheels) >= 20, node.robot.status
    steps = [round((w.stamp_ns - START_NS) / 1e8) for w in wheels]
    assert steps == list(range(steps[0], steps[0] + len(steps)))
    for step, wheel in zip(steps, wheels):
        assert wheel.T_odom_body[:3, 3] == pytest.approx([0.1 * step, 0.0, 0.0], abs=1e-9)
        assert wheel.velocity_m_s == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert "/tf" in node.robot.status
