"""The files of a session: manifests (JSON), states (arrays, npz), keyframes (the message bytes as received).

A crash or a full disk at any moment leaves the previous state valid: a manifest is replaced atomically, and
only after all files that it lists are on the disk. One process at a time may write to a session; it holds a
file lock, which the kernel releases when the process ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import uuid
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO

from beamsplat.common.errors import UserError
from beamsplat.common.files.numbered_state import (
    Arrays,
    NumberedState,
    numbered_files,
    packed_arrays,  # noqa: F401
    read_json,
    unpacked_arrays,  # noqa: F401
    write_json,
)
from beamsplat.common.files.persist import write_durably
from beamsplat.common.mapfiles.blocks import block_file, with_blocks

FORMAT, VERSION = "beamsplat-session", 1
EDGE_VERSION = 2  # 2: some Gaussians are in block files; 1 is written when there are none
MANIFEST, EDGE_MANIFEST = "session.json", "edge.json"
_KEYFRAME_MAGIC = b"BSKF"
_KEYFRAME_HEAD = struct.Struct("<4sIH")  # magic, CRC-32 of what follows the header, length of the schema name


class SessionFolder:
    """The folder of one session. Reading needs no lock; call `lock` before writing."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._lock: TextIO | None = None
        self._created = False  # by this object

    @property
    def edge(self) -> Path:
        """Return the folder of the mapper's files."""
        return self.path / "edge"

    @property
    def robot(self) -> Path:
        """Return the folder of the robot's files: lidar map, grid and trajectory."""
        return self.path / "robot"

    @property
    def keyframes(self) -> Path:
        """Return the folder of the keyframe files."""
        return self.edge / "keyframes"

    @property
    def blocks(self) -> Path:
        """Return the folder of the block files (Gaussians)."""
        return self.edge / "gaussians"

    def exists(self) -> bool:
        """Return whether the folder contains a session."""
        return (self.path / MANIFEST).is_file()

    # --- identity and lock ---

    def create(self) -> None:
        """Create the session with a new UUID, unless the folder contains one already.

        Raises:
            UserError: the folder contains a session that cannot be read.
            OSError: the disk is full or broken, or the folder cannot be written.
        """
        for folder in (self.keyframes, self.blocks):
            folder.mkdir(parents=True, exist_ok=True)
        if self.exists():
            self.header()
            return
        self._created = True
        head = {"format": FORMAT, "version": VERSION, "uuid": str(uuid.uuid4())}
        write_json(self.path / MANIFEST, head)

    def header(self) -> dict[str, Any]:
        """Return the contents of `session.json`: format, version and UUID.

        Raises:
            UserError: there is no session, it cannot be read, or a newer program wrote it.
        """
        if not self.path.is_dir():
            raise UserError(f"{self.path}: no such folder; a session is what `mapping.session = DIR` writes")
        head = read_json(self.path / MANIFEST, "a session is a folder written by `mapping.session = DIR`")
        if head.get("format") != FORMAT:
            raise UserError(
                f"{self.path / MANIFEST}: field 'format' is not {FORMAT!r}: this is not a session"
            )
        check_version(head, self.path / MANIFEST)
        if not isinstance(head.get("uuid"), str):
            raise UserError(
                f"{self.path / MANIFEST}: field 'uuid' is missing; restore the folder from a copy"
            )
        return head

    def lock(self, shared: bool = False) -> None:
        """Take the lock until `unlock` or the end of the process: before the state is read, to change it.

        Temporary files of a killed writer are removed.

        Args:
            shared: only exclude writers: for a command that reads state and keyframes.

        Raises:
            UserError: another process holds the lock; the text contains its id and host.
            OSError: the disk is full or broken, or the folder cannot be written.
        """
        file = self._locked_file(shared)
        self._lock = file
        if not file.writable():
            return
        with contextlib.suppress(OSError):  # disk full: the lock is held all the same
            os.ftruncate(file.fileno(), 0)
            os.write(file.fileno(), f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        if not shared:
            self._remove_temporary_files()

    def _locked_file(self, shared: bool) -> TextIO:
        path = self.edge / "lock"
        while True:
            try:
                file = path.open("a+")
            except OSError:
                if not shared:
                    raise
                file = path.open()  # on a disk that is read-only
            try:
                fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
                with contextlib.suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                        return file
                file.close()  # the previous holder removed the file with its empty session
            except BlockingIOError as error:
                file.seek(0)
                holder = file.readline().strip() or "unknown process"
                file.close()
                raise UserError(
                    f"{self.path}: another process uses this session ({holder}): stop it, or use another "
                    "folder"
                ) from error
            except OSError:
                file.close()
                raise

    def _remove_temporary_files(self) -> None:
        for folder in (self.edge, self.keyframes):
            for leftover in folder.glob(".*.*"):
                if leftover.suffix[1:].isdecimal() and leftover.is_file():  # see `write_atomically`
                    with contextlib.suppress(OSError):
                        leftover.unlink()

    @property
    def is_locked(self) -> bool:
        """Return whether this object holds the lock."""
        return self._lock is not None

    def unlock(self) -> None:
        """Release the lock; remove a session that was created here and has remained empty."""
        if self._lock is None:
            return
        with contextlib.suppress(OSError):
            if self._created and not self.robot.exists() and not self._has_map():
                self._remove_empty()
        self._lock.close()
        self._lock = None

    def _has_map(self) -> bool:
        empty = {"lock", self.keyframes.name, self.blocks.name}
        if {path.name for path in self.edge.iterdir()} - empty:
            return True
        folders = (self.keyframes, self.blocks)
        return any(not folder.is_dir() or any(folder.iterdir()) for folder in folders)

    def _remove_empty(self) -> None:
        """Remove the files that `create` and `lock` write, and the folders; anything else stays."""
        (self.edge / "lock").unlink(missing_ok=True)
        (self.path / MANIFEST).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            for folder in (self.keyframes, self.blocks, self.edge, self.path):
                folder.rmdir()

    # --- states ---

    @property
    def _state(self) -> NumberedState:
        return NumberedState(self.edge, "state-", EDGE_MANIFEST, "state")

    def write_state(self, arrays: Arrays, summary: dict[str, Any]) -> None:
        """Write a new state, then the manifest that names it, then remove the old state.

        Args:
            arrays: the state, array by name.
            summary: entries for the manifest, such as the numbers of keyframes and Gaussians.

        Raises:
            OSError: the disk is full or broken; the old or the new state is valid.
        """
        version = EDGE_VERSION if "block_number" in arrays else VERSION
        self._state.write(arrays, {"version": version, **summary})

    def manifest(self) -> dict[str, Any] | None:
        """Return the contents of `edge.json`; None before the first checkpoint.

        Raises:
            UserError: the file cannot be read, or a newer program wrote it.
        """
        self.header()
        return self._state.manifest(_check_edge_version) if self._has_state() else None

    def _has_state(self) -> bool:
        return (self.edge / EDGE_MANIFEST).is_file()

    def read_state(self, whole: bool = True) -> Arrays | None:
        """Return the arrays of the last checkpoint; None before the first one.

        Args:
            whole: also read the Gaussians in block files; otherwise only their descriptions are returned.

        Raises:
            UserError: the state is missing, truncated or altered.
        """
        self.header()
        if not self._has_state():
            return None

        def unpack(_: dict[str, Any], arrays: Arrays) -> Arrays:
            return with_blocks(self.blocks, arrays) if whole else arrays

        return self._state.read(_check_edge_version, unpack)

    # --- keyframes ---

    def write_keyframe(self, id: int, schema: str, payload: bytes) -> None:
        """Write the schema and the payload (bytes as received) of a keyframe message, and flush to the disk.

        Raises:
            OSError: the disk is full or broken.
        """
        name = schema.encode()
        checksum = zlib.crc32(payload, zlib.crc32(name))
        head = _KEYFRAME_HEAD.pack(_KEYFRAME_MAGIC, checksum, len(name))
        write_durably(self._keyframe_file(id), head + name + payload)

    def keyframe_ids(self) -> list[int]:
        """Return the ids of the keyframes on disk, ascending."""
        return sorted(numbered_files(self.keyframes, "", ".kf"))

    def read_keyframe(self, id: int) -> tuple[str, bytes]:
        """Return (schema, payload) of a keyframe.

        Raises:
            UserError: the file is missing or altered.
        """
        path = self._keyframe_file(id)
        try:
            blob = path.read_bytes()
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror})") from error
        if len(blob) >= _KEYFRAME_HEAD.size:
            magic, checksum, length = _KEYFRAME_HEAD.unpack_from(blob)
            body = blob[_KEYFRAME_HEAD.size :]
            if magic == _KEYFRAME_MAGIC and zlib.crc32(body) == checksum:
                return body[:length].decode(), body[length:]
        raise UserError(f"{path}: truncated or altered; restore it from a copy, or remove it")

    def remove_keyframes(self, ids: Iterator[int] | list[int]) -> int:
        """Delete keyframe files; return how many were deleted. Files that cannot be deleted stay."""
        return sum(_removed(self._keyframe_file(id)) for id in ids)

    def _keyframe_file(self, id: int) -> Path:
        return self.keyframes / f"{id}.kf"

    # --- blocks of Gaussians ---

    def block_numbers(self) -> list[int]:
        """Return the numbers of the blocks on disk, ascending."""
        return sorted(numbered_files(self.blocks, "", ".block"))

    def remove_blocks(self, numbers: Iterable[int]) -> None:
        """Delete block files. Files that cannot be deleted stay: the next start finds them."""
        for number in numbers:
            _removed(block_file(self.blocks, number))


def _removed(path: Path) -> bool:
    """Remove a file; return False if there is none, or the disk is broken or read-only."""
    try:
        path.unlink()
    except OSError:
        return False
    return True


def _check_edge_version(manifest: dict[str, Any], path: Path) -> None:
    check_version(manifest, path, EDGE_VERSION)


def check_version(table: dict[str, Any], path: Path, newest: int = VERSION) -> None:
    """Raise an error if a newer program wrote the file.

    Raises:
        UserError: the version is above `newest` or invalid; the text contains the file and both versions.
    """
    version = table.get("version")
    if not isinstance(version, int) or not 1 <= version <= newest:
        raise UserError(
            f"{path}: version {version!r}, this program reads 1 to {newest}; use the program that wrote it"
        )
