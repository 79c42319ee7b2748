"""Bridge between a robot and its edge server: forwards samples between Zenoh sessions, payloads unchanged.

The column `uplink` of the topic table selects the topics that are forwarded, and the direction. All other
topics stay on their host: no subscription on the other side can request them over a slow radio link. Small
and large messages use separate connections, so that an image never delays a pose. End-of-stream markers and
health reports are forwarded too: those of all nodes of one side together, once a second.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import zenoh

from beamsplat.common.messages import Odometry
from beamsplat.common.messages.codec import encode
from beamsplat.common.messages.header import DecodeError
from beamsplat.common.runtime.pacing import TokenBucket
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.common.topics import HEALTH, TOPICS, Topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.health_samples import (
    BUNDLE,
    BUNDLE_ENCODING,
    HEALTH_ROW,
    HealthCollection,
    decode_health,
    is_bundle,
)
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.streams import (
    FIFO_MESSAGES,
    declare_publication,
    declare_subscription,
    decode_end_marker,
    decode_header,
    decode_sample,
)
from beamsplat.common.zenoh.thinning import PoseThinning

log = logging.getLogger(__name__)

# For the health reports of all nodes of one side (1 Hz each): one side must not load the other's CPU.
_HEALTH_MAX_HZ = 100.0
_RESENT_QUEUE_MESSAGES = 8  # of a topic that is resent until acknowledged: a slow link drops the oldest
_HEALTH_PERIOD_S = 1.0  # as that of the reports


@dataclass(frozen=True)
class BridgeSessions:
    """The three Zenoh sessions between which a bridge forwards messages."""

    robot: zenoh.Session  # client of the robot's own router
    edge: zenoh.Session  # client of the edge server's router, for small messages
    edge_bulk: zenoh.Session  # the same router over a second connection, for large messages


@dataclass
class ForwardedTraffic:
    """Number of messages and of payload bytes that the bridge has forwarded on one topic."""

    messages: int = 0
    bytes: int = 0


class Bridge:
    """Forwards the topics with an `uplink` between robot and edge server, until its sessions are closed."""

    def __init__(self, robot: str, sessions: BridgeSessions) -> None:
        self._robot = robot
        self._bulk_replaced = threading.Event()  # set: a later session forwards the large messages
        self.forwarded: dict[str, ForwardedTraffic] = {}  # by topic; "health" is all nodes of both sides
        self._ends: dict[str, tuple[str, int]] = {}  # topic -> instance that ended it, number of its messages
        self.undecodable = 0  # samples without a valid header or too large, which are not forwarded
        self._undecodable_limit = RateLimitedLog()
        self.interrupted = 0  # messages lost because the connection broke while they were written
        self.health_dropped = 0  # health reports beyond _HEALTH_MAX_HZ
        for row in TOPICS.values():
            if row.uplink:
                self._forward_topic(row, sessions)
        self._forward_health(sessions.robot, sessions.edge)
        self._forward_health(sessions.edge, sessions.robot)

    def replace_bulk_session(self, sessions: BridgeSessions) -> None:
        """Forward large messages over a new session; call it after the connection of the old one broke.

        A write that was in progress when a connection broke can block the old session for good.
        """
        self._bulk_replaced.set()
        self._bulk_replaced = threading.Event()
        for row in TOPICS.values():
            if row.uplink == "bulk":
                self._forward_topic(row, sessions)

    @property
    def ended(self) -> set[str]:
        """Topics whose end-of-stream marker was forwarded, and on which no message has followed it."""
        return set(self._ends)

    def forwarded_up(self) -> dict[str, ForwardedTraffic]:
        """Return the numbers of messages and bytes forwarded from robot to edge server, by topic name."""
        return {
            name: c for name, c in self.forwarded.items() if name in TOPICS and TOPICS[name].uplink != "down"
        }

    def _forward_topic(self, row: Topic, sessions: BridgeSessions) -> None:
        source, target = {
            "up": (sessions.robot, sessions.edge),
            "bulk": (sessions.robot, sessions.edge_bulk),
            "down": (sessions.edge, sessions.robot),
        }[row.uplink]
        large = row.uplink == "bulk"
        # After an outage, subscribers recover from this publisher's cache, as they do from a producer's cache
        # on one host. A topic that its producer resends needs no cache.
        cached = replace(row, cache=0) if row.resent_until_ack else row
        publisher = declare_publication(
            target, key(self._robot, row.name), cached,
            # Large messages wait for a slow link, in a thread of their own: dropping would let none through.
            congestion=zenoh.CongestionControl.BLOCK_FIRST if large else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW if large else zenoh.Priority.INTERACTIVE_HIGH,
        )  # fmt: skip

        thinning = PoseThinning() if row.thinned else None
        skipped: list[zenoh.Sample] = []  # the newest message, if it was not forwarded
        # The end marker has another thread, which must see what was skipped; nothing is skipped after it.
        deciding, ending = threading.Lock(), threading.Event()

        def skip(sample: zenoh.Sample) -> bool:
            """Return whether a message is left out; `send_end` forwards the last one before the end."""
            if thinning is None:
                return False
            with deciding:
                skipped.clear()
                # What is still in transit then is needed.
                ended = ending.is_set() or row.name in self._ends
                if thinning.is_due(_pose_in(sample, row)) or ended:
                    return False
                skipped.append(sample)
                return True

        def send(sample: zenoh.Sample) -> bool:
            header = decode_header(sample, row)
            if skip(sample):
                return False
            _put(publisher, sample)
            ended_by, sent = self._ends.get(row.name, ("", 0))
            if ended_by and (header.instance != ended_by or header.sequence >= sent):
                self._ends.pop(row.name, None)  # not a recovered message: a new process publishes
            return True

        self._forward(source, row.name, row, send, row.name)
        end = replace(row, delivery="latched", cache=1)
        end_publisher = declare_publication(target, key(self._robot, "end", row.name), end)

        def send_end(sample: zenoh.Sample) -> bool:
            header, sent = decode_end_marker(sample)
            with deciding:
                ending.set()
                last = skipped[:]
                skipped.clear()
            try:
                for message in last:  # subscribers wait for the last message before the end
                    _put(publisher, message)
                _put(end_publisher, sample)
                self._ends[row.name] = (header.instance, sent)
            finally:
                ending.clear()
            return True

        self._forward(source, f"end/{row.name}", end, send_end, None)

    def _forward_health(self, source: zenoh.Session, target: zenoh.Session) -> None:
        """Collect the reports of the nodes on the side of `source`, and send them to `target` together.

        They are sent once a second, and at once if the state of a node has changed.
        """
        bucket, lock, collected = TokenBucket(_HEALTH_MAX_HZ), threading.Lock(), HealthCollection()
        count = self.forwarded.setdefault(HEALTH, ForwardedTraffic())

        def collect(sample: zenoh.Sample) -> bool:
            header = decode_header(sample, HEALTH_ROW)
            if is_bundle(sample):  # from elsewhere: only nodes of this side are forwarded
                return False
            if not bucket.take():
                self.health_dropped += 1
                return False
            (health,) = decode_health(sample)
            with lock:
                changed = collected.add(health, header)
            if changed:
                send()
            return False

        def send() -> None:
            with lock:
                taken = collected.take()
            if taken is None:
                return
            payload = encode(taken[0])
            try:
                target.put(
                    key(self._robot, HEALTH, BUNDLE), payload, encoding=BUNDLE_ENCODING,
                    attachment=taken[1].pack(),
                )  # fmt: skip
            except zenoh.ZError:  # the connection broke, or the session was closed
                self.interrupted += 1
                return
            count.messages += 1
            count.bytes += len(payload)

        def send_until_closed() -> None:
            while not source.is_closed():
                time.sleep(_HEALTH_PERIOD_S)
                send()

        self._forward(source, f"{HEALTH}/*", HEALTH_ROW, collect, None)
        threading.Thread(target=send_until_closed, name="forward-health-bundles", daemon=True).start()

    def _forward(
        self,
        source: zenoh.Session,
        topic_key: str,
        row: Topic,
        send: Callable[[zenoh.Sample], bool],  # returns whether it has forwarded the sample
        count_as: str | None,
    ) -> None:
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] | zenoh.handlers.RingChannel[zenoh.Sample]
        if row.resent_until_ack and row.delivery != "latched":
            channel = zenoh.handlers.RingChannel(_RESENT_QUEUE_MESSAGES)
        elif row.delivery == "latched":
            channel = zenoh.handlers.RingChannel(1)
        elif row.history:  # a full FIFO would block all topics of the session while the link is slow
            channel = zenoh.handlers.RingChannel(row.cache)
        else:
            channel = zenoh.handlers.FifoChannel(max(row.cache, FIFO_MESSAGES))
        # REMOTE: messages that this bridge published to `source` must not come back.
        subscriber = declare_subscription(
            source, key(self._robot, topic_key), row, row.delivery, channel, zenoh.Locality.REMOTE
        )
        replaced = self._bulk_replaced if row.uplink == "bulk" else threading.Event()
        count = self.forwarded.setdefault(count_as, ForwardedTraffic()) if count_as else ForwardedTraffic()

        def forward(sample: zenoh.Sample) -> None:
            try:
                forwarded = send(sample)
            except DecodeError as error:
                self.undecodable += 1
                if (more := self._undecodable_limit.due(topic_key)) is not None:
                    log.warning("%s: not forwarded (%d more): %s", topic_key, more, error)
                return
            except zenoh.ZError as error:  # the connection broke, or the session was closed
                self.interrupted += 1
                log.info("a message on %s was not forwarded: %s", topic_key, error)
                return
            count.messages += forwarded
            count.bytes += len(sample.payload) if forwarded else 0

        # The subscriber is undeclared when its thread has ended.
        receive_in_thread(source, f"forward-{topic_key}", subscriber, forward, replaced.is_set)


def _pose_in(sample: zenoh.Sample, row: Topic) -> Odometry:
    """Return the message of a sample. Raises DecodeError if it does not decode."""
    message = decode_sample(sample, row).message
    assert isinstance(message, Odometry)  # the message type of thinned topics
    return message


def _put(publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher, sample: zenoh.Sample) -> None:
    publisher.put(sample.payload, encoding=sample.encoding, attachment=sample.attachment)
