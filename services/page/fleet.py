"""The robots that a page knows: its own, and with the option `fleet` all that its router hears."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from beamsplat.services.page.view import PageState

MAX_ROBOTS = 100  # names come from other hosts
_FORGET_S = 60.0  # a robot that was not heard for so long makes room for another one


class Fleet:
    """State of each robot by name; every method may be called from any thread."""

    def __init__(self, own: str, make_state: Callable[[], PageState]) -> None:
        self.own = own
        self._make_state = make_state
        self._lock = threading.Lock()
        self._states = {own: make_state()}
        self.ignored = 0  # messages of robots beyond `MAX_ROBOTS`

    @property
    def own_state(self) -> PageState:
        """State of the page's own robot."""
        return self._states[self.own]

    def state_of(self, robot: str) -> PageState | None:
        """Return the state of a robot of which a message has arrived, new if it is the first one.

        None, and counted, if there are too many robots.
        """
        with self._lock:
            if robot not in self._states:
                if len(self._states) >= MAX_ROBOTS and not self._forget_one():
                    self.ignored += 1
                    return None
                self._states[robot] = self._make_state()
            return self._states[robot]

    def states(self) -> dict[str, PageState]:
        """Return the states by name, in alphabetical order."""
        with self._lock:
            return dict(sorted(self._states.items()))

    def _forget_one(self) -> bool:
        """Forget the robot that was silent for longest, if for long enough; return whether there is one."""
        others = {name: state.heard_s for name, state in self._states.items() if name != self.own}
        oldest = min(others, key=lambda name: others[name])
        if time.monotonic() - others[oldest] < _FORGET_S:
            return False
        del self._states[oldest]
        return True
