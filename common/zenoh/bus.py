"""Zenoh sessions, key expressions, and the publications, subscriptions and queries of one node.

All keys of a robot start with `beamsplat/<robot>/`:

    <topic>                       messages; header in the attachment, schema in the encoding
    health/<node>                 health report, once a second
    health/bundle                 health reports of the nodes on the other side of the uplink
    end/<topic>                   end-of-stream marker of the producer (latched)
    alive/<node>/<instance>       liveliness token of an active node
    failed/<node>/<instance>      liveliness token of a node that cannot run, declared by its supervisor
    query/<node>/<name>           queries to a node
    operator/<node>/<verb>        commands of the operator, from the host of the node only
    control/<node>/<id>/<verb>    hand-over requests to one process (common/runtime/handover.py)

All sessions are clients of a router on this host: two Zenoh peers that are connected only through a router
do not exchange data, and access control acts between client and router. Samples are read from channels in
threads of this module, because Zenoh's Python callbacks prevent a process from ending.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import msgpack
import zenoh
import zenoh.ext

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health
from beamsplat.common.messages.header import DecodeError, Header, local_clock_id
from beamsplat.common.messages.instances import control_id
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.node import Input
from beamsplat.common.security.access_control import access_control, read_hosts
from beamsplat.common.security.keys import NO_SECURITY, HostKeys, SecurityConfig, check_endpoint, is_secure
from beamsplat.common.security.logins import Login, require_logins
from beamsplat.common.topics import HEALTH, LIMIT_KB, Topic, topic
from beamsplat.common.zenoh.health_samples import decode_health
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.streams import (
    Producer,
    Publication,
    Subscription,
    decode_end_marker,
    decode_header,
    decode_sample,
)

T = TypeVar("T")

ROOT = "beamsplat"
# Kernel send buffers of a link. Small messages: 13 ms of delay at 20 Mbit/s. Large messages: at least rate x
# round trip time (20 Mbit/s x 100 ms), or the rate is not reached.
URGENT_BUFFER_BYTES = 32 * 1024
BULK_BUFFER_BYTES = 256 * 1024
HEADERS_BYTES = 64 * 1024  # of Zenoh and of our own, beside the payload of a message
# Zenoh's shared-memory pool of one process. All of it is resident, and receivers keep it mapped after its
# process has ended. A message for which the pool has no room crosses a TCP connection instead.
SHM_POOL_BYTES = 8 * 1024 * 1024  # six depth estimates of 640x480, which are 1.2 MB each
IMAGE_POOL_BYTES = 16 * 1024 * 1024  # of sources of images: two raw images of 1920x1080


def key(robot: str, *parts: str) -> str:
    """Return the key expression `beamsplat/<robot>/<parts...>`."""
    return "/".join((ROOT, robot, *parts))


def _base_config(mode: str, pool_bytes: int = SHM_POOL_BYTES) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5(
        "transport/link/tx/lease", "2000"
    )  # ms: the connection to a peer that hangs is closed after this time
    config.insert_json5(
        "connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"
    )
    config.insert_json5("transport/shared_memory/transport_optimization/pool_size", str(pool_bytes))
    return config


def _set_endpoints(config: zenoh.Config, side: str, endpoints: tuple[str, ...]) -> None:
    try:
        config.insert_json5(f"{side}/endpoints", json.dumps(list(endpoints)))
    except zenoh.ZError as error:
        raise UserError(
            f'router: {", ".join(endpoints)} is not a Zenoh endpoint; use the form "tcp/127.0.0.1:7447"'
        ) from error


def open_router(
    listen: tuple[str, ...], connect: tuple[str, ...] = (), security: SecurityConfig = NO_SECURITY
) -> zenoh.Session:
    """Open a Zenoh router in this process.

    Raises:
        UserError: an endpoint is in use or malformed, or it would be reachable from other hosts without TLS.
    """
    zenoh.init_log_from_env_or("error")
    config = router_config(listen, connect, security)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise UserError(
            f"router cannot listen on {', '.join(listen)} ({_short(error)}): is another router running? "
            "Stop it, or choose another port with --set router.listen='[\"tcp/127.0.0.1:7448\"]'"
        ) from error


def router_config(
    listen: tuple[str, ...], connect: tuple[str, ...] = (), security: SecurityConfig = NO_SECURITY
) -> zenoh.Config:
    """Return the configuration of a router.

    On endpoints for other hosts, hosts authenticate with certificates (mutual TLS); the topic table and
    hosts.toml define the keys that each host may read and write.

    Raises:
        UserError: an endpoint is malformed, or would be reachable from other hosts without TLS.
    """
    config = _base_config("router")
    _set_endpoints(config, "listen", listen)
    _set_endpoints(config, "connect", connect)
    for endpoint in (*listen, *connect):
        check_endpoint(endpoint, security)
    if any(is_secure(endpoint) for endpoint in (*listen, *connect)):
        keys = HostKeys.of(security)
        keys.identify(config)
        config.insert_json5("transport/link/rx/max_message_size", str(LIMIT_KB * 1000 + HEADERS_BYTES))
        config.insert_json5("access_control", json.dumps(access_control(read_hosts(keys.folder))))
    require_logins(config, security, (*listen, *connect))
    config.insert_json5("adminspace/enabled", "true")
    config.insert_json5("adminspace/permissions", "{read: true, write: false}")
    return config


def open_session(
    endpoints: tuple[str, ...], wait_s: float = 15.0, should_stop: Callable[[], bool] = lambda: False,
    login: Login | None = None, pool_bytes: int = SHM_POOL_BYTES,
) -> zenoh.Session:  # fmt: skip
    """Open a client session to the router at one of `endpoints`; retry for `wait_s` seconds.

    Args:
        should_stop: called after each failed attempt; a True result ends the attempts early.
        login: user name and password for a router that requires logins.
        pool_bytes: size of the shared memory of the session.

    Raises:
        UserError: an endpoint is malformed, or no router answered before the time-out or before
            `should_stop()` was True.
    """
    zenoh.init_log_from_env_or("error")
    config = _base_config("client", pool_bytes)
    _set_endpoints(config, "connect", endpoints)
    if login is not None:
        login.identify(config)
    config.insert_json5("connect/timeout_ms", "1000")
    config.insert_json5("connect/exit_on_failure", "true")
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if should_stop() or time.monotonic() > deadline:
                raise UserError(
                    f"no router answers at {', '.join(endpoints)} ({_short(error)}). Start the system "
                    "with `beamsplat run FILE`, or a router alone with `beamsplat run FILE router`"
                ) from error
            time.sleep(0.1)


def open_link(
    endpoint: str, wait_s: float, security: SecurityConfig, buffer_bytes: int = URGENT_BUFFER_BYTES
) -> zenoh.Session:
    """Open a client session to a router on another host, over a connection that can be slow and can break.

    `buffer_bytes` limits the kernel's send buffer, and with it the delay of a message behind queued data.

    Raises:
        UserError: a malformed endpoint, missing keys, or no router answered within `wait_s`.
    """
    zenoh.init_log_from_env_or("error")
    check_endpoint(endpoint, security)
    config = _base_config("client")
    config.insert_json5("transport/shared_memory/enabled", "false")
    _set_endpoints(config, "connect", (endpoint,))
    if is_secure(endpoint):
        HostKeys.of(security).identify(config)
    for protocol in ("tcp", "tls"):
        config.insert_json5(f"transport/link/{protocol}/so_sndbuf", str(buffer_bytes))
    config.insert_json5("connect/timeout_ms", str(round(wait_s * 1e3)))
    config.insert_json5("connect/exit_on_failure", "true")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise UserError(f"no router answers at {endpoint} ({_short(error)})") from error


def _short(error: zenoh.ZError) -> str:
    """Return Zenoh's error text without source locations."""
    return str(error).split(" at ")[0][:120]


def _verb_of(query: zenoh.Query) -> str:
    return str(query.key_expr).rpartition("/")[2]


class Bus:
    """Publications, subscriptions and queries of one node; as a context manager, closes the session at exit.

    `instance` identifies the process (16 hex digits); `epoch` increases with each process of the node.
    """

    def __init__(self, session: zenoh.Session, robot: str, node: str, instance: str, epoch: int) -> None:
        self.session = session
        self.robot = robot
        self.producer = Producer(node, instance, epoch, local_clock_id())
        self._declared: list[object] = []  # Zenoh undeclares a handle that is garbage-collected
        self._health = Publication(
            session, self.producer, Topic(HEALTH, Health, (node,), 1, "latest"), key(robot, HEALTH, node)
        )

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *exception: object) -> None:
        self.session.close()

    def publish(self, topic_name: str) -> Publication:
        """Declare a publication of the topic `topic_name` and return it."""
        return Publication(self.session, self.producer, topic(topic_name), key(self.robot, topic_name))

    def subscribe(
        self,
        entry: Input,
        on_envelope: Callable[[Envelope], None],
        on_undecodable: Callable[[str, str], None],
        on_end: Callable[[str, Header, int], None],
    ) -> None:
        """Declare a subscription to the input `entry`; the callbacks are called from threads of the bus.

        Args:
            on_envelope: called with each decoded message.
            on_undecodable: called with (topic, reason) for each message that could not be decoded.
            on_end: called with (topic, header, sent) when a producer has published its end-of-stream
                marker; `sent` is the number of messages that it has published.
        """
        self._subscribe(entry, lambda sample: decode_sample(sample, entry.row), on_envelope, on_undecodable)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self.session,
            key(self.robot, "end", entry.topic),
            zenoh.handlers.FifoChannel(16),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        self._declared.append(subscriber)

        def handle(sample: zenoh.Sample) -> None:
            try:
                header, sent = decode_end_marker(sample)
            except DecodeError as error:
                on_undecodable(entry.topic, f"end marker: {error}")
            else:
                on_end(entry.topic, header, sent)

        receive_in_thread(self.session, f"end-{entry.topic}", subscriber, handle)

    def subscribe_headers(
        self,
        entry: Input,
        on_header: Callable[[Header], None],
        on_undecodable: Callable[[str, str], None],
    ) -> None:
        """Declare a subscription that reads the headers of the messages only; arguments as of `subscribe`."""
        self._subscribe(entry, lambda sample: decode_header(sample, entry.row), on_header, on_undecodable)

    def _subscribe(
        self,
        entry: Input,
        decode: Callable[[zenoh.Sample], T],
        on_decoded: Callable[[T], None],
        on_undecodable: Callable[[str, str], None],
    ) -> None:
        key_expr, delivery = key(self.robot, entry.topic), entry.effective_delivery
        subscription = Subscription(
            self.session, entry.row, delivery, key_expr, decode, on_decoded, on_undecodable
        )
        self._declared.append(subscription)

    def end(self, publication: Publication) -> None:
        """Publish the end-of-stream marker of `publication`, with the number of messages published on it."""
        publisher = zenoh.ext.declare_advanced_publisher(
            self.session,
            key(self.robot, "end", publication.row.name),
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )
        p = self.producer
        header = Header(0, time.monotonic_ns(), p.clock_id, publication.sent, p.epoch, p.node, p.instance)
        publisher.put(msgpack.packb(publication.sent), attachment=header.pack())
        self._declared.append(publisher)

    def answer_queries(self, on_query: Callable[[str, zenoh.Query], None]) -> None:
        """Declare the keys control/<node>/<id>/*, for requests to this process; its instance determines id.

        `announce` later declares the queries to the node. For both, `on_query(name, query)` is called from a
        thread of the bus; `name` is "control/<verb>" for a request, else the name of the query.
        """
        self._on_query = on_query
        p = self.producer
        key_expr = key(self.robot, CONTROL, p.node, control_id(p.instance), "*")
        self._answer(key_expr, lambda query: on_query(f"{CONTROL}/{_verb_of(query)}", query))

    def announce(self, queries: tuple[str, ...]) -> None:
        """Announce this process as the active node: declare its queries (names) and its liveliness token."""
        for name in queries:
            key_expr = key(self.robot, "query", self.producer.node, name)
            self._answer(key_expr, partial(self._on_query, name))
        node, instance = self.producer.node, self.producer.instance
        self._declared.append(
            self.session.liveliness().declare_token(key(self.robot, "alive", node, instance))
        )

    def _answer(self, key_expr: str, on_query: Callable[[zenoh.Query], None]) -> None:
        queryable = self.session.declare_queryable(key_expr, zenoh.handlers.FifoChannel(16))
        self._declared.append(queryable)
        receive_in_thread(self.session, f"query-{key_expr}", queryable, on_query)

    def watch_health(
        self, on_health: Callable[[Health], None], on_undecodable: Callable[[str, str], None]
    ) -> None:
        """Call `on_health` with each health report of any node of this robot, from a thread of the bus.

        `on_undecodable` is called with ("health", reason) for each report that could not be decoded.
        """
        subscriber = self.session.declare_subscriber(
            key(self.robot, HEALTH, "*"), zenoh.handlers.FifoChannel(256)
        )
        self._declared.append(subscriber)

        def handle(sample: zenoh.Sample) -> None:
            try:
                reports = decode_health(sample)
            except DecodeError as error:
                on_undecodable(HEALTH, f"{sample.key_expr}: {error}")
                return
            for health in reports:
                on_health(health)

        receive_in_thread(self.session, "watch-health", subscriber, handle)

    def publish_health(self, health: Health) -> None:
        """Publish a health report of this node."""
        self._health.put(health)

    def wait_for_subscribers(self, topic_names: tuple[str, ...], timeout_s: float) -> None:
        """Block until this session knows a subscriber of each topic, at most for `timeout_s` seconds.

        A session drops messages that it publishes before the declaration of the first subscriber has
        arrived, although the subscribing node is already alive.
        """
        probes = [self.session.declare_publisher(key(self.robot, name)) for name in topic_names]
        deadline = time.monotonic() + timeout_s

        def all_matched() -> bool:  # the stubs declare the status as bool
            return all(p.matching_status.matching for p in probes)  # type: ignore[attr-defined]

        while time.monotonic() < deadline and not all_matched():
            time.sleep(0.01)
        for probe in probes:
            probe.undeclare()

    def alive_nodes(self) -> set[str]:
        """Return the names of the active nodes of this robot."""
        return self._nodes_with_token("alive")

    def failed_nodes(self) -> set[str]:
        """Return the names of the nodes of this robot that cannot run, as their supervisors declare."""
        return self._nodes_with_token("failed")

    def _nodes_with_token(self, kind: str) -> set[str]:
        replies = self.session.liveliness().get(key(self.robot, kind, "*", "*"), timeout=2.0)
        return {str(r.ok.key_expr).split("/")[3] for r in replies if r.ok is not None}
