"""Keyframes as files, one each: what the robot still has after a crash or an empty battery.

    "BSK1" | uint32 head length | head (msgpack map: key, drive, view, size, hash) | payload

The hash (xxh64) is over the payload; a head that is cut or wrong does not unpack. A file appears whole or
not at all, so only a failing disk makes broken ones: they are said, counted and removed.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack
import numpy as np
import xxhash

from beamsplat.common.files.persist import make_folder, write_atomically

log = logging.getLogger("beamsplat.keyframes")

_MAGIC = b"BSK1"
_LENGTH = struct.Struct("<I")
_MAX_HEAD = 65536
_SUFFIX = ".keyframe"


class BrokenFile(ValueError):
    """A file that is not, or no longer, what was written."""


@dataclass(frozen=True)
class Label:
    """What is known of a keyframe without opening its payload."""

    key: int
    drive: str  # whose anchors it hangs on
    view: tuple[float, ...]  # place and direction, see `beamsplat.services.keyframes.outbox`
    size: int  # bytes of the payload


class Folder:
    """One file a key. Files that cannot be used are removed; `broken` counts them."""

    def __init__(self, path: Path) -> None:
        """Raises UserError where the folder cannot be made."""
        self.path = make_folder(path.expanduser())
        self.broken = 0

    def labels(self) -> Iterator[Label]:
        """What lies here, oldest key first; what a crash left half written is cleared away."""
        for leftover in self.path.glob(f".*{_SUFFIX}.*"):
            leftover.unlink(missing_ok=True)
        for file in sorted(self.path.glob(f"*{_SUFFIX}")):
            try:
                with file.open("rb") as opened:
                    label, start = _read_head(opened.read(_MAX_HEAD))
                    whole = start + label.size == file.stat().st_size
                if not whole or file != self._file(label.key):
                    raise BrokenFile("is cut off, or under another's name")
            except (OSError, BrokenFile) as error:
                self._discard(file, error)
            else:
                yield label

    def write(self, label: Label, payload: bytes) -> None:
        """Raises OSError: the disk is full, or not writable."""
        head = msgpack.packb({
            "key": label.key, "drive": label.drive, "view": list(label.view), "size": len(payload),
            "hash": xxhash.xxh64_digest(payload),
        })  # fmt: skip
        write_atomically(self._file(label.key), _MAGIC + _LENGTH.pack(len(head)) + head + payload)

    def read(self, key: int) -> bytes | None:
        """The payload; None if it is broken or gone, which is said and counted."""
        file = self._file(key)
        try:
            data = file.read_bytes()
            label, start = _read_head(data)
            payload = data[start:]
            if len(payload) != label.size or xxhash.xxh64_digest(payload) != _hash_of(data):
                raise BrokenFile("does not match its checksum")
        except (OSError, BrokenFile) as error:
            self._discard(file, error)
            return None
        return payload

    def remove(self, key: int) -> None:
        """Frees the disk; what cannot be removed now comes up again after a restart."""
        try:
            self._file(key).unlink(missing_ok=True)
        except OSError as error:
            log.warning("%s cannot be removed: %s", self._file(key), error.strerror)

    def _file(self, key: int) -> Path:
        return self.path / f"{key:020d}{_SUFFIX}"

    def _discard(self, file: Path, error: Exception) -> None:
        self.broken += 1
        log.warning("%s is lost: %s", file, error)
        try:
            file.unlink(missing_ok=True)
        except OSError as other:
            log.warning("%s cannot be removed either: %s", file, other.strerror)


def _head_of(data: bytes) -> tuple[dict, int]:
    if data[:4] != _MAGIC or len(data) < 8:
        raise BrokenFile("does not begin as a keyframe does")
    (length,) = _LENGTH.unpack_from(data, 4)
    if length > _MAX_HEAD - 8 or 8 + length > len(data):
        raise BrokenFile("is cut off")
    try:
        head = msgpack.unpackb(data[8 : 8 + length])
    except (ValueError, msgpack.UnpackException) as error:
        raise BrokenFile(f"its head does not unpack: {error}") from error
    if not isinstance(head, dict):
        raise BrokenFile("its head is no map")
    return head, 8 + length


def _hash_of(data: bytes) -> bytes:
    return _head_of(data)[0]["hash"]


def _read_head(data: bytes) -> tuple[Label, int]:
    head, start = _head_of(data)
    try:
        view = tuple(float(value) for value in head["view"])
        label = Label(int(head["key"]), str(head["drive"]), view, int(head["size"]))
        usable = label.key >= 0 and np.isfinite(view).all() and isinstance(head["hash"], bytes)
    except (KeyError, TypeError, ValueError) as error:
        raise BrokenFile(f"its head lacks {error}") from error
    if not usable:
        raise BrokenFile("its head makes no sense")
    return label, start
