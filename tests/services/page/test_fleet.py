"""The page of an edge server: two robots on real Zenoh sessions, and what real requests return about them."""

import contextlib
import json
import re
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import Correction, Health, NodeFigure, Odometry
from beamsplat.common.messages.header import local_clock_id
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.services.page import fleet as fleet_module
from beamsplat.services.page.fleet import Fleet
from beamsplat.services.page.view import PageState
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll, wait_until
from tests.common.tiles import tiles
from tests.conftest import free_port
from tests.services.page.webhook_receiver import Receiver

OTHER_HOST = 12345
X_M = {"robot1": 1.5, "robot2": -2.5}


class Robot:
    """The nodes `localization` and `uplink` of one robot, on a real session each."""

    def __init__(self, name, endpoint, stack):
        self.name, self._sent = name, 0
        self.buses = {
            node: stack.enter_context(Bus(open_session((endpoint,)), name, node, f"{i + 1:016x}", 1))
            for i, node in enumerate(("localization", "uplink"))
        }
        pose = self.buses["localization"]
        names = ("localization/odometry", "localization/correction", "localization/grid")
        self._publications = {topic: pose.publish(topic) for topic in names}
        occupancy = np.zeros((40, 60), np.int8)
        occupancy[0] = 100
        if name == "robot2":
            occupancy = occupancy[:, :30]
        for part in tiles(1, occupancy, (0, 0), 32):
            self._publications["localization/grid"].put(part)
        T_map_odom = se2_to_se3(np.array([X_M[name], 0.0, 0.0]))
        self._publications["localization/correction"].put(Correction(stamp_ns=1, T_map_odom=T_map_odom))

    def report(self, status="ok", link_up=1.0):
        """Publish one pose, and one health report of each node."""
        self._sent += 1
        self._publications["localization/odometry"].put(
            Odometry(stamp_ns=self._sent * 10**8, T_odom_body=np.eye(4), covariance=np.eye(3))
        )
        for node, bus in self.buses.items():
            figures = (NodeFigure(name="link_up", value=link_up),) if node == "uplink" else ()
            bus.publish_health(
                Health(
                    stamp_ns=1, node=node, instance=bus.producer.instance, epoch=1, state="active",
                    status=status if node == "localization" else "", figures=figures, clock_id=OTHER_HOST,
                )
            )  # fmt: skip


class EdgePage:
    """A page process of an edge server, with its supervisor."""

    def __init__(self, supervisor, session, endpoint):
        self.supervisor, self.endpoint = supervisor, endpoint
        self.board = HealthTable(session, "edge")
        poll(supervisor, lambda: self.board.states().get("page") == "active", 60)
        detail = self.board.records["page"].health.detail
        self.address = re.search(r"http://\S+?/", detail)[0]

    def get(self, path):
        with urllib.request.urlopen(self.address + path, timeout=10) as reply:
            return reply.read()

    def robots(self):
        return {robot["name"]: robot for robot in json.loads(self.get("robots"))["robots"]}


@pytest.fixture
def start(tmp_path, free_endpoint, monkeypatch):
    monkeypatch.setenv("no_proxy", "*")
    with contextlib.ExitStack() as stack:

        def starter(**alerts):
            deployment = Deployment(
                robot="edge", role="edge", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path,
                nodes={"page": {"port": free_port(), "fleet": True, "alerts": alerts}},
            )  # fmt: skip
            supervisor = stack.enter_context(Supervisor(deployment))
            session = stack.enter_context(open_session((free_endpoint,)))
            return EdgePage(supervisor, session, free_endpoint)

        yield starter


def test_the_edge_lists_each_robot_with_status_map_and_its_own_view(start):
    page = start()
    with contextlib.ExitStack() as stack:
        first, second = (Robot(name, page.endpoint, stack) for name in ("robot1", "robot2"))

        def heard():
            first.report()
            second.report(status="lost: no beam matches", link_up=0.0)
            robots = page.robots()
            return robots.keys() == {"edge", "robot1", "robot2"} and all(
                robots[n]["map"] and robots[n]["link"] != "none" and robots[n]["localization"] for n in X_M
            )

        wait_until(heard)
        robots = page.robots()
        assert robots["edge"]["own"]
        own = page.board.records["page"]
        assert own.health.clock_id == local_clock_id()
        assert 0.0 < own.figure("disk_free_bytes") < own.figure("disk_size_bytes")
        facts = ("own", "nodes", "running", "localization", "link")
        assert [robots["robot1"][f] for f in facts] == [False, 2, 2, "ok", "up"]
        assert [robots["robot2"][f] for f in facts] == [False, 2, 2, "lost: no beam matches", "down"]
        assert all(0.0 <= robots[name]["age_s"] < 5.0 for name in X_M)
        # The view of each: its own pose, map and nodes, not those of the other.
        for name, cells in (("robot1", 60), ("robot2", 30)):
            status = json.loads(page.get(f"robots/{name}/status"))
            assert {node["name"] for node in status["nodes"]} == {"localization", "uplink"}
            assert (status["page"]["robot"], status["page"]["commands"]) == (name, False)
            png = np.frombuffer(page.get(f"robots/{name}/picture/map"), np.uint8)
            assert cv2.imdecode(png, cv2.IMREAD_UNCHANGED).shape == (40, cells, 4)
            assert b"<title>BeamSplat</title>" in page.get(f"robots/{name}/")
            with urllib.request.urlopen(f"{page.address}robots/{name}/events", timeout=10) as events:
                poses = (json.loads(line[5:]) for line in events if b'"x_m"' in line and b"source" in line)
                # The first one may be from before the robot's pose has arrived.
                assert any(pose["x_m"] == X_M[name] for pose in poses)
        assert b"fleet.js" in page.get("fleet")
        metrics = page.get("metrics").decode()
        assert 'beamsplat_link_up{robot="robot1",node="uplink"} 1' in metrics
        assert 'beamsplat_link_up{robot="robot2",node="uplink"} 0' in metrics
        with pytest.raises(urllib.error.HTTPError, match="404"):
            page.get("robots/robot3/status")


def test_alerts_of_a_robot_reach_the_webhook_once_each_and_survive_a_restart_of_the_page(start):
    with Receiver() as receiver, contextlib.ExitStack() as stack:
        page = start(webhook=receiver.address, hold_s=1.0, clear_s=1.0)
        robot = Robot("robot1", page.endpoint, stack)
        told = []

        def until(count, **report):
            def done():
                page.supervisor.poll()
                robot.report(**report)
                time.sleep(0.1)
                told[:] = [(e["robot"], e["alert"], e["state"]) for e in receiver.events]
                return len(told) >= count

            wait_until(done, 60)

        until(1, status="lost: no beam matches")
        assert told == [("robot1", "lost", "begin")]
        process = page.supervisor.children["page"].process
        process.kill()
        process.join()
        wait_until(
            lambda: page.supervisor.poll() or page.supervisor.children["page"].process is not process, 30
        )
        before = page.supervisor.children["page"].instance
        wait_until(
            lambda: page.supervisor.poll() or page.board.reported().get("page") == (before, "active"), 60
        )
        # What was published before it started is recovered: the map, and the pose of the odom frame.
        wait_until(lambda: robot.report() or page.robots().get("robot1", {}).get("map"), 30)
        until(2)
        with urllib.request.urlopen(f"{page.address}robots/robot1/events", timeout=10) as events:
            pose = next(json.loads(line[5:]) for line in events if b'"x_m"' in line and b"source" in line)
        assert pose["x_m"] == X_M["robot1"]
        assert told == [("robot1", "lost", "begin"), ("robot1", "lost", "end")]
        assert receiver.events[0]["id"] == receiver.events[1]["id"]
        # The robot falls silent: one alert about its link, none about its nodes.
        wait_until(lambda: page.supervisor.poll() or len(receiver.events) > 2, 60)
        assert [(e["alert"], e["state"]) for e in receiver.events[2:]] == [("link_down", "begin")]
        assert "SECRET" not in (page.supervisor.log_dir / "page.log").read_text()


def test_the_number_of_robots_is_bounded_and_a_silent_one_makes_room(monkeypatch):
    monkeypatch.setattr(fleet_module, "MAX_ROBOTS", 3)
    fleet = Fleet("edge", lambda: PageState(2.0, 2.0))
    first, second = fleet.state_of("r1"), fleet.state_of("r2")
    assert fleet.state_of("r3") is None
    assert fleet.ignored == 1
    assert fleet.state_of("r2") is second
    first.heard_s -= 61.0
    assert fleet.state_of("r3") is not None
    assert list(fleet.states()) == ["edge", "r2", "r3"]
    fleet.own_state.heard_s -= 1000.0
    assert fleet.state_of("r4") is None, "the own robot stays"
