"""Hokuyo's SCIP 2.x: commands, number encoding, and scans as replies of fixed layout.

Hokuyo, "Communication Protocol Specification For SCIP2.0 Standard", C-42-03320B; SCIP 2.2 (UST, UXM) keeps
commands and encoding. A reply to MD (distances) or ME (with intensities) is

    echo LF "99b" LF time(4) sum LF { up to 64 characters, sum LF } LF

so each block of 64 characters has its own checksum of six bits. A block with a wrong byte invalidates the
ranges that it contains, not the whole scan.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

BLOCK = 64  # characters before each checksum (SCIP 2.0, section 7)
_OFFSET = 0x30  # of the characters that encode six bits (section 6)
_MIN_HEADER_MATCH = 0.7  # ratio of a reply's header bytes that must match


def checksum(text: bytes) -> int:
    """Return the checksum character of a line: the lower six bits of its byte sum, plus 30H (section 7)."""
    return (sum(text) & 0x3F) + _OFFSET


def decode(text: bytes) -> int:
    """Return the number in 2, 3 or 4 characters of six bits each, most significant first (section 6)."""
    value = 0
    for character in text:
        value = value << 6 | (character - _OFFSET) & 0x3F
    return value


def parameters(reply: bytes) -> dict[str, str]:
    """Return name -> value of the lines `NAME:value;s` with correct checksum s of a PP, VV or II reply."""
    found = {}
    for line in reply.split(b"\n"):
        body, semicolon, tail = line.rpartition(b";")
        if semicolon and len(tail) == 1 and checksum(body) == tail[0] and b":" in body:
            name, _, value = body.partition(b":")
            found[name.decode("ascii", "replace")] = value.decode("ascii", "replace")
    return found


class ScipGeometry(NamedTuple):
    """Scan geometry from the device (reply to PP): measured steps, resolution, range limits, period."""

    model: str
    range_min_m: float
    range_max_m: float
    steps_per_turn: int
    first_step: int
    last_step: int
    front_step: int
    period_s: float

    @staticmethod
    def from_parameters(values: dict[str, str]) -> ScipGeometry:
        """Return the geometry from the lines of a PP reply.

        Raises:
            ValueError: a line is missing, is no number, or is out of range.
        """
        names = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
        missing = [name for name in names if name not in values]
        if missing:
            raise ValueError(f"the reply to PP lacks {', '.join(missing)}")
        dmin, dmax, ares, amin, amax, afrt, rpm = (int(values[name]) for name in names)
        if not (ares > 0 and 0 <= amin < amax and rpm > 0 and 0 <= dmin < dmax):
            raise ValueError(f"the reply to PP has invalid values: {values}")
        return ScipGeometry(
            values.get("MODL", "Hokuyo").partition("(")[0], dmin / 1e3, dmax / 1e3, ares, amin, amax, afrt,
            60.0 / rpm,
        )  # fmt: skip

    @property
    def count(self) -> int:  # type: ignore[override]  # hides tuple.count, which nothing needs
        """Return the number of measurements of a scan."""
        return self.last_step - self.first_step + 1


class ScipScanReply:
    """Decoder of the replies to one continuous MD or ME command."""

    def __init__(self, geometry: ScipGeometry, intensity: bool) -> None:
        self.geometry = geometry
        self._per_step = 6 if intensity else 3
        name = b"ME" if intensity else b"MD"
        # Cluster 1, interval 0, number of scans 00 (until stopped); every reply echoes the command.
        self.command = b"%s%04d%04d01000" % (name, geometry.first_step, geometry.last_step)
        self._head = self.command + b"\n99b\n"
        self._characters = geometry.count * self._per_step
        blocks = -(-self._characters // BLOCK)
        self._time_at = len(self._head)
        self._data_at = self._time_at + 6
        self.length = self._data_at + self._characters + 2 * blocks + 1

    def has_header(self, reply: bytes) -> bool:
        """Return whether a reply starts with the expected header; a few wrong bytes are tolerated."""
        same = sum(a == b for a, b in zip(self._head, reply))
        return same >= _MIN_HEADER_MATCH * len(self._head)

    def time_ms(self, reply: bytes) -> int | None:
        """Return the time (ms) of the device's 24 bit clock; None if the checksum of the time is wrong."""
        line = reply[self._time_at : self._data_at]
        good = _characters(line[:4]) and checksum(line[:4]) == line[4] and line[5] == 0x0A
        return decode(line[:4]) if good else None

    def values(self, reply: bytes) -> tuple[np.ndarray, np.ndarray, int, int]:
        """Decode one reply of `length` bytes.

        Returns:
            range_m float64 [N], NaN = none; intensity float64 [N]; number of blocks; number of damaged
            blocks.
        """
        characters = np.zeros(self._characters, np.uint8)
        good = np.zeros(self._characters, dtype=bool)
        at, done, blocks, bad = self._data_at, 0, 0, 0
        while done < self._characters:
            size = min(BLOCK, self._characters - done)
            block = reply[at : at + size]
            blocks += 1
            if _characters(block) and reply[at + size] == checksum(block) and reply[at + size + 1] == 0x0A:
                characters[done : done + size] = np.frombuffer(block, np.uint8) - _OFFSET
                good[done : done + size] = True
            else:
                bad += 1
            done, at = done + size, at + size + 2
        six = characters.reshape(-1, self._per_step).astype(np.int64)
        whole = good.reshape(-1, self._per_step).all(axis=1)
        mm = six[:, 0] << 12 | six[:, 1] << 6 | six[:, 2]
        # Values below DMIN are error codes; values beyond DMAX are outside the specified range.
        low, high = self.geometry.range_min_m * 1e3, self.geometry.range_max_m * 1e3
        valid = whole & (mm >= max(low, 1.0)) & (mm <= high)
        light = np.zeros(len(mm))
        if self._per_step == 6:
            light = np.where(whole, six[:, 3] << 12 | six[:, 4] << 6 | six[:, 5], 0).astype(np.float64)
        return np.where(valid, mm / 1e3, np.nan), light, blocks, bad


def _characters(text: bytes) -> bool:
    """Return whether all characters are in 30H to 6FH, the range that encodes six bits."""
    return not text.translate(None, _SIX_BITS)


_SIX_BITS = bytes(range(_OFFSET, _OFFSET + 64))
