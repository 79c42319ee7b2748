"""Epochs of a node's processes, claimed by their supervisor before it starts them."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from beamsplat.common.files.persist import write_atomically
from beamsplat.common.messages.instances import ProcessId, process_of

RESERVED = 32  # epochs that one write reserves: a disk that fills up later stops no restart
_SEED_BYTES = 32


@dataclass
class _Reservation:
    seed: bytes
    next: int  # epoch of the next claim
    end: int  # first epoch that is not reserved


class EpochClaims:
    """Claims the next epoch of a node, with the instance id that belongs to it.

    `run_dir`/epochs/<node> has the secret seed of the node's instances and the last reserved epoch; only its
    owner can read it. Another supervisor of the same folder continues after it.

    If that file cannot be read or written, claims continue in memory with a new seed. Such a process cannot
    prove that it succeeds the one before: subscribers accept it after a silence of 5 s
    (`beamsplat.common.runtime.accepted_producer`).
    """

    def __init__(self, run_dir: Path, on_fault: Callable[[str], None]) -> None:
        """`on_fault` is called with a sentence when claims of a node continue in memory."""
        self._folder = run_dir / "epochs"
        self._on_fault = on_fault
        self._reserved: dict[str, _Reservation] = {}

    def claim(self, node: str) -> ProcessId:
        """Return the identity of the next process of `node`."""
        known = self._reserved.get(node)
        if known is None or known.next == known.end:
            known = self._reserved[node] = self._reserve(node, known)
        known.next += 1
        return process_of(known.seed, node, known.next - 1)

    def _reserve(self, node: str, known: _Reservation | None) -> _Reservation:
        path = self._folder / node
        last = known.end - 1 if known else 0
        try:
            with self._locked():
                seed, stored = _read(path)
                first = max(stored, last) + 1
                seed = seed or secrets.token_bytes(_SEED_BYTES)
                content = json.dumps({"seed": seed.hex(), "epoch": first + RESERVED - 1})
                write_atomically(path, content.encode(), mode=0o600)
            return _Reservation(seed, first, first + RESERVED)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            self._on_fault(
                f"{path}: the epochs of {node} cannot be stored ({why}). They continue in memory: after this "
                "start, other processes may accept its messages 5 s later"
            )
            first = last + 1
            return _Reservation(secrets.token_bytes(_SEED_BYTES), first, first + RESERVED)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep other supervisors out: two processes must not get the same epoch."""
        self._folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)


def _read(path: Path) -> tuple[bytes, int]:
    """Return seed and last reserved epoch; an empty seed if there is none yet (older versions have none).

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is damaged.
    """
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        return b"", 0
    if isinstance(content, int):
        return b"", content
    if not (isinstance(content, dict) and isinstance(content.get("epoch"), int)):
        raise ValueError("the file is damaged: remove it")
    return bytes.fromhex(str(content.get("seed"))), content["epoch"]
