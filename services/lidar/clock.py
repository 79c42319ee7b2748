"""From the device's clock to the host's, through a link that delays by a varying amount but never hastens."""

from __future__ import annotations

from collections import deque

import numpy as np

_WINDOW = 400  # packets: seconds, over which the two clocks' rates differ by microseconds
_EARLY_NS = 5_000_000  # nothing arrives so much faster than the fastest so far
_LATE_NS = 2_000_000_000
_RESET_AFTER = 8  # packets in a row that contradict the clock: it is the clock that was wrong


class DeviceClock:
    """Offset = the least of (arrival - device time) over the last packets.

    Buffers, USB frames and a busy host make packets late, never early: the least delayed of many tells
    the offset best. Drift between the clocks (100 ppm) is forgotten with the window. A packet from the
    future has a wrong byte in its time.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[int, int]] = deque()  # (number, arrival minus device time), rising
        self._count = 0
        self._rejected = 0
        self._newest_ns = 0

    def update(self, device_s: float, arrival_ns: int) -> bool:
        """A packet whose last measurement was at `device_s` has arrived (transmission time taken off).
        False: that cannot be, and is not believed."""
        offset = arrival_ns - round(device_s * 1e9)
        if self._offsets and not -_EARLY_NS < offset - self._offsets[0][1] < _LATE_NS:
            self._rejected += 1
            if self._rejected < _RESET_AFTER:
                return False
            self._offsets.clear()
        self._rejected = 0
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((self._count, offset))
        self._count += 1
        while self._offsets[0][0] < self._count - _WINDOW:
            self._offsets.popleft()
        return True

    def stamp_ns(self, device_s: float) -> int:
        """Host time of a moment of the device; later than every one given before.

        Raises:
            ValueError: nothing was heard yet.
        """
        if not self._offsets:
            raise ValueError("a device clock needs a packet before it can tell the time")
        stamp = self._offsets[0][1] + round(device_s * 1e9)
        self._newest_ns = max(stamp, self._newest_ns + 1)
        return self._newest_ns

    def reset(self) -> None:
        """The device has restarted: its clock with it. Stamps still never run backwards."""
        self._offsets.clear()
        self._rejected = 0


class CounterUnwrapper:
    """A device's counter that starts over at `modulus`, counted on with the help of the host's clock."""

    def __init__(self, modulus: int, ticks_per_s: float) -> None:
        self._modulus = modulus
        self._ticks_per_ns = ticks_per_s / 1e9
        self._reference: tuple[int, int] | None = None  # arrival, total: of the first

    def __call__(self, value: int, arrival_ns: int) -> int:
        """The total that is `value` modulo `modulus` and nearest to what the host's clock expects: one
        wrong value does not put all later ones wrong."""
        if self._reference is None:
            self._reference = (arrival_ns, value)
        first_ns, first = self._reference
        expected = first + (arrival_ns - first_ns) * self._ticks_per_ns
        total = value + self._modulus * round((expected - value) / self._modulus)
        # Moved on now and then, so that the clocks' drift never adds up to half a turn of the counter.
        if abs(total - expected) < 0.01 * self._modulus:
            self._reference = (arrival_ns, total)
        return total


def sample_times_s(last_s: float, step_s: float, count: int) -> np.ndarray:
    """Times float64 [count] of measurements `step_s` apart, the last at `last_s`."""
    return last_s - step_s * np.arange(count - 1, -1, -1, dtype=np.float64)
