"""The processes of a supervisor: their state, their start from the fork server, and their end."""

from __future__ import annotations

import logging
import multiprocessing
import os
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.files.epochs import EpochClaims
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.runtime.registry import Service
from beamsplat.tools.system.assembly import Surroundings
from beamsplat.tools.system.log_tail import LogPosition, last_error, log_position
from beamsplat.tools.system.node_process import CHILD_ENVIRONMENT, STOP_S, child
from beamsplat.tools.system.shared_process import child_together

log = logging.getLogger("beamsplat")

BACK_OFF_S = (0.1, 0.5, 1.0, 2.0, 5.0)
RETRY_S = (5.0, 10.0, 30.0, 60.0)  # before the next start of a node that cannot run
HEALTHY_S = 30.0  # a process that ran this long starts with the shortest back-off again
PRELOADED = (
    "numpy",
    "cv2",
    "scipy.spatial",
    "pydantic",
    "zenoh",
    "beamsplat.common.runtime.live",
    "beamsplat.common.runtime.lockstep",
    "beamsplat.tools.system.fork_server",
)


@dataclass
class Child:
    """State of one supervised node, or of the router; times are `time.monotonic()` in s.

    Nodes that share a process (`Deployment.together`) have the same `process`. What is done to the process is
    decided for the first of them only.
    """

    name: str
    process: BaseProcess
    started: float
    identity: ProcessId
    restarts: int = 0
    attempts: int = 0  # within the current back-off
    due: float | None = None  # time of the next start of a process that has ended
    failed: str = ""  # why the last process could not run (UserError); "" = it runs, or has crashed
    failures: int = 0  # UserErrors in a row
    was_active: bool = False
    retiring: bool = False  # hands over to a successor: its end is no crash
    kill_at: float | None = None  # SIGTERM was sent for a restart; SIGKILL follows at this time

    @property
    def instance(self) -> str:
        return self.identity.instance

    def delay_after_crash_s(self, now: float) -> float:
        """Return the time until the next start of a process that has crashed, and count the crash."""
        if now - self.started > HEALTHY_S:
            self.attempts = 0
        self.attempts += 1
        return BACK_OFF_S[min(self.attempts, len(BACK_OFF_S)) - 1]

    def delay_after_failure_s(self, now: float) -> float:
        """Return the time until the next start of a process that could not run, and count the failure."""
        if now - self.started > HEALTHY_S:
            self.failures = 0
        self.failures += 1
        return RETRY_S[min(self.failures, len(RETRY_S)) - 1]


@dataclass
class Successor:
    """The process and the deployment that replace a running node.

    Without a process, the node is first stopped and then started with the new options.
    """

    name: str
    deployment: Deployment
    process: BaseProcess | None = None
    identity: ProcessId | None = None  # with a process
    hands_over: bool = False  # loads the state that its predecessor saves, and publishes nothing before

    @property
    def instance(self) -> str:
        return self.identity.instance if self.identity else ""


class ProcessStarter:
    """Starts processes from a fork server that has preloaded what most of them import."""

    def __init__(self, claims: EpochClaims, table: dict[str, Service]) -> None:
        """Args:
        claims: of the identities of the processes on the bus.
        table: known services by name.
        """
        self._claims, self._table = claims, table
        self._log_start: dict[str, LogPosition] = {}  # where the log of the newest process begins
        os.environ.update({k: os.environ.get(k, v) for k, v in CHILD_ENVIRONMENT.items()})
        _use_writable_temporary_folder()
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(list(PRELOADED))

    def start(
        self, deployment: Deployment, name: str, around: Surroundings | None, log_file: Path, *, resume: bool,
        standby: bool,
    ) -> tuple[BaseProcess, ProcessId]:  # fmt: skip
        """Start the process of a node or of the router; return it and its identity on the bus."""
        identity = self._claims.claim(name)
        self._log_start[name] = log_position(log_file)
        process = self._context.Process(
            target=child,
            args=(deployment, name, log_file, resume, around, self._table, identity, standby),
            name=name,
            daemon=False,
        )
        process.start()
        return process, identity

    def start_together(
        self, deployment: Deployment, around: dict[str, Surroundings], log_file: Path, *, resume: bool
    ) -> tuple[BaseProcess, dict[str, ProcessId]]:
        """Start one process for all nodes of `around`; return it and their identities on the bus."""
        identities = {name: self._claims.claim(name) for name in around}
        self._log_start.update(dict.fromkeys(around, log_position(log_file)))
        process = self._context.Process(
            target=child_together,
            args=(deployment, around, log_file, resume, self._table, identities),
            name="+".join(around),
            daemon=False,
        )
        process.start()
        return process, identities

    def last_error(self, name: str, log_file: Path) -> str:
        """Return the last error of the newest process called `name` in its log, in one line."""
        return last_error(log_file, self._log_start.get(name))


def _use_writable_temporary_folder() -> None:
    """Let Python create the socket of its fork server in memory, if no disk has room for it."""
    try:
        tempfile.gettempdir()
    except FileNotFoundError:
        tempfile.tempdir = "/dev/shm"


def end(children: list[Child]) -> None:
    """Stop processes with SIGTERM; SIGKILL after `STOP_S`."""
    for entry in children:
        if entry.process.is_alive():
            entry.process.terminate()
    deadline = time.monotonic() + STOP_S
    for entry in children:
        entry.process.join(max(deadline - time.monotonic(), 0.0))
        if entry.process.is_alive():
            log.warning("%s did not stop within the time limit: killed", entry.name)
            entry.process.kill()
            entry.process.join()
