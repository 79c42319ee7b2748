"""The kinds of faults: each plans one fault at random, which the campaign starts and ends."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import zenoh

from beamsplat.common.messages.instances import control_id
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.zenoh.bus import key
from beamsplat.services.nodes import NODES
from beamsplat.tools.bench.faults.faulty_replay import SENSOR_FAULTS
from beamsplat.tools.bench.faults.hostile import (
    VERBS,
    HalfOpenConnections,
    HeardMessages,
    hostile_queries,
    send_garbage,
)
from beamsplat.tools.bench.faults.hosts import ROBOT_NAME, ROUTER, CampaignHost, CampaignHosts, Role
from beamsplat.tools.bench.faults.injection import DISK_MODES
from beamsplat.tools.bench.faults.link import LinkState
from beamsplat.tools.bench.faults.watch import HostWatch
from beamsplat.tools.system.assembly import node_classes

Target = tuple[Role, str]  # host and process
HOUR_S = 3600.0
FROZEN_S = 10.0
_READ_ONLY = ("snapshot", "render", "state")


@dataclass
class InjectedFault:
    """One fault: `start` injects it, `end` takes it back; both may add to `result`."""

    kind: str
    text: str
    duration_s: float
    start: Callable[[], None]
    end: Callable[[], None] = lambda: None
    stopped: frozenset[Target] = frozenset()  # processes that the fault itself kills, stops or restarts
    sensors: bool = False  # the sensors deliver nothing usable meanwhile
    disk: bool = False  # saved files are read after it
    part: str = ""  # what fails; only one fault at a time can be in it
    result: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Surfaces:
    """What faults act on."""

    hosts: CampaignHosts
    watches: dict[Role, HostWatch]
    heard: dict[Role, HeardMessages]
    queries: dict[Role, list[tuple[str, str]]]  # (node, query)

    @staticmethod
    def of(hosts: CampaignHosts, watches: dict[Role, HostWatch]) -> Surfaces:
        """Collect the surfaces of running hosts."""
        queries = {
            host.role: [
                (name, query)
                for name, node in node_classes(host.deployment, NODES).items()
                for query in (*node.queries(), *VERBS, *_READ_ONLY)
            ]
            for host in hosts.all
        }
        heard = {role: HeardMessages(watch.session) for role, watch in watches.items()}
        return Surfaces(hosts, watches, heard, queries)


def _host(surfaces: Surfaces, rng: random.Random) -> CampaignHost:
    return rng.choice(surfaces.hosts.all)


def _process(surfaces: Surfaces, rng: random.Random) -> tuple[CampaignHost, str, int]:
    """Return a random running process: (host, name, process id)."""
    running = [(host, name, pid) for host in surfaces.hosts.all for name, pid in sorted(host.pids().items())]
    return rng.choice(running)


def _signal(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def _in_thread(work: Callable[[], str], fault: InjectedFault) -> None:
    def run() -> None:
        try:
            fault.result.append(work())
        except zenoh.ZError as error:  # the router was killed meanwhile
            fault.result.append(f"interrupted: {error}")

    threading.Thread(target=run, name=fault.kind, daemon=True).start()


def kill(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """SIGKILL of one process."""
    host, name, pid = _process(surfaces, rng)
    return InjectedFault(
        "kill", f"SIGKILL of {host.role}'s {name}", 0.0, lambda: _signal(pid, signal.SIGKILL),
        stopped=frozenset({(host.role, name)}),
    )  # fmt: skip


def freeze(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """SIGSTOP of one process, SIGCONT after 10 s."""
    host, name, pid = _process(surfaces, rng)
    return InjectedFault(
        "freeze", f"SIGSTOP of {host.role}'s {name}", FROZEN_S, lambda: _signal(pid, signal.SIGSTOP),
        lambda: _signal(pid, signal.SIGCONT), stopped=frozenset({(host.role, name)}),
    )  # fmt: skip


def router_restart(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """SIGTERM of a router, which its supervisor starts again."""
    host = _host(surfaces, rng)
    pid = host.pids().get(ROUTER, 0)
    return InjectedFault(
        "router restart", f"SIGTERM of {host.role}'s router", 0.0,
        lambda: _signal(pid, signal.SIGTERM) if pid else None, stopped=frozenset({(host.role, ROUTER)}),
    )  # fmt: skip


def restart_query(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """The operator's query to restart a node, or the request that makes its process retire."""
    host = _host(surfaces, rng)
    node = rng.choice(list(host.deployment.nodes))
    instance = surfaces.watches[host.role].instances().get(node)
    retire = instance is not None and rng.random() < 0.3
    selector = (
        key(ROBOT_NAME, CONTROL, node, control_id(str(instance)), "retire") if retire
        else key(ROBOT_NAME, "query", node, "restart")
    )  # fmt: skip
    fault = InjectedFault(
        "restart by query", f"{'retire' if retire else 'restart'} of {host.role}'s {node}", 0.0,
        lambda: None, stopped=frozenset({(host.role, node)}),
    )  # fmt: skip
    session = surfaces.watches[host.role].session
    fault.start = lambda: _in_thread(
        lambda: f"{len(list(session.get(selector, timeout=10.0)))} answers", fault
    )
    return fault


def disk(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """A disk that is full, read-only, slow, or whose fsync fails."""
    host, mode = _host(surfaces, rng), rng.choice(DISK_MODES)
    return InjectedFault(
        f"disk {mode}", f"{host.role}'s disk: {mode}", rng.uniform(6.0, 15.0),
        lambda: host.set_faults(disk=mode), lambda: host.set_faults(disk=""), disk=True,
        part=f"{host.role} disk",
    )  # fmt: skip


def clock(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """A step of the wall clock by one hour, and back."""
    host, step_s = _host(surfaces, rng), rng.choice((-HOUR_S, HOUR_S))
    return InjectedFault(
        "clock step", f"{host.role}'s clock {step_s / HOUR_S:+.0f} h", rng.uniform(5.0, 20.0),
        lambda: host.set_faults(clock_s=step_s), lambda: host.set_faults(clock_s=0.0),
        part=f"{host.role} clock",
    )  # fmt: skip


def sensors(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """Sensors that deliver NaN, noise, nothing, or impossible stamps."""
    host, mode = surfaces.hosts.robot, rng.choice(sorted(SENSOR_FAULTS))
    return InjectedFault(
        f"sensors {mode}", f"sensors: {mode}", rng.uniform(1.0, 6.0), lambda: host.set_faults(sensors=mode),
        lambda: host.set_faults(sensors=""), sensors=True, part="sensors",
    )  # fmt: skip


def garbage_on_topics(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """Garbage on every key of a router, from a client that may write all of them."""
    host, seconds = _host(surfaces, rng), rng.uniform(2.0, 6.0)
    fault = InjectedFault("garbage", f"garbage on every topic of {host.role}'s router", seconds, lambda: None)
    session, heard, own = (
        surfaces.watches[host.role].session,
        surfaces.heard[host.role],
        random.Random(rng.random()),
    )
    fault.start = lambda: _in_thread(lambda: f"{send_garbage(session, heard, own, seconds)} messages", fault)
    return fault


def hostile_queries_to_nodes(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """Queries and hand-over requests to every node, with parameters of any kind."""
    host, seconds = _host(surfaces, rng), rng.uniform(4.0, 8.0)
    fault = InjectedFault(
        "hostile queries", f"hostile queries on {host.role}'s router", seconds, lambda: None
    )
    watch, own = surfaces.watches[host.role], random.Random(rng.random())

    def work() -> str:
        sent, unanswered = hostile_queries(
            watch.session, surfaces.queries[host.role], watch.instances(), own, seconds
        )
        return f"{sent} queries, {unanswered} without an answer"

    fault.start = lambda: _in_thread(work, fault)
    return fault


def half_open(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """1000 connections that send nothing or a part of a request."""
    hosts = surfaces.hosts
    ports = {
        "the page": hosts.robot.deployment.nodes["page"]["port"],
        "the robot's router": _port(hosts.robot.deployment.router.listen[0]),
        "the edge's router (TLS)": hosts.tls_port,
    }
    name = rng.choice(sorted(ports))
    fault = InjectedFault(
        "half-open connections", f"1000 half-open connections to {name}", 12.0, lambda: None
    )
    opened: list[HalfOpenConnections] = []
    fault.start = lambda: opened.append(HalfOpenConnections(int(ports[name])))
    fault.end = lambda: fault.result.append(f"{sum(one.close() for one in opened)} were open")
    return fault


def link_cut(surfaces: Surfaces, rng: random.Random) -> InjectedFault:
    """The link between robot and edge is cut, or nothing passes."""
    link = surfaces.hosts.link
    state: LinkState = "cut" if rng.random() < 0.5 else "stalled"
    return InjectedFault(
        f"link {state}", f"link {state}", rng.uniform(4.0, 20.0), lambda: link.set(state),
        lambda: link.set("up"), part="link",
    )  # fmt: skip


def _port(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


# Kinds and how often each comes in one round of the deck.
DECK: tuple[tuple[Callable[[Surfaces, random.Random], InjectedFault], int], ...] = (
    (kill, 6), (freeze, 3), (router_restart, 1), (restart_query, 2), (disk, 5), (clock, 2), (sensors, 3),
    (garbage_on_topics, 2), (hostile_queries_to_nodes, 2), (half_open, 2), (link_cut, 2),
)  # fmt: skip


def deck(rng: random.Random) -> list[Callable[[Surfaces, random.Random], InjectedFault]]:
    """Return all kinds of faults, each as often as in `DECK`, in random order."""
    kinds = [kind for kind, count in DECK for _ in range(count)]
    rng.shuffle(kinds)
    return kinds
