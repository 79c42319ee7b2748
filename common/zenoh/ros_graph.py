"""What a robot's liveliness tokens tell about its nodes: their type hashes, and who subscribes to our topics.

The keys of rmw_zenoh contain the type hash, so that a subscriber receives only what is published with its own
type and hash. Humble has no type hashes; from Iron on they are the same in all distributions as long as the
definition of the type is. The module opens no session.
"""

from __future__ import annotations

from typing import NamedTuple

from beamsplat.common.zenoh.rmw import NO_TYPE_HASH, OWN_NODE, TYPE_HASH, RmwEntity, RmwQos

_MAX_NODES = 1024  # of the robot whose type hashes are known; the oldest is forgotten
_MAX_SUBSCRIBERS = 1024  # to our topics, in all
_SHOWN_CHARS = 12  # of a type hash after "RIHS01_", in texts
_SHOWN_NAME = 64  # characters of a name from the robot, in texts


class RosTopic(NamedTuple):
    """A ROS topic that we publish: name with its leading slash, type, type hash (from Iron on), QoS."""

    name: str
    type_name: str
    type_hash: str
    qos: RmwQos


class Subscriber(NamedTuple):
    """A subscription of the robot to one of our topics; `obstacle` says why it receives nothing, or is ""."""

    topic: str
    transient_local: bool
    obstacle: str


class RosGraph:
    """The nodes and subscriptions of a robot, from the liveliness tokens in one ROS domain. Bounded.

    Tokens of nodes called `OWN_NODE` are ignored: those are ours.
    """

    def __init__(self, topics: list[RosTopic]) -> None:
        self._topics = {topic.name: topic for topic in topics}
        self._nodes: dict[tuple[str, int], str] = {}  # (session, node id) -> NO_TYPE_HASH or TYPE_HASH
        self._subscribers: dict[str, Subscriber] = {}  # by token
        self._kinds: frozenset[str] = frozenset()

    def add(self, token: str) -> None:
        """Register the entity of a token that has appeared."""
        entity = RmwEntity.parse(token)
        if entity is None or entity.node_name == OWN_NODE or entity.kind == "NN":
            return
        if (kind := _kind_of(entity.type_hash)) is not None:
            if len(self._nodes) >= _MAX_NODES:
                del self._nodes[next(iter(self._nodes))]
            self._nodes[entity.zid, entity.node_id] = kind
        topic = self._topics.get("/" + entity.topic.strip("/")) if entity.kind == "MS" else None
        if topic is not None and len(self._subscribers) < _MAX_SUBSCRIBERS:
            obstacle = _obstacle(entity, topic)
            self._subscribers[token] = Subscriber(topic.name, entity.qos.transient_local, obstacle)

    def remove(self, token: str) -> None:
        """Forget the entity of a token that has disappeared."""
        self._subscribers.pop(token, None)
        entity = RmwEntity.parse(token)
        if entity is not None and entity.kind == "NN":
            self._nodes.pop((entity.zid, entity.node_id), None)

    def hash_kinds(self) -> frozenset[str]:
        """Return which of `TYPE_HASH` and `NO_TYPE_HASH` the robot's nodes use.

        While the robot has no nodes, these are the kinds of its last ones; at first `TYPE_HASH`.
        """
        self._kinds = frozenset(self._nodes.values()) or self._kinds
        return self._kinds or frozenset((TYPE_HASH,))

    def takers(self, topic: str) -> list[Subscriber]:
        """Return the subscribers to `topic` whose type and hash are ours."""
        return [s for s in self._subscribers.values() if s.topic == topic and not s.obstacle]

    def obstacles(self, topic: str) -> list[str]:
        """Return a sentence for each subscriber to `topic` that cannot receive it; each sentence once."""
        found = {s.obstacle for s in self._subscribers.values() if s.topic == topic and s.obstacle}
        return sorted(found)


def _kind_of(type_hash: str) -> str | None:
    if type_hash == NO_TYPE_HASH:
        return NO_TYPE_HASH
    return TYPE_HASH if type_hash.startswith(TYPE_HASH) else None


def _obstacle(entity: RmwEntity, topic: RosTopic) -> str:
    """Return why the subscription `entity` cannot receive the messages of `topic`; "" if it can."""
    node = f"{entity.namespace.rstrip('/')}/{entity.node_name}"[:_SHOWN_NAME]
    if entity.type_name != topic.type_name:
        theirs = entity.type_name[:_SHOWN_NAME]
        return f"{node} expects {theirs} on {topic.name}, whose type is {topic.type_name}"
    if entity.type_hash in (topic.type_hash, NO_TYPE_HASH):
        return ""
    theirs, ours = (h[: len(TYPE_HASH) + _SHOWN_CHARS] for h in (entity.type_hash, topic.type_hash))
    return f"{node} has another definition of {topic.type_name} on {topic.name} ({theirs}, ours is {ours})"
