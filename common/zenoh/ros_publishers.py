"""Publishers of ROS 2 topics by rmw_zenoh's keys, for the distribution whose nodes the robot runs.

Each topic is published with the type hash of Iron and newer, without one as in Humble, or both, as the
robot's own liveliness tokens show (`ros_graph`).
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from beamsplat.common.recording import ros_types as ros
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.rmw import (
    LIVELINESS_PREFIX,
    NO_TYPE_HASH,
    OWN_NODE,
    TYPE_HASH,
    RmwAttachment,
    RmwEntity,
    RmwQos,
    data_key,
)
from beamsplat.common.zenoh.ros_graph import RosGraph, RosTopic

_FIFO = 1024  # liveliness tokens that wait for the receiving thread
_DISCOVERY_S = 2.0  # longest wait for the tokens that exist at the start
_MOST_OBSTACLES = 16  # whose missed messages are counted apart
_SHOWN_OBSTACLES = 3  # in the status
_OTHER = "other subscribers have other types"
_KIND_TEXTS = {TYPE_HASH: "type hashes of Iron and newer", NO_TYPE_HASH: "no type hashes, as in Humble"}


def ros_topic(name: str, type_name: str, qos: RmwQos) -> RosTopic:
    """Return the topic `name` (with or without its leading slash) with the type's hash."""
    return RosTopic("/" + name.strip("/"), type_name, ros.typestore().hash_rihs01(type_name), qos)


class _Endpoint:
    """A Zenoh publisher with its liveliness token, declared as rmw_zenoh_cpp declares them."""

    def __init__(
        self, session: zenoh.Session, domain: int, entity_id: int, topic: RosTopic, type_hash: str
    ) -> None:
        entity = RmwEntity(
            domain, str(session.zid()), 0, entity_id, "MP", OWN_NODE, topic=topic.name,
            type_name=topic.type_name, type_hash=type_hash, qos=topic.qos,
        )  # fmt: skip
        key = data_key(domain, topic.name, topic.type_name, type_hash)
        drop = zenoh.CongestionControl.DROP  # a slow robot must not block this node
        self._publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if topic.qos.transient_local:
            self._publisher = zenoh.ext.declare_advanced_publisher(
                session, key, congestion_control=drop,
                cache=zenoh.ext.CacheConfig(topic.qos.depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                publisher_detection=True,
            )  # fmt: skip
        else:
            self._publisher = session.declare_publisher(key, congestion_control=drop)
        self._token = session.liveliness().declare_token(entity.token())
        self._gid = entity.gid()

    @property
    def matched(self) -> bool:
        """Whether somebody subscribes to the key; also True if the topic is latched."""
        if not isinstance(self._publisher, zenoh.Publisher):
            return True
        return bool(self._publisher.matching_status.matching)  # type: ignore[attr-defined]

    def put(self, payload: bytes, sequence: int) -> None:
        attachment = RmwAttachment(sequence, time.time_ns(), self._gid).pack()
        self._publisher.put(payload, attachment=attachment)

    def undeclare(self) -> None:
        self._token.undeclare()
        self._publisher.undeclare()


class _TopicPublisher:
    """The endpoints of one topic by kind of type hash, and what its subscribers could take."""

    def __init__(self, topic: RosTopic, first_entity_id: int) -> None:
        self.topic = topic
        self._entity_ids = {TYPE_HASH: first_entity_id, NO_TYPE_HASH: first_entity_id + 1}
        self.endpoints: dict[str, _Endpoint] = {}
        self.taken = 0  # messages that at least one subscriber could take
        self._last: bytes | None = None  # of a latched topic
        self._last_is_taken = False
        self._sequence = 0

    def use(self, kinds: frozenset[str], session: zenoh.Session, domain: int) -> None:
        """Declare the endpoints of `kinds` and undeclare others; new ones get the last latched message."""
        for kind in self.endpoints.keys() - kinds:
            self.endpoints.pop(kind).undeclare()
        for kind in kinds - self.endpoints.keys():
            type_hash = self.topic.type_hash if kind == TYPE_HASH else NO_TYPE_HASH
            endpoint = _Endpoint(session, domain, self._entity_ids[kind], self.topic, type_hash)
            self.endpoints[kind] = endpoint
            if self._last is not None:
                endpoint.put(self._last, self._sequence)

    def put(self, payload: bytes, has_taker: bool) -> None:
        self._sequence += 1
        for endpoint in self.endpoints.values():
            endpoint.put(payload, self._sequence)
        self.taken += has_taker
        if self.topic.qos.transient_local:
            self._last, self._last_is_taken = payload, has_taker

    def late_subscriber(self) -> None:
        """Count the latched message that a subscriber takes which has come after it was published."""
        if self._last is not None and not self._last_is_taken:
            self.taken += 1
            self._last_is_taken = True


class RosPublishers:
    """Publishers of several ROS topics in one domain; every method may be called from any thread.

    `put` never waits for a subscriber: what a link cannot take is dropped.

    Args:
        topics: by a short name, for `put` and the status.
    """

    def __init__(self, session: zenoh.Session, domain: int, topics: dict[str, RosTopic]) -> None:
        self._session, self._domain = session, domain
        self._lock = threading.Lock()
        self._graph = RosGraph(list(topics.values()))
        self._missed: Counter[str] = Counter()
        self._publishers = {
            name: _TopicPublisher(topic, 2 * number + 1)
            for number, (name, topic) in enumerate(topics.items())
        }
        node = RmwEntity(domain, str(session.zid()), 0, 0, "NN", OWN_NODE)
        self._token = session.liveliness().declare_token(node.token())
        tokens = f"{LIVELINESS_PREFIX}/{domain}/**"
        for reply in session.liveliness().get(tokens, timeout=_DISCOVERY_S):
            if reply.ok is not None:
                self._graph.add(str(reply.ok.key_expr))
        self._use_hash_kinds()
        subscriber = session.liveliness().declare_subscriber(
            tokens, zenoh.handlers.FifoChannel(_FIFO), history=True
        )
        receive_in_thread(session, "ros2-graph", subscriber, self._on_token)

    def __contains__(self, name: str) -> bool:
        return name in self._publishers

    def put(self, name: str, build: Callable[[], Any]) -> None:
        """Publish a ROS message on the topic `name`, if it is one of the topics.

        Args:
            build: returns the message. It is not called if nobody subscribes to the topic, unless it is
                latched.
        """
        publisher = self._publishers.get(name)
        if publisher is None:
            return
        with self._lock:
            self._count_missed(publisher.topic.name)
            matched = any(endpoint.matched for endpoint in publisher.endpoints.values())
        if not matched:
            return
        payload = ros.serialize(build())
        with self._lock:
            publisher.put(payload, bool(self._graph.takers(publisher.topic.name)))

    def status(self) -> str:
        """Return one line: messages that subscribers could take, topics without one, wrong subscribers."""
        with self._lock:
            kinds = " and ".join(_KIND_TEXTS[kind] for kind in sorted(self._graph.hash_kinds(), reverse=True))
            taken, silent, obstacles = [], [], []
            for name, publisher in self._publishers.items():
                takers = len(self._graph.takers(publisher.topic.name))
                if takers or publisher.taken:
                    taken.append(f"{name} {publisher.taken} to {takers}")
                else:
                    silent.append(name)
                obstacles += self._graph.obstacles(publisher.topic.name)
        parts = [", ".join(taken)] if taken else []
        parts += [f"no subscriber: {', '.join(silent)}"] if silent else []
        parts += obstacles[:_SHOWN_OBSTACLES]
        return f"to ROS 2 ({kinds}): {'; '.join(parts)}"

    def missed(self) -> dict[str, int]:
        """Return the number of messages that subscribers with another type or definition have missed."""
        with self._lock:
            return dict(self._missed)

    def _count_missed(self, topic: str) -> None:
        for obstacle in self._graph.obstacles(topic):
            known = obstacle in self._missed or len(self._missed) < _MOST_OBSTACLES
            self._missed[obstacle if known else _OTHER] += 1

    def _on_token(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._graph.add(token)
            else:
                self._graph.remove(token)
            self._use_hash_kinds()
            for publisher in self._publishers.values():
                if any(s.transient_local for s in self._graph.takers(publisher.topic.name)):
                    publisher.late_subscriber()

    def _use_hash_kinds(self) -> None:
        kinds = self._graph.hash_kinds()
        for publisher in self._publishers.values():
            publisher.use(kinds, self._session, self._domain)
