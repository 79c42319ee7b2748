"""Deployment files: one TOML says which services run, with which options. Strict: nothing is repaired.

robot = "robot1"

[router]
listen = ["tcp/127.0.0.1:7447"]

[nodes.replay]
data = "drive/bag"

[nodes.localization]
kind = "lidar"
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints

from beamsplat.common.config.base import Config, parse
from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.resources import deployment_file
from beamsplat.common.security.keys import OPEN, SecurityConfig

Token = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]


# Which part of a system a deployment is: topics that cross the uplink are fed by the other part.
Role = Literal["whole", "robot", "edge"]
Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class NodeConfig(Config):
    """Options that every node has."""

    kind: str = "default"  # which implementation, by name (services/nodes.py lists them)
    step_cost_s: Seconds = 0.0  # lockstep: modelled time of one step
    job_cost_s: Seconds = 0.0  # lockstep: modelled time of a background job
    threads: Annotated[int, Field(ge=1)] = 1  # for cv2, torch and ONNX in this process
    nice: Annotated[int, Field(ge=0, le=19)] = 0  # niceness of this process: who waits when cores are short


class RouterConfig(Config):
    """The router of this host: where it listens, and the routers it connects out to."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()


class Deployment(Config):
    """One parsed deployment file; `nodes` holds raw tables until a node's own Config checks them."""

    robot: Token = "robot1"
    router: RouterConfig = RouterConfig()
    rate: Annotated[float, Field(ge=0.0)] = 1.0  # replayed data: times real time; 0 = as fast as possible
    state_dir: Path | None = None
    role: Role = "whole"
    security: SecurityConfig = OPEN
    nodes: dict[Token, dict[str, Any]] = Field(default_factory=dict)

    @property
    def run_dir(self) -> Path:
        """Where epochs, logs and other state of this robot live."""
        if self.state_dir is not None:
            return self.state_dir.expanduser()
        base = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
        return Path(base).expanduser() / "beamsplat" / self.robot


def load_deployment(path: Path, overrides: tuple[str, ...] = ()) -> Deployment:
    """The deployment in a TOML file, with `node.key=value` (or `key=value`) overrides applied.

    Where the working directory has no such file, the one shipped with the package of that name is read.
    Relative paths inside the file are relative to the working directory, as on a command line.

    Raises:
        UserError: no such file, not TOML, or a value that does not fit; names file, field and value.
    """
    path = deployment_file(path)
    try:
        table = tomllib.loads(path.read_text())
    except FileNotFoundError as error:
        raise UserError(f"{path}: no such deployment file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise UserError(f"{path}: not a TOML file: {reason(error)}") from error
    for override in overrides:
        _apply(table, override)
    return parse(Deployment, table, str(path))


def with_overrides(deployment: Deployment, overrides: tuple[str, ...]) -> Deployment:
    """A copy with `node.key=value` overrides applied to its nodes.

    Raises:
        UserError: an override that does not fit.
    """
    table: dict[str, Any] = {"nodes": {name: dict(options) for name, options in deployment.nodes.items()}}
    for override in overrides:
        _apply(table, override)
    if set(table) != {"nodes"}:
        raise UserError(f"{', '.join(overrides)}: only options of nodes can be changed in a running system")
    return deployment.model_copy(update={"nodes": table["nodes"]})


def _apply(table: dict[str, Any], override: str) -> None:
    """Sets one dotted `key=value` in a raw table; a first key that names no option names a node."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {override!r}: expected NODE.OPTION=VALUE, for example replay.data=drive/bag")
    if len(parts) > 1 and parts[0] not in Deployment.model_fields:
        parts.insert(0, "nodes")
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise UserError(f"--set {override!r}: {part!r} is a value, not a table")
    table[parts[-1]] = _toml_value(text.strip())


def _toml_value(text: str) -> Any:
    """A TOML value; what is no TOML (a bare word, a path) is a string."""
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text
