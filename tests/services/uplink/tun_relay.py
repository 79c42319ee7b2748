"""An emulated radio between two network namespaces, in its own process: delay, loss and cuts.

    python -m tests.services.uplink.tun_relay NEAR FAR DELAY_S LOSS SEED

creates a TUN device in each namespace and forwards packets between them. Each line on standard input is
answered
by one on standard output: "cut" (packets are dropped silently), "mend", "loss RATIO", "count". It ends
with its
input. The seed and a packet's number determine whether it is lost.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import random
import select
import struct
import sys
import time
from collections import deque
from contextlib import suppress

DEVICE = "radio"
_CLONE_NEWNET = 0x40000000
_TUNSETIFF = 0x400454CA
_TUN_NO_INFO = 0x0001 | 0x1000
_MTU = 1500
_BURST = 64  # packets read at once


def open_tun(namespace: str) -> int:
    """Open a TUN device in a namespace: reads return packets it sends, writes are packets it receives."""
    with open(f"/run/netns/{namespace}") as file:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.setns(file.fileno(), _CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), f"cannot enter namespace {namespace}")
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _TUN_NO_INFO))
    return tun


class Direction:
    """One direction of the radio."""

    def __init__(self, source: int, target: int, delay_ns: int, loss: float, seed: int) -> None:
        self.source, self._target = source, target
        self._delay_ns, self.loss = delay_ns, loss
        self._chance = random.Random(seed)
        self._flying: deque[tuple[int, bytes]] = deque()
        self.carried = self.bytes = self.lost = self.cut = 0

    def take(self, cut: bool) -> None:
        """Read the packets that wait to be sent."""
        for _ in range(_BURST):
            try:
                packet = os.read(self.source, _MTU + 64)
            except BlockingIOError:
                return
            if cut:
                self.cut += 1
            elif self._chance.random() < self.loss:
                self.lost += 1
            else:
                self._flying.append((time.monotonic_ns() + self._delay_ns, packet))

    def deliver(self, cut: bool) -> int | None:
        """Deliver due packets; return when the next one is due (monotonic ns)."""
        now = time.monotonic_ns()
        while self._flying and self._flying[0][0] <= now:
            packet = self._flying.popleft()[1]
            if cut:
                self.cut += 1
                continue
            with suppress(OSError):  # the receiver's queue is full, or its device is gone
                os.write(self._target, packet)
            self.carried += 1
            self.bytes += len(packet)
        return self._flying[0][0] if self._flying else None

    def counts(self) -> dict[str, int]:
        return {"carried": self.carried, "bytes": self.bytes, "lost": self.lost, "cut": self.cut}


def relay(near: str, far: str, delay_s: float, loss: float, seed: int) -> None:
    """Carries until standard input ends."""
    tuns = [open_tun(near), open_tun(far)]
    delay_ns = round(delay_s * 1e9)
    ways = [
        Direction(tuns[0], tuns[1], delay_ns, loss, 2 * seed),
        Direction(tuns[1], tuns[0], delay_ns, loss, 2 * seed + 1),
    ]
    cut = False
    print("ready", flush=True)
    while True:
        dues = [due for way in ways if (due := way.deliver(cut)) is not None]
        wait_s = max(min(dues) - time.monotonic_ns(), 0) / 1e9 if dues else 1.0
        readable, _, _ = select.select([*tuns, sys.stdin], [], [], wait_s)
        for way in ways:
            if way.source in readable:
                way.take(cut)
        if sys.stdin in readable:
            verb, _, value = sys.stdin.readline().strip().partition(" ")
            if not verb:
                return
            if verb in ("cut", "mend"):
                cut = verb == "cut"
            elif verb == "loss":
                for way in ways:
                    way.loss = float(value)
            print(json.dumps([way.counts() for way in ways]), flush=True)


if __name__ == "__main__":
    near, far, delay_s, loss, seed = sys.argv[1:]
    relay(near, far, float(delay_s), float(loss), int(seed))
