"""How a node hands over to its successor while both run: no stamp twice, nothing between them lost.

The successor starts in standby: it takes all inputs and works, but keeps back what it would say. Then the
supervisor has the predecessor retire between two messages and tell how far it has come, and the successor go
on from there, with a higher epoch, beginning with what it has kept back and the predecessor has not said. The
predecessor says nothing any more, and what is still on its way from it, consumers ignore by its epoch.

    control/<instance>/reached    -> {topic: newest stamp said or kept back}; answered once configured
    control/<instance>/retire     -> {topic: newest stamp said}; it says nothing more, and ends
    control/<instance>/activate   ?after={topic: stamp}
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator

from common.messages import Message

CONTROL = "control"
_HELD = 16  # a message may be a picture


class Takeover:
    """Where one process stands between standby and retirement."""

    def __init__(self, standby: bool) -> None:
        self.standby = standby
        self.retired = False
        self._held: deque[tuple[str, Message]] = deque(maxlen=_HELD)
        self._said: dict[str, int] = {}  # newest stamp by topic; at first, the predecessor's
        self._inherited: dict[str, int] = {}

    def keeps(self, topic: str, message: Message) -> bool:
        """Whether a message is kept back for now; else it is noted as said."""
        if self.standby:
            self._held.append((topic, message))
            return True
        if self.retired or message.stamp_ns <= self._inherited.get(topic, -1):
            return True  # its predecessor has said this, or its successor will
        self._said[topic] = max(self._said.get(topic, 0), message.stamp_ns)
        return False

    def reached(self) -> str:
        """The newest stamps said or kept back, as JSON."""
        newest = dict(self._said)
        for topic, message in self._held:
            newest[topic] = max(newest.get(topic, 0), message.stamp_ns)
        return json.dumps(newest)

    def retire(self) -> str:
        """Nothing more is said; the newest stamps that were, as JSON."""
        self.retired = True
        return json.dumps(self._said)

    def activate(self, after: str) -> Iterator[tuple[str, Message]]:
        """What the predecessor, which came as far as `after` says, has not said any more.

        Raises:
            ValueError: this is not JSON, or not of numbers.
        """
        self._inherited = {str(topic): int(stamp) for topic, stamp in json.loads(after).items()}
        self._said = dict(self._inherited)
        self.standby = False
        held, self._held = list(self._held), deque()
        for topic, message in held:
            if message.stamp_ns > self._inherited.get(topic, -1):
                yield topic, message
