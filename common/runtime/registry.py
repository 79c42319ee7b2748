"""Implementations chosen by name: "module:Class", imported only when chosen."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from beamsplat.common.config.base import parse
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.node import Node


@dataclass(frozen=True)
class Service:
    """One row of the process list: a node, and the kinds there are of it."""

    name: str
    summary: str
    kinds: dict[str, str]  # kind -> "module:Class"; the first is the default
    extra: str = ""  # what `pip install beamsplat[extra]` it needs, beyond the robot's

    def load(self, kind: str) -> type[Node]:
        """The node class of a kind.

        Raises:
            UserError: no such kind, or its packages are not installed.
        """
        chosen = next(iter(self.kinds)) if kind == "default" else kind
        if chosen not in self.kinds:
            raise UserError(f"{self.name} has no kind {kind!r}; there are {', '.join(self.kinds)}")
        module_name, _, class_name = self.kinds[chosen].partition(":")
        try:
            module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            remedy = f"pip install 'beamsplat[{self.extra}]'" if self.extra else "make setup"
            raise UserError(f"{self.name} ({chosen}) needs the package {error.name}: {remedy}") from error
        return getattr(module, class_name)


def class_of(service: Service, options: dict[str, object]) -> type[Node]:
    """The node class that a node's table in a deployment asks for; its other options are not looked at.

    Raises:
        UserError: unknown kind.
    """
    return service.load(str(options.get("kind", "default")))


def make_node(service: Service, options: dict[str, object], where: str) -> Node:
    """A configured-to-be node from its table in a deployment.

    Raises:
        UserError: unknown kind or option, or a value that does not fit.
    """
    node_class = class_of(service, options)
    config: NodeConfig = parse(node_class.Config, options, f"{where}: node {service.name!r}")
    return node_class(config)
