"""A session of the page that receives the messages of all robots which its router hears."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial

import zenoh

from beamsplat.common.messages import Message
from beamsplat.common.messages.header import DecodeError
from beamsplat.common.topics import HEALTH, Topic, topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.health_samples import HEALTH_ROW, decode_health
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample

# Of all robots; a full ring loses its oldest message, and never delays the session.
_QUEUED, _QUEUED_HISTORY = 256, 4096
_ROBOT = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")  # as in a deployment


class FleetSubscriptions:
    """Subscriptions to topics and health of every robot except the own one, until the session is closed.

    The callbacks are called from threads of the session.
    """

    def __init__(
        self, session: zenoh.Session, own: str, topics: tuple[str, ...],
        on_message: Callable[[str, str, Message], None], on_refused: Callable[[str], None],
        robots: str = "*",
    ) -> None:  # fmt: skip
        """Subscribe.

        Args:
            own: name of the robot whose messages are ignored here, "" = of none.
            topics: names of topics; the health of all nodes besides.
            on_message: called with (robot, topic, message); topic is "health" for a `Health`.
            on_refused: called with the reason for each sample that cannot be used.
            robots: name of the only robot to be heard, "*" = all.
        """
        self._robots = robots
        self._own, self._on_message, self._on_refused = own, on_message, on_refused
        self._declared: list[object] = []  # Zenoh undeclares a handle that is garbage-collected
        for name in topics:
            row = topic(name)
            self._subscribe(session, row, row.name, row.delivery)
        self._subscribe(session, HEALTH_ROW, f"{HEALTH}/*", "latest")

    def _subscribe(self, session: zenoh.Session, row: Topic, suffix: str, delivery: str) -> None:
        size = _QUEUED_HISTORY if row.history else _QUEUED
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(size)
        subscriber = declare_subscription(session, key(self._robots, suffix), row, delivery, channel)
        self._declared.append(subscriber)
        receive_in_thread(session, f"fleet-{row.name}", subscriber, partial(self._handle, row))

    def _handle(self, row: Topic, sample: zenoh.Sample) -> None:
        robot = str(sample.key_expr).split("/")[1]
        if robot == self._own:
            return
        if not _ROBOT.fullmatch(robot):
            self._on_refused("messages of other robots: the name is not that of a robot")
            return
        try:
            messages = _decode(sample, row)
        except DecodeError:
            self._on_refused("messages of other robots: not decodable")
            return
        for message in messages:
            self._on_message(robot, row.name, message)


def _decode(sample: zenoh.Sample, row: Topic) -> Sequence[Message]:
    """Return the message of a sample, or the health reports. Raises DecodeError if it does not decode."""
    return decode_health(sample) if row.name == HEALTH else [decode_sample(sample, row).message]
