"""Files of the keyframe outbox, one per keyframe, which remain complete after a crash or a power failure.

    "BSK1" | uint32 head length | head (msgpack map: key, drive, view, size, schema, hash) | payload

The hash (xxh64) is computed over the payload; a truncated or damaged head cannot be unpacked. Files are
written atomically, so that only a faulty disk causes corrupt files. Corrupt files are logged, counted and
removed.
"""

from __future__ import annotations

import contextlib
import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgpack
import numpy as np
import xxhash

from beamsplat.common.errors import reason
from beamsplat.common.files.persist import make_folder_if_possible, write_atomically

log = logging.getLogger("beamsplat.keyframes")

_MAGIC = b"BSK1"
_LENGTH = struct.Struct("<I")
_MAX_HEAD = 65536  # bytes
_SUFFIX = ".keyframe"
_FIRST_SCHEMA = "Keyframe/1.2"  # of the files of programs that did not write a schema


class CorruptFile(ValueError):
    """A file whose content differs from the content that was written."""


@dataclass(frozen=True)
class QueueEntry:
    """Metadata of a keyframe in the outbox."""

    key: int
    drive: str  # to whose anchors it belongs
    view: tuple[float, ...]  # position and viewing direction, see `beamsplat.services.keyframes.outbox`
    size: int  # bytes of the payload
    schema: str = _FIRST_SCHEMA  # name and version of the message


class QueueFolder:
    """Folder with one file per keyframe. Corrupt files are removed; `corrupt` counts them.

    Files that the disk cannot read stay: they are read again after a restart; `unreadable` counts them.
    """

    def __init__(self, path: Path) -> None:
        """Create the folder if missing; on a full or read-only disk, `write` creates it later.

        Raises:
            UserError: the folder cannot be created for another reason.
        """
        self.path = path.expanduser()
        self.corrupt = self.unreadable = 0
        self._unremoved: set[Path] = set()  # files whose removal the disk refused
        self.fault = make_folder_if_possible(self.path)  # why keyframes cannot be written; "" = they can
        if self.fault:
            log.error("%s cannot be created (%s): keyframes are kept in memory", self.path, self.fault)

    def entries(self) -> Iterator[QueueEntry]:
        """Yield the metadata of all keyframes, oldest first; remove files that a crash left incomplete."""
        try:
            leftovers = list(self.path.glob(f".*{_SUFFIX}.*"))
            files = sorted(self.path.glob(f"*{_SUFFIX}"))
        except OSError as error:
            self._count_unreadable(self.path, error)
            return
        for leftover in leftovers:
            with contextlib.suppress(OSError):
                leftover.unlink()
        for file in files:
            try:
                with file.open("rb") as opened:
                    entry, start = _read_head(opened.read(_MAX_HEAD))
                    whole = start + entry.size == file.stat().st_size
                if not whole or file != self._file(entry.key):
                    raise CorruptFile("is truncated, or has the name of another key")
            except CorruptFile as error:
                self._discard(file, error)
            except OSError as error:
                self._count_unreadable(file, error)
            else:
                yield entry

    def write(self, entry: QueueEntry, payload: bytes) -> None:
        """Write a keyframe atomically; remove the files whose removal failed before.

        Raises:
            OSError: the disk is full or not writable.
        """
        head = msgpack.packb({
            "key": entry.key, "drive": entry.drive, "view": list(entry.view), "size": len(payload),
            "schema": entry.schema, "hash": xxhash.xxh64_digest(payload),
        })  # fmt: skip
        try:
            write_atomically(self._file(entry.key), _MAGIC + _LENGTH.pack(len(head)) + head + payload)
        except OSError as error:
            self.fault = reason(error)
            raise
        self.fault = ""
        self._unremoved.discard(self._file(entry.key))
        for file in list(self._unremoved):
            self._unlink(file)

    def read(self, key: int) -> bytes | None:
        """Return the payload; None if the file is corrupt or cannot be read, which is logged and counted."""
        file = self._file(key)
        try:
            data = file.read_bytes()
            entry, start = _read_head(data)
            payload = data[start:]
            if len(payload) != entry.size or xxhash.xxh64_digest(payload) != _hash_of(data):
                raise CorruptFile("does not match its checksum")
        except CorruptFile as error:
            self._discard(file, error)
            return None
        except OSError as error:
            self._count_unreadable(file, error)
            return None
        return payload

    def remove(self, key: int) -> None:
        """Remove the file of a keyframe; if the disk refuses, after the next keyframe that it accepts."""
        self._unlink(self._file(key))

    def _unlink(self, file: Path) -> None:
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            if file not in self._unremoved:
                log.warning("%s cannot be removed: %s", file, error.strerror)
            self._unremoved.add(file)
        else:
            self._unremoved.discard(file)

    def _file(self, key: int) -> Path:
        return self.path / f"{key:020d}{_SUFFIX}"

    def _count_unreadable(self, file: Path, error: OSError) -> None:
        self.unreadable += 1
        log.warning("%s cannot be read: %s", file, error.strerror)

    def _discard(self, file: Path, error: Exception) -> None:
        self.corrupt += 1
        log.warning("%s is unusable and is removed: %s", file, error)
        self._unlink(file)


def _head_of(data: bytes) -> tuple[dict, int]:
    if data[:4] != _MAGIC or len(data) < 8:
        raise CorruptFile("is not a keyframe file")
    (length,) = _LENGTH.unpack_from(data, 4)
    if length > _MAX_HEAD - 8 or 8 + length > len(data):
        raise CorruptFile("is truncated")
    try:
        head = msgpack.unpackb(data[8 : 8 + length])
    except (ValueError, msgpack.UnpackException) as error:
        raise CorruptFile(f"its head cannot be unpacked: {error}") from error
    if not isinstance(head, dict):
        raise CorruptFile("its head is not a map")
    return head, 8 + length


def _hash_of(data: bytes) -> bytes:
    return _head_of(data)[0]["hash"]


def _read_head(data: bytes) -> tuple[QueueEntry, int]:
    head, start = _head_of(data)
    try:
        view = tuple(float(value) for value in head["view"])
        schema = str(head.get("schema", _FIRST_SCHEMA))
        entry = QueueEntry(int(head["key"]), str(head["drive"]), view, int(head["size"]), schema)
        usable = entry.key >= 0 and np.isfinite(view).all() and isinstance(head["hash"], bytes)
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptFile(f"its head lacks {error}") from error
    if not usable:
        raise CorruptFile("its head has invalid values")
    return entry, start
