"""The two hosts of a campaign: robot and edge server, each started with `beamsplat run` as a user would."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Literal

import psutil
import zenoh

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.logins import OPERATOR, login_of
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.bench.faults.injection import DiskMode, environment, write_control
from beamsplat.tools.bench.faults.link import LinkProxy
from beamsplat.tools.keys.pki import CertificateAuthority

ROBOT_NAME = "r1"
ROUTER = "router"
PAGE_TOKEN = "campaign of faults"
DESCRIPTORS = 1024  # limit of a process on most distributions; this machine's may be larger
STOP_S = 30.0
_TITLE = "beamsplat:"  # of a process of a running system, before the name of its node
Role = Literal["robot", "edge"]


def free_port() -> int:
    """Return a TCP port of the loopback interface on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class CampaignHost:
    """One host: its deployment, its processes, and the faults that are injected into them.

    All files that its processes write are in `folder`, which is the disk that disk faults affect.
    """

    def __init__(self, role: Role, folder: Path, table: dict[str, Any]) -> None:
        """Write the deployment file; `table` is its content.

        Raises:
            UserError: the deployment is invalid.
            OSError: a file cannot be written.
        """
        self.role = role
        self.folder = make_folder(folder / role)
        self.file = folder / f"{role}.toml"
        self.output = folder / f"{role}.log"
        self.file.write_text(_toml({**table, "state_dir": str(self.folder / "state")}))
        self.deployment: Deployment = load_deployment(self.file)
        self._control = folder / f"{role}-faults.json"
        self._environment = environment(folder / "site", self._control)
        self._faults: dict[str, Any] = {}
        self._process: subprocess.Popen[bytes] | None = None
        self._read = 0  # bytes of the output that `new_lines` has returned
        self.set_faults()

    @property
    def nodes(self) -> tuple[str, ...]:
        """Return the names of all processes: the router and the nodes."""
        return (ROUTER, *self.deployment.nodes)

    @property
    def pid(self) -> int | None:
        """Return the process id of `beamsplat run`, or None if it does not run."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    @property
    def exit_code(self) -> int | None:
        """Return the exit code of `beamsplat run`, or None while it runs."""
        return None if self._process is None else self._process.poll()

    def start(self) -> None:
        """Start the system with a usual limit on descriptors; its output is appended to a file."""

        def limit() -> None:
            hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
            soft = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(DESCRIPTORS, hard)
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))

        with self.output.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "beamsplat", "run", str(self.file)], stdout=output, stderr=output,
                stdin=subprocess.DEVNULL, env={**os.environ, **self._environment}, preexec_fn=limit,
                start_new_session=True,
            )  # fmt: skip

    def stop(self) -> float | None:
        """Stop the system as a service manager does; return the time in s, or None if it was killed."""
        process = self._process
        if process is None or process.poll() is not None:
            return 0.0
        pids = list(self.pids().values())
        began = time.monotonic()
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_S)
            return time.monotonic() - began
        except subprocess.TimeoutExpired:
            for pid in (*pids, process.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            process.wait()
            return None

    def pids(self) -> dict[str, int]:
        """Return the process id of each running node, by name; of two processes of a node, the newer one."""
        found: dict[str, tuple[float, int]] = {}
        if self.pid is None:
            return {}
        with contextlib.suppress(psutil.Error):
            for process in psutil.Process(self.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    title = (process.cmdline() or [""])[0].split("\0")[0]
                    if title.startswith(_TITLE) and process.status() != psutil.STATUS_ZOMBIE:
                        entry = (process.create_time(), process.pid)
                        name = title.removeprefix(_TITLE)
                        found[name] = max(entry, found.get(name, entry))
        return {name: pid for name, (_, pid) in found.items()}

    def new_lines(self) -> list[str]:
        """Return the lines that `beamsplat run` has printed since the last call."""
        with self.output.open("rb") as file:
            file.seek(self._read)
            text = file.read()
        complete = text[: text.rfind(b"\n") + 1]
        self._read += len(complete)
        return complete.decode(errors="replace").splitlines()

    def set_faults(
        self, *, disk: DiskMode | None = None, clock_s: float | None = None, sensors: str | None = None
    ) -> None:
        """Change the faults that are injected into all processes of the host; None: as before.

        Raises:
            OSError: the control file cannot be written.
        """
        given = {"disk": disk, "clock_s": clock_s, "sensors": sensors}
        self._faults.update({name: value for name, value in given.items() if value is not None})
        write_control(self._control, self.folder, **self._faults)

    def session(self, wait_s: float) -> zenoh.Session:
        """Open a session to the host's router, as the operator; wait until there is a router.

        Raises:
            UserError: no router answers within `wait_s`.
        """
        deadline = time.monotonic() + wait_s
        while True:
            try:
                login = login_of(self.deployment.security, OPERATOR)
                return open_session(self.deployment.router.listen[:1], 1.0, login=login)
            except UserError:  # also while the logins are not created yet
                if time.monotonic() > deadline or self.exit_code is not None:
                    raise
                time.sleep(0.5)

    def log_tail(self, node: str, lines: int = 3) -> str:
        """Return the last lines of a node's log in one line."""
        try:
            text = (self.deployment.run_dir / "logs" / f"{node}.log").read_text(errors="replace")
        except OSError:
            return ""
        return " | ".join(text.splitlines()[-lines:])


class CampaignHosts:
    """Robot and edge server on this machine, with keys and logins, and a link between them that can fail."""

    def __init__(self, out: Path, data: Path, rate: float) -> None:
        """Create keys, deployments and the link below `out`; `data` is played in a loop at `rate`.

        Raises:
            UserError: a deployment is invalid, or the keys cannot be created.
        """
        authority = CertificateAuthority.create(out / "authority")
        edge_keys = authority.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
        issued = authority.issue(ROBOT_NAME, HostRole(role="robot", robot=ROBOT_NAME))
        robot_keys = Path(shutil.copytree(issued, out / "robot-keys"))
        self.tls_port = free_port()
        self.link = LinkProxy(self.tls_port)
        self.edge = CampaignHost("edge", out, _edge_table(out, self.tls_port, edge_keys))
        self.robot = CampaignHost("robot", out, _robot_table(out, data, rate, self.link.port, robot_keys))

    def start(self) -> None:
        """Start the edge server, then the robot."""
        self.edge.start()
        self.robot.start()

    @property
    def all(self) -> tuple[CampaignHost, CampaignHost]:
        """Return both hosts, the robot first."""
        return self.robot, self.edge


def _robot_table(out: Path, data: Path, rate: float, link_port: int, keys: Path) -> dict[str, Any]:
    local = out / "robot" / "logins"
    return {
        "robot": ROBOT_NAME, "role": "robot", "rate": rate,
        "router": {"listen": [f"tcp/127.0.0.1:{free_port()}"]},
        "security": {"keys": str(keys), "local": str(local)},
        "nodes": {
            "replay": {"kind": "beamsplat.tools.bench.faults.faulty_replay:FaultyReplay",
                       "data": str(data.resolve()), "loop": True},
            "localization": {"kind": "lidar", "keep_every_s": 5.0},
            "depth": {"source": "stixel"}, "fusion": {},
            "keyframes": {"durable": True, "queue_mb": 2000.0, "retry_s": 3.0},
            "uplink": {"edge": f"tls/127.0.0.1:{link_port}"},
            "page": {"port": free_port(), "token": PAGE_TOKEN},
            "recorder": {"out": str(out / "robot" / "recording")},
        },
    }  # fmt: skip


def _edge_table(out: Path, tls_port: int, keys: Path) -> dict[str, Any]:
    session = out / "edge" / "session"
    # A light mapper, which keeps up on a small machine; no keyframe is dropped because the map is full.
    mapping = {"session": str(session), "memory_mb": 800.0, "max_keyframes": 100_000, "session_every_s": 5.0,
               "half_steps": 6, "full_steps": 2, "mend_steps": 4, "tick_steps": 1}  # fmt: skip
    return {
        "robot": ROBOT_NAME, "role": "edge",
        "router": {"listen": [f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{tls_port}"]},
        "security": {"keys": str(keys)},
        "nodes": {
            "mapping": mapping,
            "monitor": {"view": "serve", "grpc_port": 0, "web_port": 0, "viewer_memory_mb": 64},
        },
    }  # fmt: skip


def _toml(table: dict[str, Any]) -> str:
    """Return a deployment as TOML; strings, numbers, booleans and lists are written as JSON writes them."""
    plain = [f"{key} = {json.dumps(value)}" for key, value in table.items() if not isinstance(value, dict)]
    parts = ["\n".join(plain)]
    for key in ("router", "security"):
        parts.append(_section(key, table[key]))
    parts += [_section(f"nodes.{name}", options) for name, options in table["nodes"].items()]
    return "\n\n".join(parts) + "\n"


def _section(name: str, options: dict[str, Any]) -> str:
    return "\n".join([f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in options.items())])
