"""Create the nodes of a deployment, and check that their options and topics are consistent."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

from beamsplat.common.config.deployment import Deployment, Role
from beamsplat.common.errors import UserError
from beamsplat.common.plugins import is_class_path
from beamsplat.common.runtime.node import Node, subscriptions
from beamsplat.common.runtime.registry import Service, make_node, node_class_of
from beamsplat.common.security.access_control import ADMIN_USERS
from beamsplat.common.security.keys import HostKeys, check_endpoint, is_secure
from beamsplat.common.topics import TOPICS
from beamsplat.services.nodes import NODES

RESERVED = ("router", *ADMIN_USERS)  # users and processes of a running system that are not nodes


@dataclass(frozen=True)
class Fault:
    """An error in a deployment; with a `fatal` error the deployment cannot run."""

    text: str
    fatal: bool = True


def build_node(deployment: Deployment, name: str, table: dict[str, Service] = NODES) -> Node:
    """Create the node called `name` with its options in the deployment.

    `table` contains the known services by name.

    Raises:
        UserError: the deployment has no such node, `table` has no such service, or an option is invalid.
    """
    return make_node(service_of(deployment, name, table), deployment.nodes[name], "deployment")


def service_of(deployment: Deployment, name: str, table: dict[str, Service]) -> Service:
    """Return the row of `table` for the node called `name`, or a row for a node defined outside this package.

    Raises:
        UserError: the deployment has no such node, or `table` has no such service.
    """
    if name not in deployment.nodes:
        known = ", ".join(deployment.nodes) or "none"
        raise UserError(f"the deployment has no node {name!r}; it has {known}")
    if name in table:
        return table[name]
    kind = str(deployment.nodes[name].get("kind", ""))
    if is_class_path(kind):
        if name in RESERVED:
            raise UserError(f"nodes.{name}: this name is reserved; choose another for a node of your own")
        return Service(name, "defined outside this package", {kind: kind})
    near = get_close_matches(name, table, 1)
    meant = f"did you mean {near[0]!r}? " if near else ""
    raise UserError(
        f"nodes.{name}: no such service; {meant}there are {', '.join(table)}; a node of your own needs "
        'kind = "module:Class"'
    )


def node_classes(deployment: Deployment, table: dict[str, Service] = NODES) -> dict[str, type[Node]]:
    """Return the class of each node of a deployment by name; only the option `kind` is checked."""
    return {
        name: node_class_of(service_of(deployment, name, table), options)
        for name, options in deployment.nodes.items()
    }


def faults(deployment: Deployment, table: dict[str, Service] = NODES) -> list[Fault]:
    """Return the errors of a deployment.

    They are unknown nodes, invalid options, topics with two producers, nodes without any input, a robot
    without uplink, and unknown nodes that are to share a process.
    """
    found: list[Fault] = []
    classes: dict[str, type[Node]] = {}
    for name in deployment.nodes:
        try:
            classes[name] = type(build_node(deployment, name, table))
        except UserError as error:
            found.append(Fault(str(error)))
    found += [Fault(text) for text in _together_faults(deployment)]
    producers: dict[str, list[str]] = {topic: [] for topic in TOPICS}
    for name, node_class in classes.items():
        for topic in node_class.outputs:
            producers[topic].append(name)
    for topic in _uplink_topics(deployment.role):
        producers[topic].append("the uplink")
    for topic, names in producers.items():
        if len(names) > 1:
            found.append(
                Fault(f"{topic} would be published by {' and '.join(names)}: only one may publish it")
            )
    for name, node_class in classes.items():
        missing = [i.topic for i in subscriptions(node_class) if not producers[i.topic]]
        whole = len(classes) == len(deployment.nodes)  # else the missing producer may be a node with errors
        if whole and missing and len(missing) == len(node_class.inputs):
            found.append(Fault(f"nothing in this deployment feeds {name}: {', '.join(missing)}", fatal=False))
    if deployment.role == "robot" and "uplink" not in deployment.nodes:
        found.append(Fault('role = "robot" without node uplink: nothing reaches an edge server', fatal=False))
    return found


def _together_faults(deployment: Deployment) -> list[str]:
    """Return the errors in the list of nodes that share a process."""
    together, known = deployment.together, ", ".join(deployment.nodes)
    found = [
        f"together: the deployment has no node {name!r}; it has {known}"
        for name in together
        if name not in deployment.nodes
    ]
    found += [f"together: {name!r} is named twice" for name in set(together) if together.count(name) > 1]
    if len(together) == 1:
        found.append(f"together = [{together[0]!r}]: name at least two nodes, or leave it out")
    return found


def missing_resources(
    deployment: Deployment, names: tuple[str, ...] | None = None, table: dict[str, Service] = NODES
) -> list[Fault]:
    """Return an error for each resource of a deployment that this host lacks, such as a file or a key.

    Call it only for a deployment without errors.

    Args:
        names: the nodes to run, and `router`; None checks all.
    """
    found = []
    for name in names or tuple(deployment.nodes):
        if name in deployment.nodes:
            try:
                build_node(deployment, name, table).check_resources()
            except UserError as error:
                found.append(Fault(f"nodes.{name}: {error}"))
    return found + [Fault(text) for text in _link_faults(deployment, names)]


def _link_faults(deployment: Deployment, names: tuple[str, ...] | None) -> list[str]:
    """Return why links to other hosts would be refused, as texts: unprotected endpoints, missing keys."""
    endpoints: tuple[str, ...] = ()
    if names is None or "router" in names:
        endpoints = (*deployment.router.listen, *deployment.router.connect)
    if "uplink" in (names or deployment.nodes):
        endpoints += (str(deployment.nodes.get("uplink", {}).get("edge", "")),)
    found = []
    try:
        for endpoint in filter(None, endpoints):
            check_endpoint(endpoint, deployment.security)
        if any(map(is_secure, endpoints)):
            HostKeys.of(deployment.security)
    except UserError as error:
        found.append(str(error))
    return found


@dataclass(frozen=True)
class Surroundings:
    """Facts about the other nodes of a deployment that one node needs."""

    wait_for: frozenset[str]  # a source starts when these are active, so that they receive every message
    without_producer: frozenset[str]  # inputs that no node here produces: the node does not wait for them


def surroundings(classes: dict[str, type[Node]], name: str, role: Role = "whole") -> Surroundings:
    """Return for the node called `name` which nodes it waits for, and which of its inputs have no producer.

    Args:
        classes: the class of every node of the deployment, by name.
        role: role of the host; the uplink publishes additional topics on a robot and on an edge server.
    """
    fed = {topic for node in classes.values() for topic in node.outputs} | _uplink_topics(role)
    listeners = frozenset(other for other, node in classes.items() if node.inputs and other != name)
    return Surroundings(
        wait_for=listeners if classes[name].is_source() and classes[name].outputs else frozenset(),
        without_producer=frozenset(
            entry.topic for entry in subscriptions(classes[name]) if entry.topic not in fed
        ),
    )


def _uplink_topics(role: Role) -> set[str]:
    """Return the topics that the uplink publishes on this host.

    On an edge server they are the topics sent by robots, on a robot the topics sent by the edge server.
    """
    ways = {"whole": (), "robot": ("down",), "edge": ("up", "bulk")}[role]
    return {name for name, row in TOPICS.items() if row.uplink in ways}
