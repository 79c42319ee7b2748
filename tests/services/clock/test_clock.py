"""The clock node: one tick per second on the sensors' clock."""

import time
from itertools import pairwise
from pathlib import Path

from beamsplat.common.config.deployment import NodeConfig, load_deployment
from beamsplat.common.runtime.clock import StampClock
from beamsplat.services.clock.node import TICK_NS, ClockNode
from beamsplat.tools.system.assembly import faults

ROOT = Path(__file__).resolve().parents[3]


def ticks(node, count):
    found = []
    for item in node.source():
        if item is not None:
            found.append((item.message, StampClock().now_ns()))
        if len(found) == count:
            return found


def test_one_tick_per_second_on_the_sensors_clock():
    node = ClockNode(NodeConfig())
    node.configure()
    said = ticks(node, 3)
    stamps = [message.stamp_ns for message, _ in said]
    assert [message.count for message, _ in said] == [0, 1, 2]
    assert all(stamp % TICK_NS == 0 for stamp in stamps)
    assert all(b - a == TICK_NS for a, b in pairwise(stamps))
    assert all(at_ns >= message.stamp_ns for message, at_ns in said)  # never before its stamp


def test_missed_ticks_are_left_out():
    node = ClockNode(NodeConfig())
    node.configure()
    source = node.source()
    first = next(item for item in source if item is not None).message
    time.sleep(2.3)
    later = [next(item for item in source if item is not None).message for _ in range(2)]
    assert [message.count for message in later] == [1, 2]
    assert later[0].stamp_ns - first.stamp_ns >= 3 * TICK_NS  # the missed ticks are left out
    assert later[1].stamp_ns - later[0].stamp_ns == TICK_NS


def test_deployments_of_robots_have_a_clock():
    for name in ("robot.toml", "robot_sensors.toml", "robot_ros2.toml"):
        deployment = load_deployment(ROOT / "deploy" / name, ())
        assert "clock" in deployment.nodes, name
        assert not [f for f in faults(deployment) if f.fatal and "tick" in f.text]
