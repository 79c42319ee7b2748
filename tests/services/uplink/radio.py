"""Two hosts on one machine: network namespaces with an emulated radio; needs root and TUN devices.

Both share the same clocks, so that times of both sides can be compared.
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.services.uplink.tun_relay import DEVICE

ROOT = Path(__file__).resolve().parents[3]
NEAR_ADDRESS, FAR_ADDRESS = "10.77.0.1", "10.77.0.2"


def needs_namespaces():
    """Skip the test if namespaces cannot be made."""
    if os.geteuid() != 0 or not Path("/dev/net/tun").exists() or shutil.which("ip") is None:
        pytest.skip("needs root, /dev/net/tun and the command `ip`, to make two hosts of one machine")
    probe = subprocess.run(["ip", "netns", "add", f"probe{os.getpid()}"], capture_output=True, text=True)
    if probe.returncode != 0:
        pytest.skip(f"network namespaces cannot be made here: {probe.stderr.strip()}")
    subprocess.run(["ip", "netns", "delete", f"probe{os.getpid()}"], check=True)


class Radio:
    """An emulated radio between the namespaces `near` and `far`.

    `rate_mbit` limits each direction, behind a queue of `queue_ms`.
    """

    def __init__(self, rate_mbit=None, delay_ms=0.0, loss=0.0, seed=0, congestion="bbr", queue_ms=100):
        self._rate, self._queue_ms, self._congestion = rate_mbit, queue_ms, congestion
        self._relay_args = [str(delay_ms / 1e3), str(loss), str(seed)]
        self.near, self.far = f"near{os.getpid()}", f"far{os.getpid()}"

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            for name in (self.near, self.far):
                _ip("netns", "add", name)
                stack.callback(_ip, "netns", "delete", name)
            self._relay = subprocess.Popen(
                [sys.executable, "-m", "tests.services.uplink.tun_relay", self.near, self.far, *self._relay_args],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT,
            )  # fmt: skip
            stack.callback(self._end_relay)
            assert self._relay.stdout.readline() == "ready\n", "the relay did not start: see its output"
            sides = ((self.near, NEAR_ADDRESS, FAR_ADDRESS), (self.far, FAR_ADDRESS, NEAR_ADDRESS))
            for name, own, other in sides:
                self._set_up(name, own, other)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception):
        self._stack.close()

    def _end_relay(self):
        self._relay.stdin.close()
        self._relay.wait(10)

    def _set_up(self, name, own, other):
        _ip("-n", name, "link", "set", "lo", "up")
        _ip("-n", name, "address", "add", own, "peer", other, "dev", DEVICE)
        _ip("-n", name, "link", "set", DEVICE, "addrgenmode", "none", "up")  # no packets of the kernel's own
        # By route: a namespace of its own may not choose among all algorithms by sysctl.
        _ip("-n", name, "route", "replace", other, "dev", DEVICE, "src", own, "congctl", self._congestion)
        if self._rate:
            # 8 KB: finer than a queue's worth, and the timer of a busy machine is good for it.
            self.run(name, "tc", "qdisc", "add", "dev", DEVICE, "root", "tbf", "rate", f"{self._rate}mbit",
                     "burst", "8kb", "latency", f"{self._queue_ms}ms")  # fmt: skip

    def run(self, name, *command):
        """Run a command on one of the hosts; it must succeed."""
        subprocess.run(self.on(name, *command), check=True, capture_output=True, text=True)

    def on(self, name, *command):
        """Return the command line that runs a command on one of the hosts."""
        return ["ip", "netns", "exec", name, *command]

    def tell(self, text):
        """Send a command (cut, mend, loss RATIO, count); return the counts (near to far, far to near)."""
        self._relay.stdin.write(text + "\n")
        self._relay.stdin.flush()
        return tuple(json.loads(self._relay.stdout.readline()))


def _ip(*arguments):
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True)
    assert done.returncode == 0, f"ip {' '.join(arguments)}: {done.stderr}"
