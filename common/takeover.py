"""How a node hands over to its successor while both run: no stamp twice, nothing between them lost.

The successor starts in standby: it takes all inputs and works, but keeps back what it would say. Then the
supervisor has the predecessor retire between two messages and tell how far it has come, and the successor go
on from there, with a higher epoch, beginning with what it has kept back and the predecessor has not said. The
predecessor says nothing any more, and what is still on its way from it, consumers ignore by its epoch.

    control/<instance>/ready      -> how many messages are kept back; answered once the node is configured
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
        self._said: dict[str, int] = {}  # newest stamp by topic

    def keeps(self, topic: str, message: Message) -> bool:
        """Whether a message is kept back for now; else it is noted as said."""
        if self.standby:
            self._held.append((topic, message))
            return True
        if self.retired:
            return True
        self._said[topic] = max(self._said.get(topic, 0), message.stamp_ns)
        return False

    def ready(self) -> str:
        """How many messages are kept back."""
        return str(len(self._held))

    def retire(self) -> str:
        """Nothing more is said; the newest stamps that were, as JSON."""
        self.retired = True
        return json.dumps(self._said)

    def activate(self, after: str) -> Iterator[tuple[str, Message]]:
        """What the predecessor, which came as far as `after` says, has not said any more.

        Raises:
            ValueError: this is not JSON, or not of numbers.
        """
        stamps = {str(topic): int(stamp) for topic, stamp in json.loads(after).items()}
        self.standby = False
        held, self._held = list(self._held), deque()
        for topic, message in held:
            if message.stamp_ns > stamps.get(topic, -1):
                yield topic, message
