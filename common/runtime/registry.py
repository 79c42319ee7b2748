"""Services and their implementations ("module:Class"), imported only when a deployment selects them."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from beamsplat.common.config.base import parse
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.optional_packages import missing_packages_explained
from beamsplat.common.plugins import is_class_path, load_class
from beamsplat.common.runtime.node import Node


@dataclass(frozen=True)
class Service:
    """One row of the process list: a node and its implementations ("kinds")."""

    name: str
    summary: str
    kinds: dict[str, str]  # kind -> "module:Class"; the first is the default
    essential: bool = True  # an error at the start ends the run, unless NodeConfig.essential says otherwise
    finite: bool = False  # its data end: an error ends the run at any time, because nothing follows

    def load(self, kind: str) -> type[Node]:
        """Import and return the node class of a kind.

        Args:
            kind: a key of `kinds`, "default", or the path of a class elsewhere, "my_package.my_node:MyNode".

        Raises:
            UserError: no such kind or class, its packages are not installed, or the class is no node of this
                name.
        """
        chosen = next(iter(self.kinds)) if kind == "default" else kind
        if is_class_path(chosen):
            return self._load_class(chosen)
        if chosen not in self.kinds:
            raise UserError(
                f"nodes.{self.name}: there is no kind {kind!r}; the kinds are {', '.join(self.kinds)}, "
                "or 'module:Class' for a class of your own"
            )
        module_name, _, class_name = self.kinds[chosen].partition(":")
        with missing_packages_explained(f"nodes.{self.name} ({chosen})"):
            module = importlib.import_module(module_name)
        return getattr(module, class_name)

    def _load_class(self, path: str) -> type[Node]:
        option = f"nodes.{self.name}.kind"
        found = load_class(path, option)
        if not issubclass(found, Node):
            raise UserError(f"{option} = {path!r}: this class does not derive from {Node.__module__}.Node")
        if found.name != self.name:
            raise UserError(
                f"{option} = {path!r}: the class declares name = {found.name!r}, expected {self.name!r}"
            )
        return found


def node_class_of(service: Service, options: dict[str, object]) -> type[Node]:
    """Return the node class that the option `kind` selects; the other options are not checked.

    `options` is the node's table in a deployment.

    Raises:
        UserError: unknown kind.
    """
    return service.load(str(options.get("kind", "default")))


def make_node(service: Service, options: dict[str, object], where: str) -> Node:
    """Create a node from its table in a deployment; the caller must still call `configure`.

    Args:
        options: the node's table.
        where: name of the deployment file, for error texts.

    Raises:
        UserError: unknown kind or option, or an invalid value.
    """
    node_class = node_class_of(service, options)
    config: NodeConfig = parse(
        node_class.Config, options, f"{where}: node {service.name!r}", f"{service.name}."
    )
    return node_class(config)
