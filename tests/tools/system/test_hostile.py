"""An edge server under attack by somebody who holds a robot's valid certificate, and recordings of what was
said. What was measured is printed: `pytest -s`.
"""

import contextlib
import shutil
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.streams import decode_sample
from beamsplat.services.nodes import NODES
from beamsplat.tools.keys.pki import CertificateAuthority
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.conftest import free_port
from tests.services.uplink.test_uplink import poll


class Latency:
    """Of localization on the robot: from a scan's publication to that of its pose, in ms (one clock)."""

    def __init__(self, session):
        self._scans, self.rows = {}, []
        session.declare_subscriber("beamsplat/r1/lidar/scan", self._take_scan)
        session.declare_subscriber("beamsplat/r1/localization/odometry", self._take_pose)

    def _take_scan(self, sample):
        header = decode_sample(sample, topic("lidar/scan")).header
        self._scans[header.stamp_ns] = header.publish_ns

    def _take_pose(self, sample):
        header = decode_sample(sample, topic("localization/odometry")).header
        if header.stamp_ns in self._scans:
            self.rows.append((header.publish_ns, (header.publish_ns - self._scans[header.stamp_ns]) / 1e6))

    def caught_up(self):
        """Whether what the start of the processes held up is worked off."""
        return len(self.rows) > 50 and max(ms for _, ms in self.rows[-20:]) < 300.0

    def watch(self, supervisors, seconds):
        """(rate in Hz, p50 and p99 in ms) of the next seconds."""
        start, ends = time.monotonic_ns(), time.monotonic() + seconds
        poll(supervisors, lambda: time.monotonic() > ends, seconds + 10)
        ms = [ms for published, ms in self.rows if published >= start]
        return len(ms) / seconds, *np.percentile(ms, [50, 99])


@pytest.fixture
def attacked(tmp_path, shared_dir):
    """Robot and edge behind mutual TLS; the robot localizes a recorded drive, round and round."""
    authority = CertificateAuthority.create(tmp_path / "authority")
    edge_keys = authority.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    robot_keys = shutil.copytree(authority.issue("r1", HostRole(role="robot", robot="r1")), tmp_path / "keys")
    near, inner, far = (free_port() for _ in range(3))
    door = f"tls/127.0.0.1:{far}"
    robot = Deployment(
        robot="r1", role="robot", router=RouterConfig(listen=(f"tcp/127.0.0.1:{near}",)),
        state_dir=tmp_path / "robot", security=SecurityConfig(keys=robot_keys),
        nodes={
            "replay": {"data": str(shared_dir / "data" / "house_a" / "bag"), "loop": True,
                       "without": ["image"]},
            "localization": {"kind": "lidar"}, "uplink": {"edge": door},
        },
    )  # fmt: skip
    edge = Deployment(
        robot="r1", role="edge", router=RouterConfig(listen=(f"tcp/127.0.0.1:{inner}", door)),
        state_dir=tmp_path / "edge", security=SecurityConfig(keys=edge_keys), nodes={"mapping": {}},
    )  # fmt: skip
    with contextlib.ExitStack() as stack:
        made = [stack.enter_context(Supervisor(d, table=NODES)) for d in (edge, robot)]
        near_session = stack.enter_context(open_session(robot.router.listen))
        edge_session = stack.enter_context(open_session(edge.router.listen[:1]))
        board = HealthTable(edge_session, "r1")
        latency = Latency(near_session)
        poll(
            made,
            lambda: len(latency.rows) > 50 and {"mapping", "localization", "uplink"} <= set(board.records),
            90,
        )
        yield made, board, latency, door, robot_keys, edge_session


def attack(door, keys, *arguments):
    command = [sys.executable, "-m", "tests.tools.system.hostile", door, str(keys), *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def bad(board, node):
    return sum(i.undecodable + i.stale for i in board.records[node].health.inputs)


@pytest.mark.slow
@pytest.mark.parametrize("with_header", [False, True], ids=["nonsense", "with a header that was heard"])
def test_a_flood_of_garbage_by_a_robots_own_certificate_is_counted_and_contained(attacked, with_header):
    supervisors, board, latency, door, keys, edge_session = attacked
    heard = []
    ear = edge_session.declare_subscriber(
        "beamsplat/r1/localization/odometry", lambda s: heard.append(s.attachment.to_bytes())
    )
    with contextlib.suppress(AssertionError):  # on a busy machine it never is: then the figures say so
        poll(supervisors, latency.caught_up, 45)
    before = latency.watch(supervisors, 12)
    ear.undeclare()
    header = ["--header", heard[0].hex()] if with_header else []
    hostile = attack(door, keys, "--rate", 10_000, "--seconds", 18, *header)
    time.sleep(2.0)
    used = [psutil.Process(c.process.pid) for s in supervisors for c in s.children.values()]
    [p.cpu_percent() for p in used]
    during = latency.watch(supervisors, 13)
    cpu = {p: round(q.cpu_percent()) for q, p in zip(used, [f"{s.deployment.role}:{n}" for s in supervisors
                                                          for n in s.children])}  # fmt: skip
    sent = int(hostile.communicate(timeout=60)[0])
    after = latency.watch(supervisors, 5)
    print(f"\n{sent} messages of garbage in 18 s; localization, Hz and ms (p50, p99): before "
          f"{np.round(before, 1)}, during {np.round(during, 1)}, after {np.round(after, 1)}; the mapper "
          f"counted {bad(board, 'mapping')} bad; CPU % {cpu}; RSS MB at the end "
          f"{[p.memory_info().rss // 1_000_000 for p in used]}")  # fmt: skip
    assert bad(board, "mapping") > 0.1 * sent / 4
    assert all(c.restarts == 0 for s in supervisors for c in s.children.values())
    assert board.states()["mapping"] == "active"
    counted = "health reports rejected" if with_header else "messages without a valid header not forwarded"
    assert counted in board.records["uplink"].health.detail
