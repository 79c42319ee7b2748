"""Five robots on one edge server, every process real: none hears of another, and what each costs there.

What was measured is printed: `pytest -s`.
"""

import contextlib
import shutil
import time

import psutil
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.messages.header import Header
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.keys.pki import CertificateAuthority
from beamsplat.tools.system.health_table import ALL, HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.conftest import free_port
from tests.services.uplink.test_uplink import TABLE, poll

ROBOTS = 5
NAMES = [f"r{i + 1}" for i in range(ROBOTS)]


def cost(process):
    """(CPU seconds so far, resident MB) of a process."""
    times = process.cpu_times()
    return times.user + times.system, process.memory_info().rss / 1e6


def robot_side(name, tmp_path, keys, door, pictures):
    return Deployment(
        robot=name, role="robot", router=RouterConfig(listen=(f"tcp/127.0.0.1:{free_port()}",)),
        state_dir=tmp_path / name, security=SecurityConfig(keys=keys),
        nodes={
            "replay": {"kind": "room", "pictures": pictures}, "localization": {"kind": "known"},
            "fusion": {"kind": "true"}, "keyframes": {"distance_m": 0.15, "durable": True, "retry_s": 2.0},
            "uplink": {"edge": door},
        },
    )  # fmt: skip


@pytest.mark.slow
def test_five_robots_on_one_edge_hear_nothing_of_each_other(tmp_path):
    authority = CertificateAuthority.create(tmp_path / "authority")
    edge_keys = authority.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    inner, door = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    keys = {
        name: shutil.copytree(
            authority.issue(name, HostRole(role="robot", robot=name)), tmp_path / f"keys-{name}"
        )
        for name in NAMES
    }
    mapping = {"half_steps": 3, "full_steps": 2, "tick_steps": 1}
    edge = [
        Deployment(
            robot=name, role="edge", router=RouterConfig(listen=(inner, door)), nodes={"mapping": mapping},
            state_dir=tmp_path / f"edge-{name}", security=SecurityConfig(keys=edge_keys),
        )
        for name in NAMES
    ]  # fmt: skip
    with contextlib.ExitStack() as stack:
        mappers = [
            stack.enter_context(Supervisor(d, None if d is edge[0] else ("mapping",), table=TABLE))
            for d in edge
        ]
        session = stack.enter_context(open_session((inner,)))
        board = HealthTable(session, ALL)
        voices = {name: set() for name in NAMES}  # whose keyframes were heard under a robot's name

        def hear(sample):
            voices[str(sample.key_expr).split("/")[1]].add(
                Header.unpack(sample.attachment.to_bytes()).instance
            )

        ear = session.declare_subscriber("beamsplat/*/keyframes/frame", hear)
        router = psutil.Process(mappers[0].children["router"].process.pid)
        workers = [psutil.Process(m.children["mapping"].process.pid) for m in mappers]
        idle = cost(router)
        poll(mappers, lambda: all(f"{n}/mapping" in board.records for n in NAMES), 120)
        before, started = [cost(p) for p in (router, *workers)], time.monotonic()
        robots = [
            stack.enter_context(
                Supervisor(robot_side(n, tmp_path, keys[n], door, 48 + 8 * i), table=TABLE)
            )
            for i, n in enumerate(NAMES)
        ]  # fmt: skip
        poll(
            mappers + robots, lambda: all(board.states().get(f"{n}/mapping") == "drained" for n in NAMES), 400
        )
        poll(mappers + robots, lambda: all("0 not ack" in board.records[f"{n}/keyframes"].health.detail
                                           for n in NAMES), 30)  # fmt: skip
        seconds, after = time.monotonic() - started, [cost(p) for p in (router, *workers)]
        made = [int(board.records[f"{n}/keyframes"].health.detail.split()[0]) for n in NAMES]
        taken = [int(board.records[f"{n}/mapping"].health.detail.split()[0]) for n in NAMES]
        used = [(b[0] - a[0], b[1]) for a, b in zip(before, after)]
        print(
            f"\n{ROBOTS} robots in {seconds:.0f} s, keyframes {taken}. Edge's router: {used[0][0]:.1f} s CPU, "
            f"{idle[1]:.0f} -> {used[0][1]:.0f} MB in all; mapper of each robot: "
            + ", ".join(
                f"{cpu / n * 1e3:.0f} ms CPU a keyframe, {mb:.0f} MB" for (cpu, mb), n in zip(used[1:], taken)
            )
        )
        assert taken == made
        assert len(set(made)) == ROBOTS, "they drive different ways, so that a mix-up shows"
        assert voices == {n: {r.children["keyframes"].instance} for n, r in zip(NAMES, robots)}
        assert {r.split("/")[0] for r in board.records} == set(NAMES)
        ear.undeclare()
