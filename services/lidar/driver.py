"""What all drivers share: samples to stamped turns, with the noise of the link and the device's clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable

import numpy as np

from beamsplat.services.lidar.clock import DeviceClock
from beamsplat.services.lidar.framing import StreamCounters
from beamsplat.services.lidar.link import DeviceLink
from beamsplat.services.lidar.range_filter import LinkNoise
from beamsplat.services.lidar.revolution import RevolutionBuilder
from beamsplat.services.lidar.samples import Samples, StampedScan

_SPANS = 31  # spans remembered
_MIN_SPANS = 8  # before the first check
_TOLERANCE_DEG = 0.3  # rounding, and the motor's wobble over a packet
_TOLERANCE_RATIO = 0.02  # of the angle turned
_RESET_AFTER = 6  # packets in a row that do not fit: it is the speed that has changed


class LidarDriver(ABC):
    """One kind of lidar. `start` talks to it, `feed` takes what it says from then on."""

    bauds: tuple[int, ...] = (115200,)
    clockwise = True
    silence_s = 1.0  # without a byte for so long it counts as gone

    def __init__(self, *, no_checksum: bool = False) -> None:
        """`no_checksum`: its packets carry no checksum, so that no single range is believed."""
        self.counters = StreamCounters()
        self.noise = LinkNoise(always=no_checksum)
        self.clock = DeviceClock()
        self.range_min_m = 0.05
        self.range_max_m = 40.0
        self.model = ""
        self.builder = RevolutionBuilder(self.counters, clockwise=self.clockwise)

    @abstractmethod
    def start(self, link: DeviceLink) -> None:
        """Asks who is there and starts the stream.

        Raises:
            LinkError: nobody answers as this kind of device does.
        """

    @abstractmethod
    def feed(self, data: bytes, at_ns: int) -> list[StampedScan]:
        """The turns that `data`, arrived at `at_ns`, completes."""

    def stop(self, link: DeviceLink) -> None:  # noqa: B027 (most devices need nothing)
        """Ends the stream, as far as the device can be told."""

    def reset(self) -> None:
        """Forgets what was under way, when the link has been opened anew."""
        self.builder.reset()
        self.clock.reset()

    def stamp_revolutions(self, samples: Iterable[Samples]) -> list[StampedScan]:
        """Stamped turns out of samples."""
        found = []
        for part in samples:
            for turn in self.builder.add(part, self.noise.noisy):
                stamp_ns = self.clock.stamp_ns(turn.time_s)
                found.append(StampedScan(stamp_ns, turn, self.range_min_m, self.range_max_m))
        return found


class StartAngleGate:
    """Whether a packet begins where its predecessors say that it must.

    A wrong byte in a packet's angle turns all its ranges to a wrong place; the motor's even turning shows it.
    """

    def __init__(self) -> None:
        self._spans: deque[float] = deque(maxlen=_SPANS)
        self._last_start_deg: float | None = None
        self._skipped = 0
        self._rejected = 0

    @property
    def median_step_deg(self) -> float | None:
        """Angle from packet to packet; None while too few have come."""
        return float(np.median(self._spans)) if len(self._spans) >= _MIN_SPANS else None

    def skip_packets(self, slots: int = 1) -> None:
        """Packets that did not come, or were bad."""
        self._skipped += slots

    def accepts(self, start_deg: float) -> bool:
        """Whether a packet that begins there continues what came before."""
        slots, typical = self._skipped + 1, self.median_step_deg
        last_start_deg, self._last_start_deg, self._skipped = self._last_start_deg, start_deg, 0
        if last_start_deg is None:
            return True
        if typical is None:
            if slots == 1:
                self._spans.append((start_deg - last_start_deg) % 360.0)
            return True
        error = abs((start_deg - last_start_deg - slots * typical + 180.0) % 360.0 - 180.0)
        fits = error <= _TOLERANCE_DEG + _TOLERANCE_RATIO * typical * slots
        if fits and slots == 1:
            self._spans.append((start_deg - last_start_deg) % 360.0)
        self._rejected = 0 if fits else self._rejected + 1
        if self._rejected >= _RESET_AFTER:
            self._spans.clear()
            self._rejected = 0
        return fits
