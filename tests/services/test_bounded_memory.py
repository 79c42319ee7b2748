"""No node keeps more and more objects, whichever of its inputs are missing, late or impossible.

Each node handles the same stretch of messages many times, and what is reachable from it is counted at half time and
at the end. Growth with the map is allowed; here the robot stands in one place, so that there is none.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import (
    Anchors,
    CameraModel,
    Correction,
    DepthEstimate,
    ExternalPose,
    FusedDepth,
    Image,
    KeyframeAck,
    KeyframeCandidate,
    KeyframeDecision,
    LidarModel,
    MapStatus,
    Message,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
    Tick,
    WheelOdometry,
)
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.node import Job, Node, subscriptions
from beamsplat.common.runtime.registry import make_node
from beamsplat.services.nodes import NODES
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


def step(number: int, stamp_ns: int, lost: bool) -> dict[str, Callable[[], Message]]:
    """Return, by topic, how to make the message of one step of 0.1 s of a robot that turns in one place."""
    T = se2_to_se3(np.array([0.02 * (number % 5), 0.0, 0.3 * np.sin(number / 7.0)]))
    at = {"stamp_ns": stamp_ns}
    ranges = (2.0 + np.cos(np.arange(BEAMS) / 9.0 + number)).astype(np.float32)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
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
            **at, width_px=WIDTH, height_px=HEIGHT, encoding="mono8", data=np.roll(_PIXELS, number)),
        "depth/estimate": lambda: DepthEstimate(**at, source="a", kind="metric", values=depth),
        "keyframes/candidate": lambda: KeyframeCandidate(**at, T_odom_body=T, sharpness=5.0),
        "keyframes/decision": lambda: KeyframeDecision(**at, keyframe=False),
        "fusion/depth": lambda: FusedDepth(
            **at, depth_m=depth, sigma_m=0.1 * depth, keyframe=number % 3 == 0, T_odom_body=T),
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
}  # fmt: skip
# The state of a map, and what has no inputs, is tested elsewhere (tests/services/mapping, tests/tools/system).
KINDS = [("depth", "default"), ("fusion", "default"), ("keyframes", "default"), ("localization", "external")]


def play(node: Node, fault: str, first: int, stop: int) -> None:
    missing, lost, stamp_of = FAULTS[fault]
    wanted = {entry.topic for entry in subscriptions(type(node))} - set(missing)
    for number in range(first, stop):
        stamp_ns = stamp_of(number)
        for topic, make in step(number, stamp_ns, lost).items():
            if topic in wanted:
                node.on_header(Header(stamp_ns, 0, 0, number, 0, topic.partition("/")[0], "0" * 16))
                for output in node.handle(topic, make()):
                    if isinstance(output, Job):
                        list(node.handle_job(output.name, output.run()))


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize(("service", "kind"), KINDS)
def test_what_a_node_keeps_does_not_grow_with_time(service, kind, fault):
    node = make_node(NODES[service], {"kind": kind, **OPTIONS.get((service, kind), {})}, "test")
    node.configure()
    try:
        if "rig" in {entry.topic for entry in subscriptions(type(node))} and "rig" not in FAULTS[fault][0]:
            list(node.handle("rig", RIG))
        play(node, fault, 0, HALF)
        before = reachable(node)
        play(node, fault, HALF, 2 * HALF)
        after = reachable(node)
    finally:
        node.close()
    grown = {path: (before[path], size) for path, size in after.items() if size > 1.1 * before[path] + 64}
    assert not grown
    assert after.total() < 1.1 * before.total() + 256
