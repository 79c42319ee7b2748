"""Base class of lidar drivers: converts samples to stamped revolutions; monitors noise and device clock."""

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

_SPANS = 31  # packet-to-packet angles over which the median is taken
_MIN_SPANS = 8  # of them needed before packets are checked
_TOLERANCE_DEG = 0.3  # rounding, and the variation of the motor's speed within a packet
_TOLERANCE_RATIO = 0.02  # of the predicted angle: slower changes of the motor's speed
_RESET_AFTER = 6  # rejected packets in a row: the motor's speed has changed, estimate anew


class LidarDriver(ABC):
    """Base class of a lidar's protocol: `start` configures the device, `feed` decodes received bytes."""

    bauds: tuple[int, ...] = (115200,)
    clockwise = True
    silence_s = 1.0  # without a byte for so long: reconnect

    def __init__(self, *, no_checksum: bool = False) -> None:
        """Create the driver. `no_checksum`: packets have no checksum, so ranges must always be confirmed."""
        self.counters = StreamCounters()
        self.noise = LinkNoise(always=no_checksum)
        self.clock = DeviceClock()
        self.range_min_m = 0.05
        self.range_max_m = 40.0
        self.model = ""
        self.builder = RevolutionBuilder(self.counters, clockwise=self.clockwise)

    @abstractmethod
    def start(self, link: DeviceLink) -> None:
        """Identify the device and start its measurement stream.

        Raises:
            LinkError: no device of this kind answers.
        """

    @abstractmethod
    def feed(self, data: bytes, at_ns: int) -> list[StampedScan]:
        """Decode `data`, received at host time `at_ns`; return the revolutions that are now complete."""

    def stop(self, link: DeviceLink) -> None:  # noqa: B027 (most devices need nothing)
        """Stop the measurement stream, if the device has a command for this."""

    def reset(self) -> None:
        """Discard incomplete data after the link was reopened."""
        self.builder.reset()
        self.clock.reset()

    def stamp_revolutions(self, samples: Iterable[Samples]) -> list[StampedScan]:
        """Return the revolutions that `samples` complete, with stamps on the host's clock."""
        found = []
        for part in samples:
            for turn in self.builder.add(part, self.noise.noisy):
                stamp_ns = self.clock.stamp_ns(turn.time_s)
                found.append(StampedScan(stamp_ns, turn, self.range_min_m, self.range_max_m))
        return found


class StartAngleGate:
    """Check of a packet's start angle against the angle predicted from earlier packets.

    A wrong byte in the start angle would rotate all ranges of the packet. The motor's speed is nearly
    constant, so the start angle can be predicted.
    """

    def __init__(self) -> None:
        self._spans: deque[float] = deque(maxlen=_SPANS)
        self._last_start_deg: float | None = None
        self._skipped = 0
        self._rejected = 0

    @property
    def median_step_deg(self) -> float | None:
        """Return the median angle between the starts of consecutive packets; None for too few packets."""
        return float(np.median(self._spans)) if len(self._spans) >= _MIN_SPANS else None

    def skip_packets(self, slots: int = 1) -> None:
        """Add `slots` packets that are missing or damaged, so that the next prediction includes them."""
        self._skipped += slots

    def accepts(self, start_deg: float) -> bool:
        """Return whether a packet's start angle agrees with the prediction."""
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
