"""Reader of a lidar: starts the device, reads it, reconnects after a failure, and reports the status."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from beamsplat.services.lidar.driver import LidarDriver
from beamsplat.services.lidar.link import DeviceLink, LinkError
from beamsplat.services.lidar.samples import StampedScan

_POLL_S = 0.1
_RETRY_S = 0.25  # between attempts to open the device
_NO_SCAN_S = 5.0  # bytes without a revolution: wrong device, wrong baud rate, or the motor does not turn


class LidarReader:
    """Yields the scans of one device without end; `status` is one line of text."""

    def __init__(
        self,
        make_driver: Callable[[], LidarDriver],
        open_at: Callable[[int], DeviceLink],  # opens the device at a baud rate
        bauds: tuple[int, ...],
        now_ns: Callable[[], int],
    ) -> None:
        self.driver = make_driver()
        self._open_at = open_at
        self._bauds = bauds or self.driver.bauds
        self._baud = 0  # index of the rate to try
        self._now_ns = now_ns
        self._link: DeviceLink | None = None
        self.status = "not opened yet"
        self.reconnects = -1

    def scans(self) -> Iterator[StampedScan | None]:
        """Yield each scan when it is complete; None if no data arrived for a short time."""
        while True:
            if self._link is None and not self._open():
                yield None
                time.sleep(_RETRY_S)
                continue
            try:
                yield from self._read()
            except LinkError as error:
                self.status = f"DISCONNECTED: {error}; {self.driver.counters}"
                self._close_link()
                yield None  # before the pause: a device that can be opened may fail again at once
                time.sleep(_RETRY_S)

    def close(self) -> None:
        """Stop the device and close the link."""
        if self._link is not None:
            with suppress(OSError):
                self.driver.stop(self._link)
            self._close_link()

    def _open(self) -> bool:
        """Try to open the device at one baud rate; after a failure, the next call tries the next rate."""
        baud = self._bauds[self._baud]
        link = None
        try:
            link = self._open_at(baud)
            self.driver.start(link)
        except LinkError as error:
            self.status = f"NOT CONNECTED: {error}"
            if link is not None:  # the port exists, but the device may use another rate
                link.close()
                self._baud = (self._baud + 1) % len(self._bauds)
            return False
        self._link = link
        self.reconnects += 1
        return True

    def _read(self) -> Iterator[StampedScan | None]:
        last_data_s = last_scan_s = time.monotonic()
        link = self._link
        assert link is not None  # opened by `scans`
        while True:
            data = link.read(_POLL_S)
            at_ns, now = self._now_ns(), time.monotonic()
            if data:
                last_data_s = now
                found = self.driver.feed(data, at_ns)
                if found:
                    last_scan_s = now
                self._update_status()
                yield from found or (None,)
            else:
                yield None
            if now - last_data_s > self.driver.silence_s:
                raise LinkError(f"no data for {self.driver.silence_s:g} s")
            if now - last_scan_s > _NO_SCAN_S:
                self._baud = (self._baud + 1) % len(self._bauds)
                raise LinkError(f"no complete revolution for {_NO_SCAN_S:g} s: check `kind` and `baud`")

    def _update_status(self) -> None:
        noise = ", NOISY LINK" if self.driver.noise.noisy else ""
        again = f", reopened {self.reconnects} times" if self.reconnects else ""
        self.status = f"{self.driver.model}: {self.driver.counters}{noise}{again}"

    def _close_link(self) -> None:
        if self._link is not None:
            self._link.close()
        self._link = None
