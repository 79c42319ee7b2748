"""Keeps a lidar open: starts it, reads it, opens it again when it goes, and says how it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from beamsplat.services.lidar.driver import Driver
from beamsplat.services.lidar.link import Link, LinkError
from beamsplat.services.lidar.samples import StampedScan

_POLL_S = 0.1
_RETRY_S = 0.25  # a device that is plugged in again is found within this
_NO_SCAN_S = 5.0  # bytes that never make a turn: wrong device, wrong baud rate, or a motor that stands


class Reader:
    """Scans of one device, for ever; `status` is one line about it."""

    def __init__(
        self,
        make_driver: Callable[[], Driver],
        open_at: Callable[[int], Link],  # by baud rate
        bauds: tuple[int, ...],
        now_ns: Callable[[], int],
    ) -> None:
        self.driver = make_driver()
        self._open_at = open_at
        self._bauds = bauds or self.driver.bauds
        self._baud = 0  # index of the one that answered last
        self._now_ns = now_ns
        self._link: Link | None = None
        self.status = "not opened yet"
        self.reconnects = -1

    def scans(self) -> Iterator[StampedScan | None]:
        """Scans as they are complete; None whenever nothing has come for a moment."""
        while True:
            if self._link is None and not self._open():
                yield None
                time.sleep(_RETRY_S)
                continue
            try:
                yield from self._read()
            except LinkError as error:
                self.status = f"LOST: {error}; {self.driver.counters}"
                self._drop()

    def close(self) -> None:
        """Stops the device and lets go of it."""
        if self._link is not None:
            with suppress(OSError):
                self.driver.stop(self._link)
            self._drop()

    def _open(self) -> bool:
        """Tries one baud rate; the next call tries the next."""
        baud = self._bauds[self._baud]
        link = None
        try:
            link = self._open_at(baud)
            self.driver.start(link)
        except LinkError as error:
            self.status = f"NOT THERE: {error}"
            if link is not None:  # somebody is there, but at another rate
                link.close()
                self._baud = (self._baud + 1) % len(self._bauds)
            return False
        self._link = link
        self.reconnects += 1
        return True

    def _read(self) -> Iterator[StampedScan | None]:
        heard = scanned = time.monotonic()
        while True:
            data = self._link.read(_POLL_S)
            at_ns, now = self._now_ns(), time.monotonic()
            if data:
                heard = now
                found = self.driver.feed(data, at_ns)
                if found:
                    scanned = now
                self._describe()
                yield from found or (None,)
            else:
                yield None
            if now - heard > self.driver.silence_s:
                raise LinkError("it has fallen silent")
            if now - scanned > _NO_SCAN_S:
                self._baud = (self._baud + 1) % len(self._bauds)
                raise LinkError(f"{_NO_SCAN_S:g} s without a whole turn: is this the right kind and baud?")

    def _describe(self) -> None:
        noise = ", NOISY LINK" if self.driver.noise.noisy else ""
        again = f", opened again {self.reconnects} times" if self.reconnects else ""
        self.status = f"{self.driver.model}: {self.driver.counters}{noise}{again}"

    def _drop(self) -> None:
        if self._link is not None:
            self._link.close()
        self._link = None
