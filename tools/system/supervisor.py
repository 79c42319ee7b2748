"""Start the router and the nodes of a deployment, restart crashed processes, and stop all in order.

A node that cannot run (exit code 2) is started again after `RETRY_S`. During start-up, which lasts until all
nodes have been active once, it is an obstacle to the run if it is essential.
"""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

from beamsplat.common.config.deployment import Deployment, with_overrides
from beamsplat.common.errors import UserError
from beamsplat.common.files.epochs import EpochClaims
from beamsplat.common.files.persist import make_folder_if_possible
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.runtime.registry import Service
from beamsplat.common.security.logins import OPERATOR, SUPERVISOR, make_logins
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import (
    Surroundings,
    build_node,
    node_classes,
    service_of,
    surroundings,
)
from beamsplat.tools.system.child_processes import Child, ProcessStarter, Successor, end
from beamsplat.tools.system.node_process import STOP_S
from beamsplat.tools.system.router_checks import refuse_second_router, wait_for_router

log = logging.getLogger("beamsplat")

ROUTER = "router"
START_UP_S = 300.0  # longest start-up, if a node never becomes active


class Supervisor:
    """Supervisor of the processes of one deployment.

    As a context manager it starts and stops them. Call `poll` several times per second. `names` are the
    processes to run (nodes, and `router`); None runs all.
    """

    def __init__(
        self,
        deployment: Deployment,
        names: tuple[str, ...] | None = None,
        *,
        table: dict[str, Service] = NODES,
        on_event: Callable[[str], None] | None = None,
    ) -> None:
        self.deployment = deployment
        self.log_dir = deployment.run_dir / "logs"
        self.children: dict[str, Child] = {}
        self._around: dict[str, Surroundings] = {}
        self._retired: list[BaseProcess] = []  # replaced processes, which end by themselves
        self._successors: list[BaseProcess] = []  # in standby
        self.table = table
        self._names = names if names is not None else (ROUTER, *deployment.nodes)
        self._on_event = on_event or (lambda text: log.info("%s", text))
        self._starter = ProcessStarter(EpochClaims(deployment.run_dir, self._on_event), table)
        self.starting = True
        self.obstacle = ""  # why the run cannot go on: text for a UserError
        self._start_up_until = time.monotonic() + START_UP_S

    def __enter__(self) -> Supervisor:
        if ROUTER in self._names:
            refuse_second_router(self.deployment)  # before anything is created
        if fault := make_folder_if_possible(self.log_dir):
            self._on_event(f"{self.log_dir}: {fault}; the logs go to the output of this process")
        try:
            self._start_all()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def _start_all(self) -> None:
        """Start the router, then consumers, then sources."""
        if ROUTER in self._names:
            if (folder := self.deployment.security.local) is not None:
                make_logins(folder, (*self.table, *self.deployment.nodes, SUPERVISOR, OPERATOR))
                refuse_second_router(self.deployment)  # now with a login
            self._start(ROUTER)
            process = self.children[ROUTER].process
            wait_for_router(self.deployment, process.is_alive, lambda: self.last_error(ROUTER))
        classes = node_classes(self.deployment, self.table)
        nodes = [name for name in self._names if name != ROUTER]
        self._around = {name: surroundings(classes, name, self.deployment.role) for name in nodes}
        for name in sorted(nodes, key=lambda n: classes[n].is_source()):
            if name not in self.children:  # else started with the node whose process it shares
                self._start(name)

    def _sharing(self, name: str) -> tuple[str, ...]:
        """Return the nodes in the process of a node, or the process itself; the first decides for all."""
        return tuple(n for n in self.deployment.sharing(name) if n == name or n in self._names)

    def process_name(self, name: str) -> str:
        """Return the name of the process of a node: its own, or those of all nodes that share it."""
        return "+".join(self._sharing(name))

    def log_file(self, name: str) -> Path:
        """Return the path of the log file of the process of the node (or router) called `name`."""
        return self.log_dir / f"{self.process_name(name)}.log"

    def last_error(self, name: str) -> str:
        """Return the last error in the log of the newest process called `name`, in one line."""
        return self._starter.last_error(name, self.log_file(name))

    def _start(self, name: str, resume: bool = False) -> None:
        names = self._sharing(name)
        if len(names) == 1:
            self._set_process(name, *self._spawn(self.deployment, name, resume))
            return
        around = {other: self._around[other] for other in names}
        process, identities = self._starter.start_together(
            self.deployment, around, self.log_file(name), resume=resume
        )
        for other, identity in identities.items():
            self._set_process(other, process, identity)

    def _spawn(
        self, deployment: Deployment, name: str, resume: bool = False, standby: bool = False
    ) -> tuple[BaseProcess, ProcessId]:
        around, log_file = self._around.get(name), self.log_file(name)
        return self._starter.start(deployment, name, around, log_file, resume=resume, standby=standby)

    def _set_process(self, name: str, process: BaseProcess, identity: ProcessId) -> None:
        known = self.children.get(name)
        if known is None:
            self.children[name] = Child(name, process, time.monotonic(), identity)
        else:
            known.process, known.started, known.identity = process, time.monotonic(), identity
            known.due, known.kill_at, known.retiring = None, None, False

    def successor(self, name: str, overrides: tuple[str, ...], warm: bool) -> Successor:
        """Prepare the replacement of a node by one with other options: see `beamsplat.tools.system.swap`.

        Args:
            name: name of the node.
            overrides: options to change, as OPTION=VALUE. If `kind` changes, all others have their defaults.
            warm: start a second process in standby now; else the node is stopped first, and none starts yet.

        Raises:
            UserError: there is no such node, an option is invalid, or the node cannot run twice.
        """
        before = self.deployment
        if any(o.partition("=")[0].strip() == "kind" for o in overrides):  # its options differ
            before = before.model_copy(update={"nodes": {**before.nodes, name: {}}})
        if warm and len(self._sharing(name)) > 1:
            raise UserError(
                f"{name} shares the process {self.process_name(name)}: --cold ends it first, and starts it "
                "anew with the new options"
            )
        deployment = with_overrides(before, tuple(f"{name}.{o}" for o in overrides))
        node = build_node(deployment, name, self.table)
        if not warm:
            return Successor(name, deployment)
        if obstacle := node.handover_obstacle(build_node(self.deployment, name, self.table)):
            raise UserError(
                f"{name} cannot be taken over while it runs, {obstacle}: --cold ends it first, and starts it "
                "anew with the new options"
            )
        successor = Successor(name, deployment, *self._spawn(deployment, name, standby=True), node.hands_over)
        assert successor.process is not None  # just started
        self._successors.append(successor.process)
        return successor

    def replace(self, successor: Successor) -> None:
        """Supervise an activated successor in place of its predecessor; later restarts use its options."""
        self._use_options_of(successor)
        self._retired.append(self.children[successor.name].process)
        assert successor.process is not None  # it is running
        self._successors.remove(successor.process)
        assert successor.identity is not None
        self._set_process(successor.name, successor.process, successor.identity)
        self._on_event(f"{successor.name} was taken over by its successor")

    def discard(self, successor: Successor) -> None:
        """Kill the process of a successor that has failed; one that has taken over is restarted by `poll`."""
        if successor.process is not None:
            successor.process.kill()
            self._successors = [p for p in self._successors if p is not successor.process]

    def restart_with(self, successor: Successor) -> None:
        """Restart a node with the successor's options."""
        self._use_options_of(successor)
        self.restart(successor.name)

    def _use_options_of(self, successor: Successor) -> None:
        """Take over the options of one node; those of others may have changed since it was prepared."""
        options = successor.deployment.nodes[successor.name]
        nodes = {**self.deployment.nodes, successor.name: options}
        self.deployment = self.deployment.model_copy(update={"nodes": nodes})

    def restart(self, name: str) -> None:
        """Send SIGTERM to a process; `poll` starts it again when it has ended."""
        entry = self.children[self._sharing(name)[0]]
        if entry.process.is_alive() and entry.kill_at is None:
            entry.kill_at = time.monotonic() + STOP_S
            entry.process.terminate()

    def poll(self) -> None:
        """Detect processes that have ended, and restart those whose back-off time has passed."""
        now = time.monotonic()
        for entry in self.children.values():
            if entry.name != self._sharing(entry.name)[0]:
                continue
            if entry.due is not None:
                if now >= entry.due:
                    for name in self._sharing(entry.name):
                        self.children[name].restarts += 1
                    self._start(entry.name, resume=True)
            elif entry.process.is_alive():
                if entry.kill_at is not None and now > entry.kill_at:
                    entry.process.kill()
            elif entry.kill_at is not None:
                entry.due = now
                self._on_event(f"{self.process_name(entry.name)} was ended by request; starts again")
            elif not entry.retiring:
                self._handle_exit(entry, now)
        self._retired = [process for process in self._retired if process.is_alive()]

    def observe(self, reported: dict[str, tuple[str, str]]) -> None:
        """Note which nodes run; call it as often as `poll`.

        Args:
            reported: (instance, state) by node name, from the newest health (`HealthTable.reported`).
        """
        nodes = [entry for entry in self.children.values() if entry.name != ROUTER]
        for entry in nodes:
            instance, state = reported.get(entry.name, ("", ""))
            if instance != entry.instance or state not in ("active", "drain", "drained"):
                continue
            entry.was_active = True
            if entry.failed:
                entry.failed = ""
                self._on_event(f"{entry.name} runs again")
        started = all(entry.was_active or entry.failed for entry in nodes)
        if started or time.monotonic() > self._start_up_until:
            self.starting = False
        finite = [entry.name for entry in nodes if self._service(entry.name).finite]
        if finite and all(reported.get(name, ("", ""))[1] == "drained" for name in finite):
            # The data have ended, and what follows a failed node waits for it without end.
            failed = (e for e in nodes if e.failed and self._is_essential(e.name))
            self.obstacle = self.obstacle or next((f"{e.name} cannot run: {e.failed}" for e in failed), "")

    def _service(self, name: str) -> Service:
        return service_of(self.deployment, name, self.table)

    def _is_essential(self, name: str) -> bool:
        option = self.deployment.nodes[name].get("essential")
        return self._service(name).essential if option is None else bool(option)

    def _handle_failure(self, entry: Child, now: float) -> None:
        """Schedule the next start of a process that has ended with a UserError, or record an obstacle."""
        before, failed, names = entry.failed, self.last_error(entry.name), self._sharing(entry.name)
        for name in names:
            self.children[name].failed = failed
        text = f"{self.process_name(entry.name)} cannot run: {failed}"
        if entry.name != ROUTER and any(
            self._service(name).finite or (self.starting and self._is_essential(name)) for name in names
        ):
            self.obstacle = self.obstacle or text
        delay = entry.delay_after_failure_s(now)
        entry.due = now + delay
        if entry.failed != before and not self.obstacle:  # an obstacle is the error with which the run ends
            self._on_event(f"{text}; tried again in {delay:g} s")

    def _handle_exit(self, entry: Child, now: float) -> None:
        code = entry.process.exitcode or 0
        if code == 2:
            self._handle_failure(entry, now)
            return
        for name in self._sharing(entry.name):
            self.children[name].failed = ""
        delay = entry.delay_after_crash_s(now)
        entry.due = now + delay
        # A drained node runs until it is stopped, so with exit code 0 another program has stopped it.
        how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        why = f"{how}: {self.last_error(entry.name)}"
        self._on_event(f"{self.process_name(entry.name)} died ({why}); starts again in {delay:g} s")

    def stop(self) -> None:
        """Stop the nodes with SIGTERM, sources first, then the router; SIGKILL after `STOP_S`."""
        nodes = [c for c in self.children.values() if c.name != ROUTER]
        end(list(reversed(nodes)))
        for process in self._successors:
            process.kill()
        for process in self._retired:
            process.join(STOP_S)
            process.kill()
        end([c for c in self.children.values() if c.name == ROUTER])
