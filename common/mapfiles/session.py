"""The files of a session: manifests replaced atomically, states as arrays, keyframes as the bytes that came.

Whatever is killed or runs full in the middle leaves the state before: a manifest is replaced only after all
that it names is on the disk. One process at a time may write to a session; it holds a lock that ends with it.
"""

from __future__ import annotations

import fcntl
import io
import json
import os
import socket
import struct
import uuid
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.mapfiles.blocks import Arrays, block_file, with_blocks

FORMAT, VERSION = "beamsplat-session", 1
EDGE_VERSION = 2  # 2: Gaussians may lie in blocks beside the state; without any, 1 is written
MANIFEST, EDGE_MANIFEST = "session.json", "edge.json"
_TRIES = 5  # to read a state while a mapper replaces it
_BODY_MAGIC = b"BSKF"
_BODY_HEAD = struct.Struct("<4sIH")  # magic, CRC-32 of what follows the head, length of the schema


class SessionFolder:
    """One session on disk. Reading needs no lock; `lock` before writing."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._lock: TextIO | None = None

    @property
    def edge(self) -> Path:
        return self.path / "edge"

    @property
    def robot(self) -> Path:
        return self.path / "robot"

    @property
    def bodies(self) -> Path:
        return self.edge / "keyframes"

    @property
    def blocks(self) -> Path:
        return self.edge / "gaussians"

    def exists(self) -> bool:
        """Whether this folder holds a session."""
        return (self.path / MANIFEST).is_file()

    # --- identity and lock ---

    def create(self) -> None:
        """Makes the folder a session, unless it is one.

        Raises:
            UserError: the folder cannot be made, or holds a session that cannot be read.
        """
        make_folder(self.bodies)
        make_folder(self.blocks)
        if self.exists():
            self.head()
            return
        head = {"format": FORMAT, "version": VERSION, "uuid": str(uuid.uuid4())}
        try:
            write_json(self.path / MANIFEST, head)
        except OSError as error:
            raise UserError(f"{self.path}: no session can be made here ({error.strerror})") from error

    def head(self) -> dict[str, Any]:
        """`session.json`.

        Raises:
            UserError: no session, not readable, or of a version that this program does not know.
        """
        if not self.path.is_dir():
            raise UserError(f"{self.path}: no such folder; a session is what `mapping.session = DIR` writes")
        head = read_json(self.path / MANIFEST, "a session is a folder written by `mapping.session = DIR`")
        if head.get("format") != FORMAT:
            raise UserError(f"{self.path / MANIFEST}: field 'format' is not {FORMAT!r}: this is no session")
        check_version(head, self.path / MANIFEST)
        if not isinstance(head.get("uuid"), str):
            raise UserError(
                f"{self.path / MANIFEST}: field 'uuid' is missing; restore the folder from a copy"
            )
        return head

    def lock(self) -> None:
        """Keeps other writers out until `unlock` or the process's end, and clears what a killed writer left.

        Raises:
            UserError: another process writes to this session; the text names it and its host.
        """
        file = (self.edge / "lock").open("a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = file.readline().strip() or "it does not say which"
            file.close()
            raise UserError(
                f"{self.path}: another process writes to this session ({holder}): end it, or use another "
                "folder"
            ) from error
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        self._lock = file
        for folder in (self.edge, self.bodies):
            for leftover in folder.glob(".*"):
                leftover.unlink()

    def unlock(self) -> None:
        """Lets others write."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    # --- states ---

    def write_state(self, arrays: Arrays, summary: dict[str, Any]) -> None:
        """A new state beside the old one, then the manifest that names it; the old one goes last.

        Raises:
            OSError: the disk is full or broken; the old state is still the valid one.
        """
        numbers = [int(p.stem.rpartition("-")[2]) for p in self.edge.glob("state-*.npz")]
        name = f"state-{1 + max(numbers, default=0)}.npz"
        try:
            with (self.edge / name).open("xb") as file:
                np.savez(file, **arrays)
                file.flush()
                os.fsync(file.fileno())
            size = (self.edge / name).stat().st_size
            version = EDGE_VERSION if "block_number" in arrays else VERSION
            manifest = {"version": version, "state": name, "bytes": size, **summary}
            write_json(self.edge / EDGE_MANIFEST, manifest)
        except OSError:
            (self.edge / name).unlink(missing_ok=True)
            raise
        for old in self.edge.glob("state-*.npz"):
            if old.name != name:
                old.unlink(missing_ok=True)

    def manifest(self) -> dict[str, Any] | None:
        """`edge.json`; None while nothing has been saved.

        Raises:
            UserError: not readable, or of a version that this program does not know.
        """
        self.head()
        path = self.edge / EDGE_MANIFEST
        if not path.is_file():
            return None
        manifest = read_json(path, "restore the folder from a copy")
        check_version(manifest, path, EDGE_VERSION)
        for field, kind in (("state", str), ("bytes", int)):
            if not isinstance(manifest.get(field), kind):
                raise UserError(f"{path}: field {field!r} is missing; restore the folder from a copy")
        return manifest

    def read_state(self, whole: bool = True) -> Arrays | None:
        """The arrays that the manifest names; None while nothing has been saved. Without `whole`, blocks of
        Gaussians stay in their files.

        Raises:
            UserError: they are missing, truncated or altered.
        """
        for _ in range(_TRIES):
            manifest = self.manifest()
            try:
                return None if manifest is None else self._read(manifest, whole)
            except UserError:
                if self.manifest() == manifest:
                    raise
        raise UserError(f"{self.path}: is saved faster than it can be read; try again")

    def _read(self, manifest: dict[str, Any], whole: bool) -> Arrays:
        path = self.edge / Path(manifest["state"]).name
        try:
            size = path.stat().st_size
            if size != manifest["bytes"]:
                raise UserError(
                    f"{path}: truncated ({size} bytes, {manifest['bytes']} expected); restore it from a copy"
                )
            arrays = unpacked_arrays(path)
        except (OSError, zipfile.BadZipFile, zlib.error, ValueError) as error:
            if isinstance(error, UserError):
                raise
            raise UserError(f"{path}: cannot be read ({reason(error)}); restore it from a copy") from error
        return with_blocks(self.blocks, arrays) if whole else arrays

    # --- keyframes ---

    def write_body(self, id: int, schema: str, payload: bytes) -> None:
        """A keyframe as it came. It is on the disk when this returns.

        Raises:
            OSError: the disk is full or broken.
        """
        name = schema.encode()
        checksum = zlib.crc32(payload, zlib.crc32(name))
        write_durably(self._body(id), _BODY_HEAD.pack(_BODY_MAGIC, checksum, len(name)) + name + payload)

    def body_ids(self) -> list[int]:
        """Ids of the keyframes on disk, rising."""
        return sorted(int(p.stem) for p in self.bodies.glob("*.kf") if p.stem.isdecimal())

    def read_body(self, id: int) -> tuple[str, bytes]:
        """(schema, payload) of a keyframe.

        Raises:
            UserError: it is missing or altered.
        """
        path = self._body(id)
        try:
            blob = path.read_bytes()
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror})") from error
        if len(blob) >= _BODY_HEAD.size:
            magic, checksum, length = _BODY_HEAD.unpack_from(blob)
            if magic == _BODY_MAGIC and zlib.crc32(blob[_BODY_HEAD.size :]) == checksum:
                schema = blob[_BODY_HEAD.size : _BODY_HEAD.size + length].decode()
                return schema, blob[_BODY_HEAD.size + length :]
        raise UserError(f"{path}: truncated or altered; restore it from a copy, or remove it")

    def remove_bodies(self, ids: Iterator[int] | list[int]) -> int:
        """Takes keyframes off the disk; gives how many there were."""
        there = [path for path in map(self._body, ids) if path.exists()]
        for path in there:
            path.unlink(missing_ok=True)
        return len(there)

    def _body(self, id: int) -> Path:
        return self.bodies / f"{id}.kf"

    # --- blocks of Gaussians ---

    def block_numbers(self) -> list[int]:
        """Numbers of the blocks on disk, rising."""
        return sorted(int(p.stem) for p in self.blocks.glob("*.block") if p.stem.isdecimal())

    def remove_blocks(self, numbers: Iterable[int]) -> None:
        """Takes blocks off the disk."""
        for number in numbers:
            block_file(self.blocks, number).unlink(missing_ok=True)


def packed_arrays(arrays: Arrays) -> bytes:
    """The bytes of a state, as they stand in its file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def unpacked_arrays(source: Path | bytes) -> Arrays:
    """The state in a file, or in its bytes.

    Raises:
        OSError, ValueError, zipfile.BadZipFile, zlib.error: it is not whole.
    """
    with np.load(io.BytesIO(source) if isinstance(source, bytes) else source, allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


def write_durably(path: Path, data: bytes | memoryview) -> None:
    """Replaces a file whole, and the entry in its folder survives a power cut too."""
    write_atomically(path, data)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_json(path: Path, table: dict[str, Any]) -> None:
    """Replaces a JSON file whole."""
    write_durably(path, (json.dumps(table, indent=1) + "\n").encode())


def read_json(path: Path, advice: str) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        UserError: there is none; the text ends with `advice`.
    """
    try:
        table = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({reason(error)}); {advice}") from error
    if not isinstance(table, dict):
        raise UserError(f"{path}: not a JSON object; {advice}")
    return table


def check_version(table: dict[str, Any], path: Path, newest: int = VERSION) -> None:
    """Refuses what a newer program wrote.

    Raises:
        UserError: names the file, its version and the one that this program reads.
    """
    version = table.get("version")
    if not isinstance(version, int) or not 1 <= version <= newest:
        raise UserError(
            f"{path}: version {version!r}, this program reads 1 to {newest}; use the program that wrote it"
        )
