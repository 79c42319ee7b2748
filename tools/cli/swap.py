"""`beamsplat swap` and `beamsplat params`: options of a node of a running system."""

from __future__ import annotations

import json
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import typer

from beamsplat.common.config.deployment import load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer

app = typer.Typer(no_args_is_help=True, help="Options of the nodes of a running system.")
FileArgument = Annotated[Path, typer.Argument(help="Deployment file of the running system")]
NodeArgument = Annotated[str, typer.Argument(help="Name of the node")]
ColdOption = Annotated[
    bool, typer.Option("--cold", help="Stop the node first: for nodes that cannot hand over their state")
]
FileSetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="OPTION=VALUE", help="Override that `run` was given, such as router.listen"
    ),
]
_PATIENCE_S = 150.0  # loading a model can take minutes


def _ask(
    file: Path, node: str, verb: str, parameters: dict[str, str], overrides: list[str] | None = None
) -> str:
    from beamsplat.common.security.logins import OPERATOR, login_of
    from beamsplat.common.zenoh.bus import open_session
    from beamsplat.common.zenoh.queries import OPERATOR_QUERY, QUERY, NoQueryAnswer, ask

    deployment = load_deployment(file, tuple(overrides or ()))
    if node not in (*deployment.nodes, "router"):
        near = get_close_matches(node, deployment.nodes, 1)
        meant = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(deployment.nodes)}"
        raise UserError(f"{file} has no node {node!r}; {meant}")
    login = login_of(deployment.security, OPERATOR)
    with open_session(deployment.router.listen, 2.0, login=login) as session:
        prefix = OPERATOR_QUERY
        try:
            list(ask(session, deployment.robot, node, "params", {}, 2.0, prefix))
        except NoQueryAnswer:  # the node runs on another host, which decides what may be set from here
            prefix = QUERY
        except UserError:  # of the router, which has no options
            pass
        (answer,) = ask(session, deployment.robot, node, verb, parameters, _PATIENCE_S, prefix)
    assert isinstance(answer, Answer)  # the type of all answers to commands
    return answer.text


def _swap(file: Path, node: str, changes: list[str], cold: bool, overrides: list[str] | None = None) -> None:
    for change in changes:
        if "=" not in change:
            raise UserError(f"{change!r}: expected OPTION=VALUE, for example source=stixel")
    parameters = {"set": quote(json.dumps(changes)), **({"cold": "1"} if cold else {})}
    print(_ask(file, node, "swap", parameters, overrides))


def swap(
    file: FileArgument,
    node: NodeArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="OPTION=VALUE", help="An option to change; repeatable"),
    ] = None,
    cold: ColdOption = False,
) -> None:
    """Replace a node by a process with other options while the system runs.

    The successor loads beside the node, then takes over between two messages: no message is published twice,
    and none is lost. The changes last until the system is stopped.

    Examples:

        beamsplat swap deploy/robot.toml depth --set source=depth_anything

        beamsplat swap deploy/edge.toml mapping --set half_steps=30
    """
    _swap(file, node, set_ or [], cold)


@app.command()
def get(file: FileArgument, node: NodeArgument, overrides: FileSetOption = None) -> None:
    """Print the options of a running node, defaults included, as JSON.

    Example: beamsplat params get deploy/robot.toml depth
    """
    print(_ask(file, node, "params", {}, overrides))


@app.command(name="set")
def set_params(
    file: FileArgument,
    node: NodeArgument,
    changes: Annotated[list[str], typer.Argument(metavar="OPTION=VALUE...", help="What to change")],
    cold: ColdOption = False,
    overrides: FileSetOption = None,
) -> None:
    """Change options of a running node by a successor that takes over, as `beamsplat swap` does.

    Example: beamsplat params set deploy/robot.toml depth floor_known=false
    """
    _swap(file, node, changes, cold, overrides)
