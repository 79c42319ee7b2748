"""Commands that run a system: check, run, serve, offline, record, router-config."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer
from rich.console import Console
from rich.live import Live as Screen

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.tools.cli.memory_option import GpuMemoryOption, MemoryOption, memory_overrides
from beamsplat.tools.cli.options import writable

if TYPE_CHECKING:
    from beamsplat.tools.system.health_table import HealthTable
    from beamsplat.tools.system.run_summary import RunSummary
    from beamsplat.tools.system.supervisor import Supervisor

FileArgument = Annotated[Path, typer.Argument(help="Deployment file (TOML), for example deploy/demo.toml")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NODE.OPTION=VALUE", help="Override an option of the file; repeatable"),
]
STATUS_S = 5.0  # between two lines of a run whose output is a file
console = Console(stderr=True, width=None if sys.stderr.isatty() else 120)


def _load(file: Path, overrides: list[str] | None) -> Deployment:
    return load_deployment(file, tuple(overrides or ()))


def _say(text: str, style: str | None = None) -> None:
    """Print text without interpreting brackets as markup."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def check(file: FileArgument, set_: SetOption = None) -> None:
    """Check whether a deployment can run here, and report every error.

    Example: beamsplat check deploy/demo.toml
    """
    from beamsplat.tools.system.assembly import faults, missing_resources

    deployment = _load(file, set_)
    found = faults(deployment)
    if not any(fault.fatal for fault in found):
        found += missing_resources(deployment)
    for fault in found:
        _say(f"{file}: {fault.text}", "red" if fault.fatal else "yellow")
    if any(fault.fatal for fault in found):
        raise typer.Exit(2)
    print(f"{file}: {len(deployment.nodes)} nodes, fits together")


def _checked(deployment: Deployment, names: tuple[str, ...] | None = None) -> Deployment:
    from beamsplat.tools.system.assembly import faults, missing_resources

    fatal = [fault.text for fault in faults(deployment) if fault.fatal]
    fatal = fatal or [fault.text for fault in missing_resources(deployment, names)]
    if fatal:
        raise UserError("; ".join(fatal))
    return deployment


def run(
    file: FileArgument,
    nodes: Annotated[list[str] | None, typer.Argument(help="Only these (and `router`); default: all")] = None,
    set_: SetOption = None,
    rate: Annotated[
        float | None, typer.Option(min=0.0, help="Replay at N times real time; 0 = flat out")
    ] = None,
    memory: MemoryOption = None,
    gpu_memory: GpuMemoryOption = None,
) -> None:
    """Run a deployment: a router and one supervised process per node.

    Ends at the end of recorded data, or with Ctrl-C. Logs are written to the robot's state folder.

    Examples:

        beamsplat run deploy/demo.toml --set replay.data=drive/bag

        beamsplat run deploy/edge.toml --memory 1GB --set mapping.session=map

        beamsplat run deploy/edge.toml --gpu-memory 2GB --set mapping.session=map

        beamsplat run deploy/robot.toml router localization
    """
    deployment = _load(file, [*memory_overrides(memory, gpu_memory), *(set_ or ())])
    if rate is not None:
        deployment = deployment.model_copy(update={"rate": rate})
    run_checked(deployment, tuple(nodes) if nodes else None).check_useful()


def show_summary(summary: RunSummary) -> None:
    """Print what a run has refused, dropped and lost."""
    for line in summary.lines():
        _say(line)


class RunMonitor(Protocol):
    """Interface of an observer of a running deployment."""

    def poll(self) -> None:
        """Observe the running system; it is called several times per second."""

    def finish(self, board: HealthTable, drained: bool) -> Any:
        """End the observation; it is called once, before the processes are stopped.

        Args:
            board: health of all nodes.
            drained: whether all nodes have finished their work.
        """


class _Display:
    """Display of the nodes' state on standard error: a table in a terminal, else a line every few seconds."""

    def __init__(self, board: HealthTable) -> None:
        self._board = board
        self._screen = Screen(console=console, refresh_per_second=2) if sys.stderr.isatty() else None
        self._began = self._written = time.monotonic()

    def __enter__(self) -> _Display:
        if self._screen is not None:
            self._screen.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._screen is not None:
            self._screen.__exit__(kind, error, traceback)
        elif kind is None:
            console.print(self._board.nodes_table())

    def update(self) -> None:
        """Show the newest state of the nodes; call this several times per second."""
        now = time.monotonic()
        if self._screen is not None:
            self._screen.update(self._board.nodes_table())
        elif now - self._written >= STATUS_S:
            self._written = now
            _say(f"{now - self._began:.0f} s: {self._board.status_line()}")
            sys.stderr.flush()


def run_checked(
    deployment: Deployment,
    names: tuple[str, ...] | None = None,
    monitor: Callable[[Supervisor], RunMonitor] | None = None,
) -> RunSummary:
    """Run processes until all have drained, or Ctrl-C. Nodes that cannot run are tried again, and left out.

    At the end it prints, and returns, what was refused, dropped and lost.

    Args:
        names: nodes to run, and `router`; None runs all.
        monitor: creates an observer of the run from its supervisor.

    Raises:
        UserError: the deployment is invalid, or an essential node cannot run at the start.
    """
    for name in names or ():
        if name != "router" and name not in deployment.nodes:
            there = ", ".join(("router", *deployment.nodes))
            raise UserError(f"the deployment has no node {name!r}; there are {there}")
    _checked(deployment, names)
    from beamsplat.common.security.logins import SUPERVISOR, login_of
    from beamsplat.common.zenoh.bus import open_session
    from beamsplat.tools.system.commands import Commands
    from beamsplat.tools.system.failure_reports import FailureReports
    from beamsplat.tools.system.health_table import HealthTable
    from beamsplat.tools.system.run_summary import RunSummary
    from beamsplat.tools.system.supervisor import ROUTER, Supervisor

    for number in (signal.SIGTERM, signal.SIGHUP):  # stop the children in order, as Ctrl-C does
        signal.signal(number, signal.default_int_handler)
    with Supervisor(deployment, names, on_event=lambda text: _say(text, "yellow")) as supervisor:
        _say(f"robot {deployment.robot}: logs in {supervisor.log_dir}")
        login = login_of(deployment.security, SUPERVISOR)
        with open_session(deployment.router.listen, login=login) as session:
            board = HealthTable(session, deployment.robot)
            observer = monitor(supervisor) if monitor is not None else None
            commands = Commands(session, deployment.robot, supervisor)
            failures = FailureReports(session, deployment.robot, supervisor)
            drained = False
            with _Display(board) as display, contextlib.suppress(KeyboardInterrupt):
                while not drained:
                    time.sleep(0.02 if commands.busy else 0.2)
                    supervisor.poll()
                    supervisor.observe(board.reported())
                    failures.poll()
                    if observer is not None:
                        observer.poll()
                    commands.answer_pending()
                    display.update()
                    if supervisor.obstacle:
                        raise UserError(supervisor.obstacle)
                    nodes = [c for c in supervisor.children.values() if c.name != ROUTER and not c.failed]
                    states = board.states()
                    drained = bool(nodes) and all(states.get(c.name) == "drained" for c in nodes)
            if observer is not None:
                observer.finish(board, drained)
            failed = {c.name: c.failed for c in supervisor.children.values() if c.failed}
            summary = RunSummary.of_records(board.records, failed)
    show_summary(summary)
    return summary if drained else replace(summary, missing=())  # what was stopped may have begun just now


def serve(
    file: FileArgument,
    node: Annotated[str, typer.Argument(help="Name of the node, or `router`")],
    set_: SetOption = None,
) -> None:
    """Run one node in this process, without supervision (for debuggers, systemd, containers).

    Example: beamsplat serve deploy/robot.toml localization
    """
    from beamsplat.tools.system.node_process import route, serve_alone, start_logging
    from beamsplat.tools.system.process_title import set_process_title

    deployment = _load(file, set_)
    start_logging()
    set_process_title(f"beamsplat:{node}", arguments=False)
    if node == "router":
        route(deployment)
    else:
        serve_alone(deployment, node)


def router_config(file: FileArgument, set_: SetOption = None) -> None:
    """Print the configuration of a deployment's router for `zenohd -c`, to run that instead.

    It contains the present policy: print it again after `beamsplat keys issue` or `remove`.

    Example: beamsplat router-config deploy/edge.toml > router.json5
    """
    from beamsplat.common.zenoh.bus import router_config as config_of

    deployment = _load(file, set_)
    print(config_of(deployment.router.listen, deployment.router.connect, deployment.security))


def offline(
    file: FileArgument,
    out: Annotated[Path, typer.Option(callback=writable, help="Folder for messages.mcap and summary.json")],
    data: Annotated[Path | None, typer.Option(help="Bag, recording or folder for the replay node")] = None,
    set_: SetOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as one JSON object")] = False,
) -> None:
    """Run a deployment in lockstep: one thread, no bus, as fast as possible, reproducible.

    The same input produces the same bytes: summary.json contains a SHA-256 over all messages.

    Example: beamsplat offline deploy/demo.toml --data drive/bag --out out/
    """
    from beamsplat.tools.system.offline import OUTSIDE, run_offline
    from beamsplat.tools.system.run_summary import RunSummary

    deployment = _load(file, set_)
    nodes = {name: table for name, table in deployment.nodes.items() if name not in OUTSIDE}
    if data is not None:
        nodes["replay"] = {**nodes.get("replay", {}), "data": str(data)}
    deployment = deployment.model_copy(update={"nodes": nodes})
    summary = run_offline(_checked(deployment), out, console)
    if as_json:
        print(json.dumps(summary))
    else:
        console.print(f"{summary['messages']} messages in {summary['wall_s']:.1f} s, SHA-256 "
                      f"{summary['sha256'][:16]}..., in {out}", soft_wrap=True)  # fmt: skip
    end = RunSummary(summary["refused"], tuple(summary["missing"]))
    show_summary(end)
    end.check_useful()


def record(
    file: FileArgument,
    out: Annotated[Path, typer.Option(callback=writable, help="Folder of the recording to write")],
    set_: SetOption = None,
) -> None:
    """Record the topics of a running deployment to MCAP, until Ctrl-C or the end of the data.

    Example: beamsplat record deploy/robot.toml --out drive1
    """
    from beamsplat.tools.system.node_process import serve_alone, start_logging

    if out.exists():
        raise UserError(f"{out} exists: a recording is never overwritten, choose another --out")
    deployment = _load(file, set_)
    options = {**deployment.nodes.get("recorder", {}), "out": str(out)}
    deployment = deployment.model_copy(update={"nodes": {**deployment.nodes, "recorder": options}})
    start_logging()
    serve_alone(deployment, "recorder")
    print(f"recorded to {out}")
