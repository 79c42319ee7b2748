"""The real system on two hosts with a radio between them: one replays a drive, the other maps.

All times are of one machine's clock, which both hosts share: `sent_ns` is in a message's header (monotonic
time
of publishing), `heard_ns` is the time of reception by a subscriber next to the consumers.
"""

import contextlib
import json
import os
import subprocess
import sys
import time

import numpy as np

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.tools.keys.pki import CertificateAuthority
from tests.services.uplink.radio import FAR_ADDRESS, ROOT

PORT = 7448
RATE = float(os.environ.get("BEAMSPLAT_RATE", "1"))  # of the drive: less on a machine that has no time for it
LIGHT = {
    "max_keyframes": 5000,
    "half_steps": 4,
    "full_steps": 1,
    "tick_steps": 0,
}  # a slow machine for a GPU's work


class ReceivedMessages:
    """The messages that one host has received so far."""

    def __init__(self, path):
        lines = path.read_text().splitlines() if path.exists() else []
        self.lines = [json.loads(line) for line in lines if line.endswith("}")]

    def of(self, topic):
        return [line for line in self.lines if line["topic"] == topic]

    def first(self, topic, what):
        """Return stamp_ns -> the earliest `what` ("heard_ns", "sent_ns")."""
        out = {}
        for line in self.of(topic):
            out[line["stamp_ns"]] = min(line[what], out.get(line["stamp_ns"], line[what]))
        return out


class HostProcess:
    """A host's process (tests.services.uplink.side)."""

    def __init__(self, radio, namespace, deployment, folder):
        folder.mkdir(parents=True)
        self.deployment, self._log = deployment, folder / "heard.jsonl"
        (folder / "deployment.json").write_text(deployment.model_dump_json())
        command = [sys.executable, "-m", "tests.services.uplink.side", folder / "deployment.json", self._log]
        self._process = subprocess.Popen(
            radio.on(namespace, *map(str, command)), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=(folder / "stderr.log").open("w"),
        )  # fmt: skip
        self._answer()

    def _answer(self):
        line = self._process.stdout.readline()
        assert line, f"{self.deployment.role} has died: {self._log.parent}/stderr.log"
        return json.loads(line)

    def ask(self, text):
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()
        return self._answer()

    def state(self):
        return self.ask("state")

    def end(self):
        if self._process.poll() is None:
            with contextlib.suppress(OSError, AssertionError):
                self.ask("end")
        self._process.stdin.close()
        self._process.wait(60)

    @property
    def log(self):
        return ReceivedMessages(self._log)


class BadLinkPair:
    """Two hosts: `near` drives, `far` maps into `session`; use with `with`."""

    def __init__(self, radio, folder, data, *, duration_s=None, mapping=LIGHT, rate=RATE):
        self._radio, self._folder = radio, folder
        authority = CertificateAuthority.create(folder / "authority")
        edge_keys = authority.issue("edge", HostRole(role="edge"), (FAR_ADDRESS,))
        robot_keys = authority.issue("r1", HostRole(role="robot", robot="r1"))
        self.session = folder / "session"
        replay = {"data": str(data)} | ({} if duration_s is None else {"duration_s": float(duration_s)})
        queue = {"durable": True, "queue_mb": 2000.0, "retry_s": 3.0}  # as deploy/robot.toml
        self._robot = Deployment(
            robot="r1", role="robot", router=RouterConfig(listen=("tcp/127.0.0.1:7447",)),
            rate=rate, state_dir=folder / "robot", security=SecurityConfig(keys=robot_keys),
            nodes={
                "replay": replay, "localization": {"kind": "lidar"}, "depth": {"source": "stixel"}, "fusion": {},
                "keyframes": queue, "uplink": {"edge": f"tls/{FAR_ADDRESS}:{PORT}"},
            },
        )  # fmt: skip
        self._edge = Deployment(
            robot="r1", role="edge", state_dir=folder / "edge", security=SecurityConfig(keys=edge_keys),
            router=RouterConfig(listen=("tcp/127.0.0.1:7449", f"tls/{FAR_ADDRESS}:{PORT}")),
            nodes={"mapping": {**mapping, "session": str(self.session)}},
        )  # fmt: skip

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            self.far = HostProcess(self._radio, self._radio.far, self._edge, self._folder / "far")
            stack.callback(self.far.end)
            self.near = HostProcess(self._radio, self._radio.near, self._robot, self._folder / "near")
            stack.callback(self.near.end)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception):
        self._stack.close()

    def wait(self, until, timeout_s):
        """Wait until `until(near, far)` is true for the states of both hosts; return the states."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            near, far = self.near.state(), self.far.state()
            if until(near, far):
                return near, far
            time.sleep(0.5)
        raise AssertionError(
            f"not within {timeout_s} s: {near['states']} {near['details']} {far['states']} {far['details']}"
        )

    def drained(self, timeout_s):
        """Wait until everything that was driven is mapped."""
        return self.wait(
            lambda near, far: (
                near["states"].get("keyframes") == "drained" and far["states"].get("mapping") == "drained"
            ),
            timeout_s,
        )

    @property
    def queued(self):
        """Ids of the keyframes on the robot's disk."""
        return {int(p.stem) for p in (self._robot.run_dir / "keyframes").glob("*.keyframe")}

    def durable(self):
        """Return id -> when the keyframe was on the edge's disk (monotonic ns, from the file's time)."""
        shift_ns = time.monotonic_ns() - time.time_ns()
        folder = SessionFolder(self.session)
        return {
            i: (folder.keyframes / f"{i}.kf").stat().st_mtime_ns + shift_ns for i in folder.keyframe_ids()
        }


def quantiles(values_ns):
    """Return (p50, p95, p99, maximum) in ms."""
    if not len(values_ns):
        return (float("nan"),) * 4
    return tuple(np.percentile(np.asarray(values_ns) / 1e6, (50, 95, 99, 100)))


def onboard(log, since_ns, until_ns):
    """Return (ratio of scans with a pose, poses/s, latencies in ns) of the robot's localization."""
    scans = {s: t for s, t in log.first("lidar/scan", "sent_ns").items() if since_ns <= t < until_ns}
    poses = log.first("localization/odometry", "sent_ns")
    late = [poses[s] - t for s, t in scans.items() if s in poses]
    seconds = (max(scans.values()) - min(scans.values())) / 1e9 if len(scans) > 1 else float("nan")
    return len(late) / max(len(scans), 1), len(late) / seconds, late


def transit(near, far, topic, since_ns, until_ns):
    """Return latencies in ns from first sent on the robot to first received on the edge, and the number
    missing.
    """
    sent, heard = near.first(topic, "sent_ns"), far.first(topic, "heard_ns")
    mine = {s: t for s, t in sent.items() if since_ns <= t < until_ns}
    return [heard[s] - t for s, t in mine.items() if s in heard], sum(s not in heard for s in mine)
