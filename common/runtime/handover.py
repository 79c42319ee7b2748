"""How a node hands over to its successor while both run: no stamp twice, nothing between them lost.

The successor starts in standby: it takes all inputs and works, but keeps back what it would say. Then the
supervisor has the predecessor retire between two messages and tell how far it has come, and the successor go
on from there, with a higher epoch, beginning with what it has kept back and the predecessor has not said. The
predecessor says nothing any more, and what is still on its way from it, consumers ignore by its epoch.

A node that hands over what it knows (`Node.hands_over`) does not work in standby: messages wait until it has
taken that up, and those that its predecessor has handled are then passed over.

    control/<instance>/reached    -> {topic: newest stamp said or kept back}; answered once configured
    control/<instance>/retire     -> {said: {topic: newest stamp}} or {handled: ...}; falls silent, ends
    control/<instance>/activate   ?after= that answer -> {kept: messages kept back and said now, lost: others}
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING

from beamsplat.common.messages import Message

if TYPE_CHECKING:
    from beamsplat.common.runtime.mailbox import Envelope, Handled

CONTROL = "control"
_HELD = 16  # a message may be a picture
_COUNTED = 100_000  # stamps of those that were not kept


class Handover:
    """Where one process stands between standby and retirement."""

    def __init__(self, standby: bool) -> None:
        self.standby = standby
        self.retired = False
        self.lost = 0  # not kept back for lack of room, and not said by the predecessor either
        self._held: deque[tuple[str, Message]] = deque()
        self._let_go: deque[tuple[str, int]] = deque(maxlen=_COUNTED)
        self._said: dict[str, int] = {}  # newest stamp by topic; at first, the predecessor's
        self._inherited: dict[str, int] = {}
        self._handled: Handled = {}

    def holds_back(self, topic: str, message: Message) -> bool:
        """Whether a message is kept back for now; else it is noted as said."""
        if self.standby:
            if len(self._held) == _HELD:
                name, oldest = self._held.popleft()
                self._let_go.append((name, oldest.stamp_ns))
            self._held.append((topic, message))
            return True
        if self.retired or message.stamp_ns <= self._inherited.get(topic, -1):
            return True  # its predecessor has said this, or its successor will
        self._said[topic] = max(self._said.get(topic, 0), message.stamp_ns)
        return False

    def was_handled(self, envelope: Envelope) -> bool:
        """Whether the predecessor has dealt with what waited here meanwhile."""
        known = self._handled.get(envelope.topic, {}).get(envelope.header.instance)
        sequence = envelope.header.sequence
        return known is not None and sequence < known[0] and sequence not in known[1]

    def reached(self) -> str:
        """The newest stamps said or kept back, as JSON."""
        newest = dict(self._said)
        for topic, message in self._held:
            newest[topic] = max(newest.get(topic, 0), message.stamp_ns)
        return json.dumps(newest)

    def retire(self, handled: Handled | None = None) -> str:
        """Nothing more is said; how far it has come, as JSON. Who hands over what it knows says what it has
        `handled`: its stamps do not tell."""
        self.retired = True
        return json.dumps({"said": self._said} if handled is None else {"handled": handled})

    def activate(self, after: str) -> Iterator[tuple[str, Message]]:
        """What the predecessor, which came as far as `after` says, has not said any more.

        Raises:
            ValueError: this is not JSON, or not what `retire` gives.
        """
        came = json.loads(after)
        said, handled = (came.get(k, {}) for k in ("said", "handled")) if isinstance(came, dict) else (0, 0)
        if not (isinstance(said, dict) and isinstance(handled, dict)):
            raise ValueError(f"not what a predecessor answers: {after[:40]!r}")
        self._inherited = {str(topic): int(stamp) for topic, stamp in said.items()}
        self._handled = handled
        self._said = dict(self._inherited)
        self.standby = False
        self.lost = sum(stamp > self._inherited.get(topic, -1) for topic, stamp in self._let_go)
        held, self._held = list(self._held), deque()
        for topic, message in held:
            if message.stamp_ns > self._inherited.get(topic, -1):
                yield topic, message
