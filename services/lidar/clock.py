"""Conversion of device times to host times, over a link whose delay varies and is never negative."""

from __future__ import annotations

from collections import deque

import numpy as np

_WINDOW = 400  # packets, i.e. seconds: the drift of the two clocks stays below a millisecond
_EARLY_NS = 5_000_000  # a packet that arrives this much earlier than the least delayed one has a wrong time
_LATE_NS = 2_000_000_000  # a delay beyond this is a wrong time, not a delay
_RESET_AFTER = 8  # rejected packets in a row: the device's clock has changed, estimate anew


class DeviceClock:
    """Estimator of the clock offset: the minimum of (arrival time - device time) over the newest packets.

    Buffers, USB frames and a busy host delay packets, so the packet with the least delay has the best offset.
    Old packets leave the window, so the estimate follows the drift between the clocks (up to 100 ppm).
    Packets whose device time differs too much from the prediction have a wrong byte in their time and are
    rejected.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[int, int]] = (
            deque()
        )  # (packet number, offset ns), increasing: monotonic minimum queue
        self._count = 0
        self._rejected = 0
        self._newest_ns = 0

    def update(self, device_s: float, arrival_ns: int) -> bool:
        """Add a packet to the estimate; return False if its time is implausible and was rejected.

        Args:
            device_s: device time of the packet's last measurement.
            arrival_ns: host time of arrival minus the transmission time.
        """
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
        """Return the host time (ns) of a device time; strictly greater than all times returned before.

        Raises:
            ValueError: no packet was added yet.
        """
        if not self._offsets:
            raise ValueError("the device clock needs a packet before it can convert times")
        stamp = self._offsets[0][1] + round(device_s * 1e9)
        self._newest_ns = max(stamp, self._newest_ns + 1)
        return self._newest_ns

    def reset(self) -> None:
        """Discard the estimate after a restart of the device. Returned times remain increasing."""
        self._offsets.clear()
        self._rejected = 0


class CounterUnwrapper:
    """Converts a counter that wraps at `modulus` to a total that does not wrap, using the host's clock."""

    def __init__(self, modulus: int, ticks_per_s: float) -> None:
        self._modulus = modulus
        self._ticks_per_ns = ticks_per_s / 1e9
        self._reference: tuple[int, int] | None = None  # (arrival ns, total)

    def __call__(self, value: int, arrival_ns: int) -> int:
        """Return the total number of ticks for the counter value `value`, received at host time `arrival_ns`.

        The total equals `value` modulo `modulus` and is the one nearest to the total predicted from the
        host's clock. Therefore one wrong value does not shift later totals.
        """
        if self._reference is None:
            self._reference = (arrival_ns, value)
        first_ns, first = self._reference
        expected = first + (arrival_ns - first_ns) * self._ticks_per_ns
        total = value + self._modulus * round((expected - value) / self._modulus)
        # Move the reference, so that the clocks' drift never adds up to half a period of the counter.
        if abs(total - expected) < 0.01 * self._modulus:
            self._reference = (arrival_ns, total)
        return total


def sample_times_s(last_s: float, step_s: float, count: int) -> np.ndarray:
    """Return the times (s), float64 [count], of measurements that are `step_s` apart and end at `last_s`."""
    return last_s - step_s * np.arange(count - 1, -1, -1, dtype=np.float64)
