"""What crosses between a robot and its edge server: samples carried from one session to another, untouched.

The column `uplink` of the topic table says what crosses, and how: a subscription on the other side cannot
pull anything else over a radio. Small messages and large ones go over links of their own, so that a picture
never stands before a pose. Ends of streams and health cross as well.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import zenoh

from beamsplat.common.messages import Health
from beamsplat.common.runtime.pacing import Allowance
from beamsplat.common.topics import HEALTH, TOPICS, Topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import FIFO_MESSAGES, declare_reader, declare_writer

log = logging.getLogger(__name__)

_HEALTHS_HZ = 100.0  # of all nodes of a side: more is no health, and would cost the other side its CPU
_NEWEST = 8  # of what is sent again anyway: behind a slow link the oldest is passed over
_HEALTH_ROW = Topic(HEALTH, Health, (), 1, "every")


@dataclass(frozen=True)
class Sides:
    """Sessions: the robot's own router, and two with the edge's, for small messages and for large ones."""

    robot: zenoh.Session
    small: zenoh.Session
    large: zenoh.Session


@dataclass
class Carried:
    """What has crossed of one topic."""

    messages: int = 0
    bytes: int = 0


class Relay:
    """Carries until the sessions are closed. `carried` counts by topic, `ended` names those that ended."""

    def __init__(self, name: str, sides: Sides) -> None:
        self._name = name
        self._over = threading.Event()  # set: a later session carries the large messages
        self.carried: dict[str, Carried] = {}
        self.ended: set[str] = set()
        self.failed = 0  # cut off in the middle
        self.refused = 0  # healths beyond what nodes have to say
        for row in TOPICS.values():
            if row.uplink:
                self._carry_topic(row, sides)
        self._carry_health(sides.robot, sides.small)
        self._carry_health(sides.small, sides.robot)

    def renew_large(self, sides: Sides) -> None:
        """Goes on with another session for large messages: what was being written when a link broke can stay
        stuck in the old one for good."""
        self._over.set()
        self._over = threading.Event()
        for row in TOPICS.values():
            if row.uplink == "bulk":
                self._carry_topic(row, sides)

    def upward(self) -> dict[str, Carried]:
        """What has crossed from the robot, by topic."""
        return {
            name: c for name, c in self.carried.items() if name in TOPICS and TOPICS[name].uplink != "down"
        }

    def _carry_topic(self, row: Topic, sides: Sides) -> None:
        ways = {"up": (sides.robot, sides.small), "bulk": (sides.robot, sides.large),
                "down": (sides.small, sides.robot)}  # fmt: skip
        source, target = ways[row.uplink]
        large = row.uplink == "bulk"
        # What nobody sends again is recovered from this side's cache after an outage, as it is on one host.
        cached = replace(row, cache=0) if row.repeated else row
        writer = declare_writer(
            target, key(self._name, row.name), cached,
            # Waits for a slow link in a thread of its own: dropping large messages would let none through.
            congestion=zenoh.CongestionControl.BLOCK_FIRST if large else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW if large else zenoh.Priority.INTERACTIVE_HIGH,
        )  # fmt: skip
        self._carry(source, row.name, row, lambda sample: _put(writer, sample), row.name)
        end = replace(row, delivery="latched", cache=1)
        end_writer = declare_writer(target, key(self._name, "end", row.name), end)

        def send_end(sample: zenoh.Sample) -> None:
            _put(end_writer, sample)
            self.ended.add(row.name)

        self._carry(source, f"end/{row.name}", end, send_end, None)

    def _carry_health(self, source: zenoh.Session, target: zenoh.Session) -> None:
        allowance = Allowance(_HEALTHS_HZ)

        def send(sample: zenoh.Sample) -> None:
            if not allowance.take():
                self.refused += 1
                return
            target.put(
                sample.key_expr, sample.payload, encoding=sample.encoding, attachment=sample.attachment
            )

        self._carry(source, f"{HEALTH}/*", _HEALTH_ROW, send, HEALTH)

    def _carry(
        self,
        source: zenoh.Session,
        topic_key: str,
        row: Topic,
        send: Callable[[zenoh.Sample], None],
        count_as: str | None,
    ) -> None:
        if row.repeated and row.delivery != "latched":
            channel = zenoh.handlers.RingChannel(_NEWEST)
        elif row.delivery == "latched":
            channel = zenoh.handlers.RingChannel(1)
        else:
            channel = zenoh.handlers.FifoChannel(max(row.cache, FIFO_MESSAGES))
        # What this process itself put on that side is not to come back.
        reader = declare_reader(
            source, key(self._name, topic_key), row, row.delivery, channel, zenoh.Locality.REMOTE
        )
        over = self._over if row.uplink == "bulk" else threading.Event()
        count = self.carried.setdefault(count_as, Carried()) if count_as else Carried()

        def work() -> None:
            while True:
                try:
                    sample = reader.recv()
                except zenoh.ZError:  # the session was closed
                    return
                if over.is_set():  # with this thread its reader ends
                    return
                try:
                    send(sample)
                except zenoh.ZError as error:  # the link broke in the middle of it, or the session was closed
                    self.failed += 1
                    log.info("%s did not cross: %s", topic_key, error)
                    continue
                count.messages += 1
                count.bytes += len(sample.payload)

        threading.Thread(target=work, name=f"carry-{topic_key}", daemon=True).start()


def _put(writer: zenoh.Publisher | zenoh.ext.AdvancedPublisher, sample: zenoh.Sample) -> None:
    writer.put(sample.payload, encoding=sample.encoding, attachment=sample.attachment)
