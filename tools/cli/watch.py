"""Commands that show the state of a system: top, topics, graph."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.live import Live as Screen

from beamsplat.common.config.deployment import load_deployment
from beamsplat.tools.cli.system import FileArgument, SetOption

if TYPE_CHECKING:
    from beamsplat.tools.system.health_table import HealthTable

SecondsOption = Annotated[float | None, typer.Option(min=0.0, help="Stop after this long; default: Ctrl-C")]
SNAPSHOT_S = 3.0  # nodes report once per second, and a rate needs two reports


@contextlib.contextmanager
def _board(file: Path, overrides: list[str] | None, every_robot: bool) -> Iterator[HealthTable]:
    """Connect to a running system; yield the health table of its nodes.

    `file` is the deployment, `every_robot` includes the nodes of all robots that its router reaches.

    Raises:
        UserError: no router answers.
    """
    from beamsplat.common.config.alerts import alert_rules
    from beamsplat.common.security.logins import OPERATOR, login_of
    from beamsplat.common.zenoh.bus import open_session
    from beamsplat.tools.system.health_table import ALL, HealthTable

    deployment = load_deployment(file, tuple(overrides or ()))
    login = login_of(deployment.security, OPERATOR)
    rules = alert_rules(deployment, str(file))
    with open_session(deployment.router.listen, 2.0, login=login) as session:
        yield HealthTable(session, ALL if every_robot else deployment.robot, rules=rules)


def _watch(board: HealthTable, table: str, seconds: float | None) -> None:
    draw = getattr(board, table)
    deadline = time.monotonic() + (seconds if seconds is not None else 1e12)
    with Screen(console=Console(), refresh_per_second=2) as screen, contextlib.suppress(KeyboardInterrupt):
        while time.monotonic() < deadline:
            time.sleep(0.25)
            screen.update(draw())


def top(
    file: FileArgument,
    seconds: SecondsOption = None,
    set_: SetOption = None,
    every_robot: Annotated[
        bool, typer.Option("--all", help="Nodes of all robots that this router reaches")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON object after --seconds (default 3) instead of a table"),
    ] = False,
) -> None:
    """Show a live table of the nodes: process, state, rates, step time, age, drops, memory, CPU; and alerts.

    Alerts follow the rules of the table [nodes.page.alerts] of the deployment. A pending one has not held for
    `hold_s` yet.

    Examples:

        beamsplat top deploy/robot.toml

        beamsplat top deploy/edge.toml --all

        beamsplat top deploy/robot.toml --json
    """
    with _board(file, set_, every_robot) as board:
        if as_json:
            time.sleep(SNAPSHOT_S if seconds is None else seconds)
            print(json.dumps(board.snapshot()))
        else:
            _watch(board, "nodes_table", seconds)


def topics(file: FileArgument, seconds: SecondsOption = None, set_: SetOption = None) -> None:
    """Show a live table of the topics: producer, rate, consumers and their latency.

    Example: beamsplat topics deploy/robot.toml
    """
    with _board(file, set_, False) as board:
        _watch(board, "topics_table", seconds)


def graph(
    file: FileArgument,
    mermaid: Annotated[bool, typer.Option(help="As a Mermaid flowchart")] = False,
) -> None:
    """Show the dataflow of a deployment.

    Example: beamsplat graph deploy/demo.toml --mermaid
    """
    from beamsplat.tools.system.assembly import node_classes
    from beamsplat.tools.system.graph import as_mermaid, as_text

    classes = node_classes(load_deployment(file))
    print(as_mermaid(classes) if mermaid else as_text(classes))
