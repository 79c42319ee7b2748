"""Deployment files: a TOML file that lists the services to run and their options. Validation is strict.

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
from beamsplat.common.security.keys import NO_SECURITY, SecurityConfig

Token = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]


# The part of a system that a deployment runs. In a "robot" or "edge" deployment the bridge supplies the
# topics that the other part publishes.
Role = Literal["whole", "robot", "edge"]
Seconds = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class NodeConfig(Config):
    """Options that all nodes have."""

    kind: str = "default"  # name of the implementation (services/nodes.py lists them)
    step_cost_s: Seconds = 0.0  # lockstep only: modelled duration of one step
    job_cost_s: Seconds = 0.0  # lockstep only: modelled duration of a background job
    idle_cost_s: Seconds = 0.0  # lockstep only: modelled duration of a piece of work without a message
    threads: Annotated[int, Field(ge=1)] = 1  # for cv2, torch and ONNX in this process
    nice: Annotated[int, Field(ge=0, le=19)] = 0  # nice value of the process: higher = lower CPU priority
    essential: bool | None = None  # whether an error at the start ends the run; None: as in services/nodes.py


class RouterConfig(Config):
    """Zenoh endpoints of this host's router: where it listens, and the routers it connects to."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()


class Deployment(Config):
    """A parsed deployment file; the tables in `nodes` are raw until each node's own Config validates them."""

    robot: Token = "robot1"
    router: RouterConfig = RouterConfig()
    rate: Annotated[float, Field(ge=0.0)] = 1.0  # replay speed in multiples of real time; 0 = maximum
    state_dir: Path | None = None
    role: Role = "whole"
    security: SecurityConfig = NO_SECURITY
    together: tuple[Token, ...] = ()  # nodes of this host that share one process, for small robots
    nodes: dict[Token, dict[str, Any]] = Field(default_factory=dict)

    def sharing(self, name: str) -> tuple[str, ...]:
        """Return the nodes in the process of the node `name`, itself included, in the order of `together`."""
        return self.together if name in self.together else (name,)

    @property
    def run_dir(self) -> Path:
        """Folder of this robot's persistent state: epochs, logs, replay positions."""
        if self.state_dir is not None:
            return self.state_dir.expanduser()
        base = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
        return Path(base).expanduser() / "beamsplat" / self.robot


def load_deployment(path: Path, overrides: tuple[str, ...] = ()) -> Deployment:
    """Read a deployment from a TOML file and apply `node.key=value` (or `key=value`) overrides.

    If the file does not exist, the deployment of that name shipped with the package is read.
    Relative paths inside the file are relative to the working directory, as on a command line.

    Raises:
        UserError: the file is missing, not TOML, or has an invalid value; names file, field and value.
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
    return parse(Deployment, table, str(path), "")


def with_overrides(deployment: Deployment, overrides: tuple[str, ...]) -> Deployment:
    """Return a copy of the deployment with `node.key=value` overrides applied to its nodes.

    Raises:
        UserError: an override is malformed or does not name a node's option.
    """
    table: dict[str, Any] = {"nodes": {name: dict(options) for name, options in deployment.nodes.items()}}
    for override in overrides:
        _apply(table, override)
    if set(table) != {"nodes"}:
        raise UserError(f"{', '.join(overrides)}: a running system accepts changes of node options only")
    return deployment.model_copy(update={"nodes": table["nodes"]})


def _apply(table: dict[str, Any], override: str) -> None:
    """Set one dotted `key=value` in a raw table; a first key that is no deployment option is a node name."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {key!r}: expected NODE.OPTION=VALUE, for example replay.data=drive/bag")
    if len(parts) > 1 and parts[0] not in Deployment.model_fields:
        parts.insert(0, "nodes")
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise UserError(f"--set {key!r}: {part!r} is a value, not a table")
    table[parts[-1]] = _toml_value(text.strip())


def _toml_value(text: str) -> Any:
    """Parse a TOML value; text that is not valid TOML (a bare word, a path) is taken as a string."""
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text
