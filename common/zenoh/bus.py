"""Zenoh, as BeamSplat uses it: sessions, keys, publications, subscriptions.

Everything a robot says lives under `beamsplat/<robot>/`:

    <topic>                       messages; header in the attachment, schema in the encoding
    health/<node>                 once a second
    end/<topic>                   the producer has nothing more to say (latched)
    alive/<node>/<instance>       liveliness token of an active node
    query/<node>/<name>           queryables
    control/<instance>/<verb>     what the supervisor asks of one process (common/takeover.py)

All sessions are clients of a router on this host: two peers that know only a router do not reach each
other, and access control acts between client and router. Channels with threads of our own take the
place of Python callbacks, which keep a process from ending.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from functools import partial

import msgpack
import zenoh
import zenoh.ext

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health
from beamsplat.common.messages.header import DecodeError, Header, local_clock_id
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.node import Input
from beamsplat.common.security.access_control import access_control, read_hosts
from beamsplat.common.security.keys import OPEN, Keys, SecurityConfig, check_endpoint, is_secure
from beamsplat.common.security.logins import Login, guard
from beamsplat.common.topics import HEALTH, LIMIT_KB, Topic, topic
from beamsplat.common.zenoh.streams import Producer, Publication, Subscription, decode_sample

ROOT = "beamsplat"
URGENT_BUFFER_BYTES = 32 * 1024  # 13 ms at 20 Mbit/s
BULK_BUFFER_BYTES = 256 * 1024  # at least rate x round trip, or the rate is not reached: 20 Mbit/s x 100 ms
SHM_POOL_BYTES = 64 * 1024 * 1024


def key(robot: str, *parts: str) -> str:
    """`beamsplat/<robot>/<parts...>`."""
    return "/".join((ROOT, robot, *parts))


def _base_config(mode: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("transport/link/tx/lease", "2000")  # a hung peer is noticed in 2 s
    config.insert_json5(
        "connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"
    )
    config.insert_json5("transport/shared_memory/transport_optimization/pool_size", str(SHM_POOL_BYTES))
    return config


def _set_endpoints(config: zenoh.Config, side: str, endpoints: tuple[str, ...]) -> None:
    try:
        config.insert_json5(f"{side}/endpoints", json.dumps(list(endpoints)))
    except zenoh.ZError as error:
        raise UserError(
            f'router: {", ".join(endpoints)} are no endpoints; they look like "tcp/127.0.0.1:7447"'
        ) from error


def open_router(
    listen: tuple[str, ...], connect: tuple[str, ...] = (), security: SecurityConfig = OPEN
) -> zenoh.Session:
    """A router in this process.

    Raises:
        UserError: an endpoint cannot be listened on (in use), is malformed, or leaves this host unprotected.
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
    listen: tuple[str, ...], connect: tuple[str, ...] = (), security: SecurityConfig = OPEN
) -> zenoh.Config:
    """What a router of ours runs with. Where it listens beyond this host, hosts show certificates, and may do
    what the topic table and hosts.toml say.

    Raises:
        UserError: an endpoint is malformed, or leaves this host unprotected.
    """
    config = _base_config("router")
    _set_endpoints(config, "listen", listen)
    _set_endpoints(config, "connect", connect)
    for endpoint in (*listen, *connect):
        check_endpoint(endpoint, security)
    if any(is_secure(endpoint) for endpoint in (*listen, *connect)):
        keys = Keys.of(security)
        keys.identify(config)
        config.insert_json5("transport/link/rx/max_message_size", str(LIMIT_KB * 1000))
        config.insert_json5("access_control", json.dumps(access_control(read_hosts(keys.folder))))
    guard(config, security, (*listen, *connect))
    config.insert_json5("adminspace/enabled", "true")
    config.insert_json5("adminspace/permissions", "{read: true, write: false}")
    return config


def open_session(
    endpoints: tuple[str, ...], wait_s: float = 15.0, gave_up: Callable[[], bool] = lambda: False,
    login: Login | None = None,
) -> zenoh.Session:  # fmt: skip
    """A client session of the router at one of `endpoints`, waiting `wait_s` for it to appear.

    Raises:
        UserError: a malformed endpoint; no router answered, until then or until the caller `gave_up`.
    """
    zenoh.init_log_from_env_or("error")
    config = _base_config("client")
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
            if gave_up() or time.monotonic() > deadline:
                raise UserError(
                    f"no router answers at {', '.join(endpoints)} ({_short(error)}). Start the system "
                    "with `beamsplat run FILE`, or a router alone with `beamsplat run FILE router`"
                ) from error
            time.sleep(0.1)


def open_link(
    endpoint: str, wait_s: float, security: SecurityConfig, buffer_bytes: int = URGENT_BUFFER_BYTES
) -> zenoh.Session:
    """A client session of a router on another host, over a link that may be slow and may break.

    What is written waits in the kernel's send buffer, `buffer_bytes` of it at most: behind the rest.

    Raises:
        UserError: a malformed endpoint, credentials that are missing, or no router answered within `wait_s`.
    """
    zenoh.init_log_from_env_or("error")
    check_endpoint(endpoint, security)
    config = _base_config("client")
    config.insert_json5("transport/shared_memory/enabled", "false")
    _set_endpoints(config, "connect", (endpoint,))
    if is_secure(endpoint):
        Keys.of(security).identify(config)
    for protocol in ("tcp", "tls"):
        config.insert_json5(f"transport/link/{protocol}/so_sndbuf", str(buffer_bytes))
    config.insert_json5("connect/timeout_ms", str(round(wait_s * 1e3)))
    config.insert_json5("connect/exit_on_failure", "true")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise UserError(f"nobody answers at {endpoint} ({_short(error)})") from error


def _short(error: zenoh.ZError) -> str:
    return str(error).split(" at ")[0][:120]


def _last(query: zenoh.Query) -> str:
    return str(query.key_expr).rpartition("/")[2]


class Bus:
    """One node's place on the network. Keep it open with `with`."""

    def __init__(self, session: zenoh.Session, robot: str, node: str, instance: str, epoch: int) -> None:
        self.session = session
        self.robot = robot
        self.producer = Producer(node, instance, epoch, local_clock_id())
        self._declared: list[object] = []  # dropped handles would be undeclared at once
        self._health = Publication(
            session, self.producer, Topic(HEALTH, Health, (node,), 1, "latest"), key(robot, HEALTH, node)
        )

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *exception: object) -> None:
        self.session.close()

    def publish(self, topic_name: str) -> Publication:
        """Declares a publication of a topic."""
        return Publication(self.session, self.producer, topic(topic_name), key(self.robot, topic_name))

    def subscribe(
        self,
        entry: Input,
        on_envelope: Callable[[Envelope], None],
        on_undecodable: Callable[[str, str], None],
        on_end: Callable[[str, str, int, int], None],
    ) -> None:
        """Declares a subscription; the callbacks run in threads of the bus.

        `on_end(topic, instance, epoch, sent)` tells that a producer has ended after `sent` messages.
        """
        delivery = entry.effective_delivery
        self._declared.append(
            Subscription(
                self.session, entry.row, delivery, key(self.robot, entry.topic), on_envelope, on_undecodable
            )
        )
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self.session,
            key(self.robot, "end", entry.topic),
            zenoh.handlers.FifoChannel(16),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True),
        )
        self._declared.append(subscriber)

        def receive() -> None:
            while True:
                try:
                    sample = subscriber.recv()
                except zenoh.ZError:
                    return
                try:
                    header = Header.unpack(sample.attachment.to_bytes() if sample.attachment else b"")
                    sent = msgpack.unpackb(sample.payload.to_bytes())
                except (DecodeError, ValueError, msgpack.UnpackException) as error:
                    on_undecodable(entry.topic, f"end marker: {error}")
                    continue
                if isinstance(sent, int):
                    on_end(entry.topic, header.instance, header.epoch, sent)

        threading.Thread(target=receive, name=f"end-{entry.topic}", daemon=True).start()

    def end(self, publication: Publication) -> None:
        """Tells the subscribers of a publication that nothing more will come."""
        publisher = zenoh.ext.declare_advanced_publisher(
            self.session,
            key(self.robot, "end", publication.row.name),
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(sporadic_heartbeat=0.5),
            publisher_detection=True,
        )
        p = self.producer
        header = Header(0, time.monotonic_ns(), p.clock_id, publication.sent, p.epoch, p.node, p.instance)
        publisher.put(msgpack.packb(publication.sent), attachment=header.pack())
        self._declared.append(publisher)

    def answer_queries(self, on_query: Callable[[str, zenoh.Query], None]) -> None:
        """Declare control/<instance>/*, requests to this process; `announce` adds those to the node.

        `on_query(name, query)` runs in a thread of the bus.
        """
        self._on_query = on_query
        place = key(self.robot, CONTROL, self.producer.instance, "*")
        self._answer(place, lambda query: on_query(f"{CONTROL}/{_last(query)}", query))

    def announce(self, queries: tuple[str, ...]) -> None:
        """Show this process as the active node: declare its queries and its liveliness token."""
        for name in queries:
            place = key(self.robot, "query", self.producer.node, name)
            self._answer(place, partial(self._on_query, name))
        node, instance = self.producer.node, self.producer.instance
        self._declared.append(
            self.session.liveliness().declare_token(key(self.robot, "alive", node, instance))
        )

    def _answer(self, place: str, on_query: Callable[[zenoh.Query], None]) -> None:
        queryable = self.session.declare_queryable(place, zenoh.handlers.FifoChannel(16))
        self._declared.append(queryable)

        def receive() -> None:
            while True:
                try:
                    query = queryable.recv()
                except zenoh.ZError:
                    return
                on_query(query)

        threading.Thread(target=receive, name=f"query-{place}", daemon=True).start()

    def watch_health(self, on_health: Callable[[Health], None]) -> None:
        """Brings the health of every node of this robot; `on_health` runs in a thread of the bus."""
        subscriber = self.session.declare_subscriber(
            key(self.robot, HEALTH, "*"), zenoh.handlers.FifoChannel(256)
        )
        self._declared.append(subscriber)
        row = Topic(HEALTH, Health, (), 1, "latest")

        def receive() -> None:
            while True:
                try:
                    sample = subscriber.recv()
                except zenoh.ZError:
                    return
                try:
                    health = decode_sample(sample, row).message
                except DecodeError:  # another version's health cannot be shown; its node still runs
                    continue
                on_health(health)

        threading.Thread(target=receive, name="watch-health", daemon=True).start()

    def report(self, health: Health) -> None:
        """Publishes this node's health."""
        self._health.put(health)

    def alive_nodes(self) -> set[str]:
        """Names of the nodes of this robot that are active now."""
        replies = self.session.liveliness().get(key(self.robot, "alive", "*", "*"), timeout=2.0)
        return {str(r.ok.key_expr).split("/")[3] for r in replies if r.ok is not None}
