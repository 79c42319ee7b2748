"""The clock node: one tick per second on the sensors' clock."""

from pathlib import Path

import pytest

from beamsplat.common.config.deployment import NodeConfig, load_deployment
from beamsplat.common.runtime.clock import StampClock
from beamsplat.services.clock.node import TICK_NS, ClockNode
from beamsplat.tools.system.assembly import faults

ROOT = Path(__file__).resolve().parents[3]


class SimulatedClock:
    """A stamp clock that advances only while the node sleeps."""

    def __init__(self, start_ns):
        self.time_ns = start_ns

    def now_ns(self):
        return self.time_ns

    def sleep(self, seconds):
        self.time_ns += round(seconds * 1e9)


@pytest.fixture
def simulated(monkeypatch):
    clock = SimulatedClock(7_400_000_000)
    monkeypatch.setattr("beamsplat.services.clock.node.StampClock", lambda: clock)
    monkeypatch.setattr("beamsplat.services.clock.node.time.sleep", clock.sleep)
    node = ClockNode(NodeConfig())
    node.configure()
    return clock, (item.message for item in node.source() if item is not None)


def test_one_tick_per_second_on_the_sensors_clock(simulated):
    clock, ticks = simulated
    for count, stamp_ns in enumerate((8 * TICK_NS, 9 * TICK_NS, 10 * TICK_NS)):
        tick = next(ticks)
        assert (tick.count, tick.stamp_ns) == (count, stamp_ns)
        assert (
            stamp_ns <= clock.time_ns < stamp_ns + TICK_NS // 5
        )  # never early, and soon after the full second


def test_missed_ticks_are_left_out(simulated):
    clock, ticks = simulated
    assert next(ticks).stamp_ns == 8 * TICK_NS
    clock.time_ns = 10 * TICK_NS + TICK_NS // 2  # the process was stopped for 2.5 s
    later = [next(ticks) for _ in range(3)]
    assert [tick.count for tick in later] == [1, 2, 3]
    assert [tick.stamp_ns for tick in later] == [11 * TICK_NS, 12 * TICK_NS, 13 * TICK_NS]


def test_the_node_uses_the_clock_of_the_sensors():
    node = ClockNode(NodeConfig())
    node.configure()
    tick = next(item for item in node.source() if item is not None).message
    assert 0 <= StampClock().now_ns() - tick.stamp_ns < 60 * TICK_NS


def test_deployments_of_robots_have_a_clock():
    for name in ("robot.toml", "robot_sensors.toml", "robot_ros2.toml"):
        deployment = load_deployment(ROOT / "deploy" / name, ())
        assert "clock" in deployment.nodes, name
        assert not [f for f in faults(deployment) if f.fatal and "tick" in f.text]
