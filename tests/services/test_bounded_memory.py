"""No node keeps more and more objects, whichever of its inputs are missing, late or impossible.

Each node handles the same stretch of messages many times, and what is reachable from it is counted at half time and
at the end. Growth with the map is allowed; here the robot stands in one place, so that there is none. Limits that a
short test does not reach are lowered.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry import tracks
from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import (
    Anchors,
    CameraModel,
    Cloud,
    Correction,
    DepthEstimate,
    ExternalPose,
    FusedDepth,
    Health,
    Image,
    Keyframe,
    KeyframeAck,
    KeyframeCandidate,
    KeyframeDecision,
    LidarModel,
    MapAnchors,
    MapChunk,
    MapPoses,
    MapPreview,
    MapStatus,
    Message,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
    Tick,
    WheelOdometry,
)
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.runtime.node import Job, Node, subscriptions
from beamsplat.common.runtime.registry import make_node
from beamsplat.services.localization.lidar2d import odometry
from beamsplat.services.mapping import intake
from beamsplat.services.monitor.node import MonitorNode
from beamsplat.services.nodes import NODES
from beamsplat.services.ros2_out import conversions
from tests.common.tiles import tile
from tests.services.reachable import reachable

WIDTH, HEIGHT, BEAMS = 64, 48, 90
HALF = 300  # steps of 0.1 s: longer than any window of the nodes, in time and in number
_PIXELS = np.random.default_rng(5).integers(0, 255, WIDTH * HEIGHT).astype(np.uint8)
RIG = Rig(
    stamp_ns=1,
    camera=CameraModel(
        width_px=WIDTH, height_px=HEIGHT, fx_px=55.0, fy_px=55.0, cx_px=31.5, cy_px=23.5,
        T_body_camera=camera_mount(0.1, 0.0, 0.45),
    ),
    lidar=LidarModel(T_body_lidar=lidar_mount(0.0, 0.0, 0.18)),
)  # fmt: skip


def _ranges_m(x_m: float, yaw_rad: float) -> np.ndarray:
    """Return what a lidar measures at (x, 0, yaw) in a room of 4 x 3 m, float32 [BEAMS]."""
    angle = yaw_rad - 3.1 + 0.069 * np.arange(BEAMS)
    c, s = np.cos(angle), np.sin(angle)
    ranges = np.minimum(
        np.where(c > 0, 2.2 - x_m, 1.8 + x_m) / np.abs(c), np.where(s > 0, 1.0, 2.0) / np.abs(s)
    )
    return ranges.astype(np.float32)


def step(number: int, stamp_ns: int, lost: bool) -> dict[str, Callable[[], Message]]:
    """Return, by topic, how to make the message of one step of 0.1 s of a robot that turns in one place."""
    x_m, yaw_rad = 0.005 * (number % 5), 0.3 * np.sin(number / 7.0)
    T = se2_to_se3(np.array([x_m, 0.0, yaw_rad]))
    at = {"stamp_ns": stamp_ns}
    ranges = _ranges_m(x_m, yaw_rad)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    pixels = np.roll(_PIXELS, number)
    jpeg = cv2.imencode(".jpg", pixels.reshape(HEIGHT, WIDTH))[1].ravel()
    status = "ok" if number % 2 else f"refused because of {number}"
    return {
        "tick": lambda: Tick(**at, count=number),
        "wheel/odometry": lambda: WheelOdometry(
            **at, T_odom_body=T, velocity_m_s=np.zeros(3), angular_velocity_rad_s=np.zeros(3)),
        "external/pose": lambda: ExternalPose(**at, T_map_body=T),
        "lidar/scan": lambda: Scan(
            **at, angle_min_rad=-3.1, angle_increment_rad=0.069, time_increment_s=0.001, scan_time_s=0.1,
            range_min_m=0.1, range_max_m=12.0, ranges_m=ranges),
        "localization/movers": lambda: MovingBeams(**at, moving=np.zeros(BEAMS, bool)),
        "localization/odometry": lambda: Odometry(
            **at, T_odom_body=T, covariance=np.eye(3), status="lost" if lost else "ok"),
        "localization/correction": lambda: Correction(**at, T_map_odom=np.eye(4)),
        "localization/anchors": lambda: Anchors(
            **at, anchor_ids=np.array([0]), T_map_anchor=np.eye(4)[None], map_uuid="a"),
        "camera/image": lambda: Image(
            **at, width_px=WIDTH, height_px=HEIGHT, encoding="mono8", data=pixels),
        "depth/estimate": lambda: DepthEstimate(**at, source="a", kind="metric", values=depth),
        "keyframes/candidate": lambda: KeyframeCandidate(**at, T_odom_body=T, sharpness=5.0),
        "keyframes/decision": lambda: KeyframeDecision(**at, keyframe=False),
        "fusion/depth": lambda: FusedDepth.of(
            **at, depth_m=depth, sigma_m=0.1 * depth, keyframe=number % 3 == 0, T_odom_body=T),
        "fusion/cloud": lambda: Cloud(
            **at, points_odom_m=np.ones((9, 3), np.float32), colours=np.ones((9, 3), np.uint8)),
        "localization/grid": lambda: tile(
            **at, cells=np.zeros((8, 8), np.int8), row=number, map_uuid="b" if lost else "a"),
        "keyframes/frame": lambda: Keyframe(
            **at, id=number, encoding="jpeg", picture=jpeg, camera=RIG.camera, anchor_id=number % 2,
            T_anchor_body=T, T_map_anchor=np.eye(4), depth=pack_depth(depth),
            sigma=pack_sigma(0.1 * depth), map_uuid="b" if lost and number % 2 else "a"),
        "mapping/chunk": lambda: MapChunk(
            **at, anchor_id=number % 2, revision=number, T_map_anchor=np.eye(4), count=3,
            packed=pack(np.full((14, 3), 0.5, np.float32))),
        "mapping/anchors": lambda: MapAnchors(
            **at, pose_revision=number, anchor_ids=np.arange(2), T_map_anchor=np.array([T, T])),
        "mapping/poses": lambda: MapPoses(
            **at, keyframe_ids=np.arange(2), stamps_ns=np.arange(2), T_map_body=np.array([T, T])),
        "mapping/preview": lambda: MapPreview(
            **at, keyframe_id=number, render=jpeg, T_map_camera=T, camera=RIG.camera),
        "keyframes/ack": lambda: KeyframeAck(**at, id=stamp_ns, status=status),
        "mapping/status": lambda: MapStatus(**at, status=status),
    }  # fmt: skip


# Name of the fault -> (missing topics, whether localization is lost, stamp of each step).
FAULTS = {
    "nothing is missing": ((), False, lambda i: 10**18 + i * 10**8),
    "localization is lost": ((), True, lambda i: 10**18 + i * 10**8),
    "no poses": (
        ("localization/odometry", "external/pose", "wheel/odometry"), False, lambda i: 10**18 + i * 10**8),
    "no answers": (("keyframes/decision", "keyframes/ack", "fusion/depth"), False, lambda i: 10**18 + i * 10**8),
    "no images": (("camera/image",), False, lambda i: 10**18 + i * 10**8),
    "no estimates": (("depth/estimate",), False, lambda i: 10**18 + i * 10**8),
    "no calibration": (("rig",), False, lambda i: 10**18 + i * 10**8),
    "the clock stands still": ((), False, lambda i: 10**18),
    "the clock runs backwards": ((), False, lambda i: 10**18 - i * 10**8),
    "the clock jumps": ((), False, lambda i: 10**18 + i * 10**8 + (i % 7 == 0) * 2 * 10**18),
}  # fmt: skip
OPTIONS = {
    ("fusion", "default"): {"method": "ratio"},
    ("keyframes", "default"): {"queue_mb": 0.05},
    ("localization", "camera"): {"width_px": 64},
    ("mapping", "default"): {
        "half_steps": 1, "full_steps": 1, "tick_steps": 1, "mend_steps": 1, "max_keyframes": 6, "max_gaussians": 1000,
    },
    ("monitor", "rerun"): {"view": "none", "save": "{folder}/monitor.rrd"},
    ("page", "default"): {"port": 0},
    ("recorder", "default"): {"out": "{folder}/recording", "sync": False},
    ("ros2_out", "default"): {"router": "{endpoint}"},
}  # fmt: skip
KINDS = [
    ("depth", "default"), ("fusion", "default"), ("keyframes", "default"), ("localization", "external"),
    ("localization", "lidar"), ("localization", "camera"), ("mapping", "default"), ("monitor", "rerun"),
    ("page", "default"), ("recorder", "default"), ("ros2_out", "default"),
]  # fmt: skip
# Sources have no inputs. What is tested about them, and where:
SOURCES = {
    ("replay", "default"): "it reads a bag in parts: tests/services/replay/test_bags.py",
    ("camera", "opencv"): "counts of rejected images: tests/services/camera/test_camera.py",
    ("camera", "none"): "it publishes one message",
    ("lidar", "rplidar"): "damaged streams: tests/services/lidar/test_streams.py and test_soak.py",
    ("lidar", "ldrobot"): "damaged streams: tests/services/lidar/test_streams.py and test_soak.py",
    ("lidar", "hokuyo"): "damaged streams: tests/services/lidar/test_streams.py and test_soak.py",
    ("ros2", "default"): "names and values from outside: tests/services/ros2/test_hostile_robot.py",
    ("clock", "default"): "it keeps a count",
    ("uplink", "default"): "garbage on every key: tests/services/uplink/test_uplink.py",
}
STEPS = {  # half of them, where limits are reached earlier
    ("localization", "lidar"): 60, ("localization", "camera"): 40, ("mapping", "default"): 40,
    ("monitor", "rerun"): 40, ("page", "default"): 60, ("recorder", "default"): 60,
    ("ros2_out", "default"): 40,
}  # fmt: skip
QUICK = ("localization is lost",)  # the other faults of slow nodes are slow tests
SLOW_NODES = {
    ("depth", "default"), ("fusion", "default"), ("keyframes", "default"), *STEPS,
}  # fmt: skip
# What may grow: the index at the end of an MCAP file, with the file; the pose graph and the grid of the lidar SLAM, with
# the map (test_grid_tiles.py and test_saved_map.py have the limits).
GROWING = ("node.writer._writer", "node._slam.active_submaps.pose_graph", "node._grid")


CASES = [
    pytest.param(
        service, kind, fault,
        marks=[pytest.mark.slow] if (service, kind) in SLOW_NODES and fault not in QUICK else [],
    )
    for service, kind in KINDS
    for fault in FAULTS
]  # fmt: skip


def test_every_row_of_the_process_list_is_here_or_has_a_reason():
    rows = {(service.name, kind) for service in NODES.values() for kind in service.kinds}
    assert {*KINDS, *SOURCES} == rows
    assert all(subscriptions(NODES[name].load(kind)) for name, kind in KINDS)
    assert not any(subscriptions(NODES[name].load(kind)) for name, kind in SOURCES)


def make(service: str, kind: str, folder, endpoint: str, **more: object) -> Node:
    """Return a configured node with the options of these tests, and `more`."""
    options = {
        name: value.format(folder=folder, endpoint=endpoint) if isinstance(value, str) else value
        for name, value in OPTIONS.get((service, kind), {}).items()
    }
    node = make_node(NODES[service], {"kind": kind, **options, **more}, "test")
    node.configure()
    return node


class Player:
    """Hands messages to a node, and the results of its jobs when they are due."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._jobs: list[tuple[int, Job]] = []  # messages until it is due

    def send(self, topic: str, message: Message, header: Header) -> None:
        counted = [(left - (job.of in (None, topic)), job) for left, job in self._jobs]
        self._jobs = [entry for entry in counted if entry[0] > 0]
        for left, job in counted:
            if left <= 0:
                self._take(self.node.handle_job(job.name, job.run()))
        self._take(self.node.handle_arrival(topic, message))
        self.node.on_header(header)
        self._take(self.node.handle(topic, message))
        while self.node.has_idle_work():
            self._take(self.node.handle_idle())

    def end(self) -> None:
        self._take(self.node.handle_drain())

    def _take(self, outputs) -> None:
        for output in outputs:
            if isinstance(output, Job):
                self._jobs.append((output.after or 1, output))

    def play(self, fault: str, first: int, stop: int) -> None:
        missing, lost, stamp_of = FAULTS[fault]
        wanted = {entry.topic for entry in subscriptions(type(self.node))} - set(missing)
        for number in range(first, stop):
            stamp_ns = stamp_of(number)
            for topic, message in step(number, stamp_ns, lost).items():
                if topic in wanted:
                    producer = topic.partition("/")[0]
                    self.send(topic, message(), Header(stamp_ns, 0, 0, number, 0, producer, "0" * 16))
            if self.node.watches_health():  # of nodes that are restarted again and again
                self.node.on_health(
                    Health(
                        stamp_ns=stamp_ns,
                        node=f"n{number % 4}",
                        instance=f"{number:016x}",
                        epoch=number,
                        state="active",
                    )
                )


def size_of(node: Node) -> Counter[str]:
    if isinstance(node, MonitorNode):  # it hands drawings to another thread
        node.writer.flush()
    return reachable(node)


def lower_limits(node: Node) -> None:
    """Lower limits of a configured node that so few steps do not reach."""
    tracker = getattr(node, "_tracker", None)
    if tracker is not None:
        tracker.settings = tracker.splats.settings = replace(
            tracker.settings, max_keyframes=8, max_gaussians=500
        )


@pytest.mark.parametrize(("service", "kind", "fault"), CASES)
def test_what_a_node_keeps_does_not_grow_with_time(
    service, kind, fault, tmp_path, router_endpoint, monkeypatch
):
    monkeypatch.setattr(intake, "_MAX_REJECTIONS", 10)
    monkeypatch.setattr(tracks, "RECENT_POSES", 20)
    monkeypatch.setattr(conversions, "_MAX_POSES", 20)
    monkeypatch.setattr(odometry, "_MAX_PENDING", 20)
    node = make(service, kind, tmp_path, router_endpoint)
    half = STEPS.get((service, kind), HALF)
    try:
        player = Player(node)
        if "rig" in {entry.topic for entry in subscriptions(type(node))} and "rig" not in FAULTS[fault][0]:
            player.send("rig", RIG, Header(1, 0, 0, 0, 0, "camera", "0" * 16))
        lower_limits(node)
        player.play(fault, 0, half)
        before = size_of(node)
        player.play(fault, half, 2 * half)
        after = size_of(node)
    finally:
        node.close()
    for sizes in (before, after):
        for path in [path for path in sizes if path.startswith(GROWING)]:
            del sizes[path]
    grown = {path: (before[path], size) for path, size in after.items() if size > 1.1 * before[path] + 64}
    assert not grown
    assert after.total() < 1.1 * before.total() + 256
