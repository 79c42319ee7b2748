"""Hand-over of a node to a second process of the same node, without repeating or losing messages.

A supervisor starts the successor in standby while the predecessor is still active, and then moves the role of
the active process from one to the other. It sends three requests, each answered between two messages:

    control/<node>/<id>/reached   -> {topic: newest stamp published or stored}
    control/<node>/<id>/retire    -> {"said": {topic: newest stamp}} or {"handled": ...}
    control/<node>/<id>/activate  ?after=<answer of retire> -> {"kept": count, "lost": count}

    successor:                                            predecessor:

    started --configured--> STANDBY --activate--> ACTIVE  ACTIVE --retire--> RETIRED --> process ends
                             |  ^                          |  ^
                             +--+ reached                  +--+ reached

1. STANDBY: the successor receives all inputs and computes its outputs, but publishes nothing, not even
   health. It stores the newest 16 outputs; when a further one is computed, the oldest is dropped, and only
   its topic and stamp are stored.
2. `reached` goes to both processes (a process answers once it is configured). The supervisor continues when
   the successor's newest stamps are close to the predecessor's, or after a time-out.
3. `retire`: the predecessor answers with the newest stamp that it published on each topic ("said"), publishes
   nothing from here on, and ends without end-of-stream markers.
4. `activate` passes this answer to the successor. The successor, whose epoch is higher, publishes the stored
   outputs whose stamp is newer than the predecessor's on the same topic ("kept" is their number), and becomes
   ACTIVE. From then on it discards an output that is not newer than the predecessor's last one: no stamp is
   published twice. Dropped outputs newer than the predecessor's last one were published by neither process:
   they are counted in "lost".
5. Messages of the predecessor that are still in transit have the lower epoch; subscribers ignore them.

A node that hands over its state (`Node.hands_over`) does no work in standby: inputs are queued. Its
predecessor writes its state in `hand_over` and answers `retire` with the sequence numbers that it has
handled, because its output stamps do not show which inputs are part of the state. The successor reads the
state in `take_over` and skips these inputs.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from beamsplat.common.messages import Message

if TYPE_CHECKING:
    from beamsplat.common.runtime.mailbox import Envelope, HandledSequences

CONTROL = "control"
_MAX_HELD = 16  # messages; one of them can be an image of some MB
_MAX_DROPPED = 100_000  # remembered (topic, stamp) pairs of dropped messages, only to count `lost`


@dataclass(frozen=True)
class Progress:
    """How far a retired process has come."""

    published: dict[str, int]  # topic -> newest stamp, ns
    handled: HandledSequences  # of a node that hands over its state


def parse_progress(text: str) -> Progress:
    """Return the progress in an answer to `retire`.

    Raises:
        ValueError: the text is not JSON, or not an answer of `retire`.
    """
    try:
        progress = json.loads(text)
        published = {str(topic): int(stamp) for topic, stamp in progress.get("said", {}).items()}
        handled = {
            str(topic): {
                str(instance): (int(sequence), [int(number) for number in queued])
                for instance, (sequence, queued) in instances.items()
            }
            for topic, instances in progress.get("handled", {}).items()
        }
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"not the answer of a retired process: {text[:40]!r}") from error
    return Progress(published, handled)


class Handover:
    """State of one process in the hand-over protocol, and its filter for outgoing messages."""

    def __init__(self, standby: bool) -> None:
        """`standby`: start as the successor of a running process; False: start as the active process."""
        self.standby = standby
        self.retired = False
        self.lost = 0  # set by `activate`: messages that neither process published
        self._held: deque[tuple[str, Message]] = deque()
        self._dropped: deque[tuple[str, int]] = deque(maxlen=_MAX_DROPPED)
        self._published: dict[str, int] = {}  # topic -> newest published stamp, the predecessor's included
        self._by_predecessor: dict[str, int] = {}  # topic -> newest stamp that the predecessor published
        self._handled: HandledSequences = {}

    def holds_back(self, topic: str, message: Message) -> bool:
        """Return whether the caller must not publish `message` now; store or discard it in that case.

        In standby the message is stored (the oldest stored one is dropped when `_MAX_HELD` are stored). A
        retired process discards it. After activation, it is discarded if the predecessor has published this
        stamp or a newer one on the topic. In all other cases its stamp is recorded as published.
        """
        if self.standby:
            if len(self._held) == _MAX_HELD:
                name, oldest = self._held.popleft()
                self._dropped.append((name, oldest.stamp_ns))
            self._held.append((topic, message))
            return True
        if self.retired or message.stamp_ns <= self._by_predecessor.get(topic, -1):
            return True
        self._published[topic] = max(self._published.get(topic, 0), message.stamp_ns)
        return False

    def was_handled(self, envelope: Envelope) -> bool:
        """Return whether the predecessor has already handled an input message (`hands_over` nodes only)."""
        handled = self._handled.get(envelope.topic, {}).get(envelope.header.instance)
        sequence = envelope.header.sequence
        return handled is not None and sequence < handled[0] and sequence not in handled[1]

    def reached(self) -> str:
        """Return the progress of this process as JSON: {topic: newest stamp (ns) published or stored}."""
        newest = dict(self._published)
        for topic, message in self._held:
            newest[topic] = max(newest.get(topic, 0), message.stamp_ns)
        return json.dumps(newest)

    def retire(self, handled: HandledSequences | None = None) -> str:
        """Stop publishing and return the progress of this process as JSON, the argument of `activate`.

        Args:
            handled: `Mailbox.handled()` of a node that hands over its state; None for other nodes.
        """
        self.retired = True
        return json.dumps({"said": self._published} if handled is None else {"handled": handled})

    def activate(self, progress: Progress) -> Iterator[tuple[str, Message]]:
        """Leave standby and yield (topic, message) of the stored messages to publish now, oldest first.

        These are the messages with a newer stamp than the predecessor has published on their topic.
        `progress` is the predecessor's.
        """
        self._by_predecessor, self._handled = progress.published, progress.handled
        self._published = dict(self._by_predecessor)
        self.standby = False
        self.lost = sum(stamp > self._by_predecessor.get(topic, -1) for topic, stamp in self._dropped)
        held, self._held = list(self._held), deque()
        for topic, message in held:
            if message.stamp_ns > self._by_predecessor.get(topic, -1):
                yield topic, message
