"""A state on disk: its arrays in a numbered file, and a manifest (JSON) that names the valid file.

A state is written to a file with a new number, then the manifest is replaced, then the older files are
removed. So a crash, a full disk or an error at any moment leaves a manifest that names a complete file.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import sync_folder, write_durably

Arrays = dict[str, np.ndarray]
_T = TypeVar("_T")
_MAX_READS = 5  # attempts to read a state while another process replaces it
_BLOCK_BYTES = 1 << 20
# Exceptions that NumPy and zipfile raise on a damaged file.
_DAMAGE = (
    OSError, ValueError, KeyError, EOFError, RuntimeError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


@dataclass(frozen=True)
class NumberedState:
    """The files of one state: `<prefix><number>.npz` and the manifest. One process at a time may write."""

    folder: Path
    prefix: str
    manifest_name: str
    field: str  # of the manifest, that contains the name of the valid file

    @property
    def manifest_path(self) -> Path:
        return self.folder / self.manifest_name

    def write(self, arrays: Arrays, entries: dict[str, Any]) -> None:
        """Write a new state, then the manifest that names it, then remove the files of older states.

        Args:
            arrays: the state, array by name.
            entries: further entries of the manifest.

        Raises:
            OSError: the disk is full or broken. The manifest names the new or the previous state, and both
                files exist.
        """
        before = numbered_files(self.folder, self.prefix, ".npz")
        number = 1 + max(before, default=0)
        while (self.folder / self._name(number)).exists():  # a folder of this name
            number += 1
        name = self._name(number)
        path = self.folder / name
        with path.open("xb") as file:  # closed twice: an error of the first must lead to the removal below
            try:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # the stubs pass ** to allow_pickle
                file.flush()
                os.fsync(file.fileno())
                file.close()
                with path.open("rb") as written:
                    size, checksum = _size_and_checksum(written)
                sync_folder(self.folder)  # a power failure must not leave a manifest without its file
                write_json(
                    self.manifest_path, {**entries, self.field: name, "bytes": size, "crc32": checksum}
                )
            except BaseException:
                if not self._may_name(name):
                    with contextlib.suppress(OSError):
                        path.unlink()
                raise
        temporary = self.folder.glob(f".{self.manifest_name}.*")  # of killed processes
        for old in [*before.values(), *temporary]:
            with contextlib.suppress(OSError):  # removed after the next state
                old.unlink()

    def _name(self, number: int) -> str:
        return f"{self.prefix}{number}.npz"

    def _may_name(self, name: str) -> bool:
        """Return whether the manifest names a file; True if the manifest cannot be read."""
        try:
            table = json.loads(self.manifest_path.read_bytes())
        except FileNotFoundError:
            return False
        except (OSError, ValueError):
            return True
        return not isinstance(table, dict) or table.get(self.field) == name

    def manifest(self, check: Callable[[dict[str, Any], Path], None]) -> dict[str, Any]:
        """Return the contents of the manifest.

        Args:
            check: is called with the contents and the path; raises UserError if this program cannot use them.

        Raises:
            UserError: the manifest is missing, damaged or incomplete, or `check` raised it.
        """
        path = self.manifest_path
        table = read_json(path, "restore the folder from a copy")
        check(table, path)
        for field, kind in ((self.field, str), ("bytes", int)):
            if not isinstance(table.get(field), kind):
                raise UserError(f"{path}: field {field!r} is missing; restore the folder from a copy")
        return table

    def read(
        self,
        check: Callable[[dict[str, Any], Path], None],
        unpack: Callable[[dict[str, Any], Arrays], _T],
    ) -> _T:
        """Return the valid state, also while another process replaces it.

        Args:
            check: see `manifest`.
            unpack: converts manifest and arrays to the result; raises UserError if they are unusable.

        Raises:
            UserError: the manifest or its file is missing, truncated, altered or unusable.
        """
        for _ in range(_MAX_READS):
            manifest = self.manifest(check)
            try:
                return unpack(manifest, self._arrays(manifest))
            except UserError:
                if self.manifest(check) == manifest:
                    raise
        raise UserError(f"{self.folder}: the state changes faster than it can be read; try again")

    def _arrays(self, manifest: dict[str, Any]) -> Arrays:
        path = self.folder / Path(manifest[self.field]).name
        try:
            with path.open("rb") as file:
                size, checksum = _size_and_checksum(file)
                if size != manifest["bytes"] or checksum != manifest.get("crc32", checksum):
                    raise UserError(
                        f"{path}: truncated or altered ({size} bytes, {manifest['bytes']} expected); "
                        "restore it from a copy"
                    )
                file.seek(0)
                return unpacked_arrays(file)
        except UserError:
            raise
        except _DAMAGE as error:
            raise UserError(
                f"{path}: cannot be read, but {self.manifest_path} needs it ({reason(error)}); restore it "
                "from a copy"
            ) from error


def packed_arrays(arrays: Arrays) -> bytes:
    """Return arrays as the bytes of an npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # the stubs pass ** to allow_pickle
    return buffer.getvalue()


def unpacked_arrays(source: bytes | BinaryIO) -> Arrays:
    """Return the arrays in an npz file (inverse of `packed_arrays`).

    Compressed arrays are refused: kilobytes of them can expand to gigabytes, and `packed_arrays` writes none.

    Raises:
        OSError, ValueError, zipfile.BadZipFile, zlib.error: the file is incomplete, damaged or compressed.
    """
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    with zipfile.ZipFile(file) as members:
        for member in members.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{member.filename} is compressed: its size in memory is not bounded")
    file.seek(0)
    try:
        with np.load(file, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except (MemoryError, EOFError, TypeError, AttributeError) as error:  # of a damaged header of an array
        raise ValueError(f"not an npz file: {reason(error)}") from error


def numbered_files(folder: Path, prefix: str, suffix: str) -> dict[int, Path]:
    """Return the files `<prefix><number><suffix>` of a folder by number (an int64 >= 0).

    All other files are left alone: copies made by hand (`state-old.npz`), numbers in another form (`007.kf`),
    folders.
    """
    out = {}
    for path in folder.glob(f"{prefix}*{suffix}"):
        digits = path.name.removeprefix(prefix).removesuffix(suffix)
        if not (digits.isascii() and digits.isdecimal() and path.is_file()):
            continue
        number = int(digits)
        if str(number) == digits and number < 2**63:
            out[number] = path
    return out


def write_json(path: Path, table: dict[str, Any]) -> None:
    """Replace a JSON file atomically and durably."""
    write_durably(path, (json.dumps(table, indent=1) + "\n").encode())


def read_json(path: Path, advice: str) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        UserError: the file is missing or not a JSON object; the text ends with `advice`.
    """
    try:
        table = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({reason(error)}); {advice}") from error
    if not isinstance(table, dict):
        raise UserError(f"{path}: not a JSON object; {advice}")
    return table


def _size_and_checksum(file: BinaryIO) -> tuple[int, int]:
    """Return the number of bytes of a file and their CRC-32, read in blocks to need little memory."""
    size = checksum = 0
    while block := file.read(_BLOCK_BYTES):
        size += len(block)
        checksum = zlib.crc32(block, checksum)
    return size, checksum
