"""A robot and its edge server, each with router and processes, over a link that breaks."""

import contextlib
import os
import shutil
import signal
import time

import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.topics import TOPICS
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.nodes import NODES
from beamsplat.services.uplink.node import UplinkConfig, UplinkNode
from beamsplat.tools.keys.pki import CertificateAuthority
from beamsplat.tools.system.assembly import faults, surroundings
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.topic_listener import TopicListener
from tests.conftest import free_port
from tests.services.mapping.room_drive import TABLE
from tests.services.uplink.link import CuttableLink

TABLE = {**TABLE, "uplink": NODES["uplink"]}


class Pair:
    """Deployments of robot and edge; the link between them goes through a relay that a test can cut."""

    def __init__(
        self, tmp_path, pictures, rate_bytes_s=None, edge_security=None, robot_security=None, scheme="tcp"
    ):
        ports = [free_port() for _ in range(3)]
        self.link = CuttableLink(ports[2], rate_bytes_s)
        listen = {"robot": (f"tcp/127.0.0.1:{ports[0]}",), "edge": (f"tcp/127.0.0.1:{ports[1]}",)}
        self.robot = Deployment(
            robot="r1", role="robot", router=RouterConfig(listen=listen["robot"]), state_dir=tmp_path / "robot",
            security=robot_security or {},
            nodes={
                "replay": {"kind": "room", "pictures": pictures}, "localization": {"kind": "known"},
                "fusion": {"kind": "true"},
                "keyframes": {"distance_m": 0.15, "durable": True, "retry_s": 1.0, "window": 2},
                "uplink": {"edge": f"{scheme}/127.0.0.1:{self.link.port}"},
            },
        )  # fmt: skip
        self.edge = Deployment(
            robot="r1", role="edge", state_dir=tmp_path / "edge", security=edge_security or {},
            router=RouterConfig(listen=(*listen["edge"], f"{scheme}/127.0.0.1:{ports[2]}")),
            nodes={"mapping": {"half_steps": 3, "full_steps": 2, "tick_steps": 1}},
        )  # fmt: skip


@contextlib.contextmanager
def running(pair):
    """Start edge, then robot; yield (supervisor, session, board) of robot and edge."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(pair.link)
        made = []
        for deployment in (pair.edge, pair.robot):
            supervisor = stack.enter_context(Supervisor(deployment, table=TABLE))
            session = stack.enter_context(open_session(deployment.router.listen))
            made.append((supervisor, session, HealthTable(session, "r1")))
        yield made[1], made[0]


def poll(supervisors, until, timeout_s):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        for supervisor in supervisors:
            supervisor.poll()
        if until():
            return
        time.sleep(0.05)
    raise AssertionError(f"not within {timeout_s} s")


def detail(board, node):
    return board.records[node].health.detail if node in board.records else ""


@pytest.mark.slow
def test_a_cut_link_loses_no_keyframe_and_does_not_affect_the_robot(tmp_path):
    pair = Pair(tmp_path, pictures=80)
    with running(pair) as ((robot, near, near_board), (edge, far, far_board)):
        both = (robot, edge)
        sent, poses = TopicListener(near, "keyframes/frame"), TopicListener(near, "localization/odometry")
        far_poses, anchors = (
            TopicListener(far, "localization/odometry"),
            TopicListener(far, "localization/anchors"),
        )
        mapped, refined = TopicListener(far, "keyframes/ack"), TopicListener(far, "mapping/poses")
        poll(both, lambda: len(mapped.messages) >= 2, 90)
        pair.link.cut = True
        poses_before, sent_before = len(poses.messages), len(set(sent.ids()))
        assert near_board.records["uplink"].figure("link_up") == 1.0
        poll(both, lambda: "no link" in detail(near_board, "uplink"), 10)
        assert near_board.records["uplink"].figure("link_up") == 0.0
        poll(both, lambda: len(set(sent.ids())) >= sent_before + 8, 30)
        assert len(poses.messages) >= poses_before + 12  # the robot drives on
        assert near_board.states()["uplink"] == "active"
        os.kill(robot.children["keyframes"].process.pid, signal.SIGKILL)  # the queue is on disk
        poll(both, lambda: robot.children["keyframes"].restarts == 1, 10)
        pair.link.cut = False
        poll(both, lambda: "connected" in detail(near_board, "uplink"), 10)
        poll(both, lambda: near_board.states().get("keyframes") == "drained", 120)
        poll(both, lambda: far_board.states().get("mapping") == "drained", 60)
        assert set(sent.ids()) == set(mapped.ids())
        (last,) = refined.messages
        good = {m.id for m in mapped.messages if m.status == "ok"}  # of the others the picture shows nothing
        assert len(good) >= 20
        assert set(last.keyframe_ids.tolist()) == good
        stamps = poses.stamps()
        assert stamps == sorted(set(stamps))
        assert set(far_poses.stamps()) >= set(stamps[5:])  # recovered from the uplink's cache
        assert anchors.messages[-1].optimisation == 6
        health = {i.topic: i for i in far_board.records["mapping"].health.inputs}
        assert health["keyframes/frame"].lost == health["keyframes/frame"].undecodable == 0
        poll(both, lambda: near_board.states().get("uplink") == "drained", 10)
        assert "localization" in far_board.records  # health crosses
    assert not list((pair.robot.run_dir / "keyframes").iterdir())


@pytest.mark.slow
def test_the_robot_starts_without_an_edge_and_a_killed_edge_continues_its_session(tmp_path):
    pair = Pair(tmp_path, pictures=60)
    pair.edge.nodes["mapping"] |= {"session": str(tmp_path / "session"), "session_every_s": 1.0}
    pair.link.cut = True
    with (
        pair.link,
        Supervisor(pair.robot, table=TABLE) as robot,
        open_session(pair.robot.router.listen) as near,
    ):
        board = HealthTable(near, "r1")
        sent, answered = TopicListener(near, "keyframes/frame"), TopicListener(near, "keyframes/ack")
        poll((robot,), lambda: len(set(sent.ids())) >= 4, 60)
        assert "no link" in detail(board, "uplink")
        pair.link.cut = False
        with Supervisor(pair.edge, table=TABLE) as edge:
            poll((robot, edge), lambda: len(set(answered.ids())) >= 4, 60)
            before = set(answered.ids())
            for name in ("mapping", "router"):
                os.kill(edge.children[name].process.pid, signal.SIGKILL)
            poll((robot, edge), lambda: edge.children["mapping"].restarts == 1, 10)
            poll((robot, edge), lambda: edge.children["router"].restarts == 1, 10)
            with open_session(pair.edge.router.listen) as far:
                refined = TopicListener(far, "mapping/poses")
                poll((robot, edge), lambda: board.states().get("keyframes") == "drained", 120)
                assert set(answered.ids()) == set(sent.ids())
                poll((robot, edge), lambda: refined.messages, 60)
                mapped = set(refined.messages[-1].keyframe_ids.tolist())
            good = {m.id for m in answered.messages if m.status == "ok"}
            assert before & good <= mapped  # what was acknowledged before the kill
            assert mapped == good
            assert robot.children["localization"].restarts == robot.children["keyframes"].restarts == 0


@pytest.mark.slow
def test_a_tls_link_works_until_the_robot_is_removed_from_the_policy(tmp_path):
    authority = CertificateAuthority.create(tmp_path / "authority")
    keys = {"edge": authority.issue("edge", HostRole(role="edge"), ("127.0.0.1",))}
    robot = HostRole(role="robot", robot="r1")
    keys["robot"] = shutil.copytree(authority.issue("r1", robot), tmp_path / "keys")
    secured = {f"{side}_security": SecurityConfig(keys=folder) for side, folder in keys.items()}
    pair = Pair(tmp_path, pictures=120, scheme="tls", **secured)
    with running(pair) as ((robot_side, _near, _near_board), (edge, far, far_board)):
        both = (robot_side, edge)
        mapped, poses = TopicListener(far, "keyframes/ack"), TopicListener(far, "localization/odometry")
        poll(both, lambda: len(mapped.messages) >= 3 and poses.messages, 90)
        assert "localization" in far_board.records
        authority.remove("r1")
        time.sleep(2.0)  # the router takes the new policy up
        mapped_before, poses_before = len(mapped.messages), len(poses.messages)
        time.sleep(3.0)
        assert (len(mapped.messages), len(poses.messages)) == (mapped_before, poses_before)
        assert far_board.states()["mapping"] == "active"  # this host's own processes are not concerned
        authority.issue("r1", robot)  # back in the policy: the certificate it has is still good
        poll(both, lambda: len(mapped.messages) >= mapped_before + 5, 30)
        assert robot_side.children["uplink"].restarts == edge.children["router"].restarts == 0


def test_only_topics_marked_in_the_table_cross(tmp_path):
    """Raw images, scans and depth stay on the robot, even if the edge subscribes to everything."""
    pair = Pair(tmp_path, pictures=12)
    with running(pair) as ((robot, near, near_board), (edge, far, _)):
        everything = set()
        far.declare_subscriber("beamsplat/**", lambda s: everything.add(str(s.key_expr).split("/", 2)[2]))
        local = TopicListener(near, "camera/image")
        poll((robot, edge), lambda: near_board.states().get("uplink") == "drained", 90)
        assert len(local.messages) >= 10
    topics = {name for name in everything if name in TOPICS}
    assert "keyframes/frame" in topics
    assert {"localization/odometry", "keyframes/ack", "mapping/status"} <= topics
    assert all(TOPICS[name].uplink or name.startswith("mapping/") for name in topics)


def test_the_check_knows_topics_from_the_other_side(tmp_path):
    pair = Pair(tmp_path, pictures=1)
    assert faults(pair.robot, TABLE) == faults(pair.edge, TABLE) == []
    classes = {name: TABLE[name].load("default") for name in ("mapping", "keyframes")}
    assert (
        "keyframes/frame"
        not in surroundings({"mapping": classes["mapping"]}, "mapping", "edge").without_producer
    )
    assert (
        "keyframes/frame"
        in surroundings({"mapping": classes["mapping"]}, "mapping", "whole").without_producer
    )
    assert (
        "keyframes/ack"
        not in surroundings({"keyframes": classes["keyframes"]}, "keyframes", "robot").without_producer
    )
    lonely = pair.robot.model_copy(update={"nodes": {"localization": {"kind": "known"}}})
    assert any("without node uplink" in f.text for f in faults(lonely, TABLE))
    both = pair.edge.model_copy(update={"nodes": {"localization": {"kind": "known"}}})
    assert any("published by localization and the uplink" in f.text for f in faults(both, TABLE))


def test_the_uplink_needs_a_bus():
    with pytest.raises(UserError, match="live only"):
        Lockstep([UplinkNode(UplinkConfig(edge="tcp/127.0.0.1:1"))]).run()
