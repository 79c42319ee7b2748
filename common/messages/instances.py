"""Instance ids of processes: a reverse hash chain, by which a process proves that it succeeds another one.

The supervisor of a node keeps a secret seed. The last instance of a chain of `CHAIN_EPOCHS` is derived from
it, and each earlier one from the next:

    instance(e - 1) = first 8 bytes of SHA-256(node, e, instance(e))

So everybody can check that instance(e + k) leads to instance(e), and nobody without the seed can name
instance(e + k) before the supervisor has started that process. Node and epoch are part of each hash, so that
a guess can hit one epoch of one node only: 2^63 guesses on average.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

CHAIN_EPOCHS = 4096  # epochs per chain; computing the first instance of a chain takes some ms
MAX_STEPS = 256  # longest proof that is checked: a bogus instance costs its receiver 0.2 ms
_BYTES = 8


class ProcessId(NamedTuple):
    """A process of a node: `epoch` increases with each process, `instance` are 16 hex digits."""

    node: str
    epoch: int
    instance: str


def process_of(seed: bytes, node: str, epoch: int) -> ProcessId:
    """Return the process of `epoch` (uint32) in the chains of the secret `seed`."""
    chain = epoch // CHAIN_EPOCHS
    last = (chain + 1) * CHAIN_EPOCHS - 1
    instance = hashlib.sha256(b"chain\0%s\0%d\0%s" % (node.encode(), chain, seed)).digest()[:_BYTES]
    for number in range(last, epoch, -1):
        instance = _previous(node.encode(), number, instance)
    return ProcessId(node, epoch, instance.hex())


def is_proven_successor(process: ProcessId, known: ProcessId) -> bool:
    """Return whether `process` is a later process of the same supervisor and node as `known`.

    False also for a successor more than `MAX_STEPS` epochs later, or of the next chain: there is no proof.
    """
    steps = process.epoch - known.epoch
    if process.node != known.node or not 0 < steps <= MAX_STEPS:
        return False
    instance = bytes.fromhex(process.instance)
    for number in range(process.epoch, known.epoch, -1):
        instance = _previous(process.node.encode(), number, instance)
    return instance.hex() == known.instance


def control_id(instance: str) -> str:
    """Return the id in the keys of the hand-over requests to a process.

    A process in standby declares these keys before it has published anything. They must not reveal its
    instance, with which everybody could take over from its predecessor.
    """
    return hashlib.sha256(b"control\0" + bytes.fromhex(instance)).digest()[:_BYTES].hex()


def _previous(node: bytes, epoch: int, instance: bytes) -> bytes:
    return hashlib.sha256(b"instance\0%s\0%d\0%s" % (node, epoch, instance)).digest()[:_BYTES]
