"""Zenoh access control rules of a router, generated from the topic table. The default permission is deny.

Commands with the key `operator` may set any option of a node. Other hosts have no rule that allows them; with
local logins only `ADMIN_USERS` have one.

Other hosts are identified by the common name of their certificate, local processes by their user name. Zenoh
does not report a denied message to its sender; `beamsplat doctor --security` explains the rules. Two details
of Zenoh matter here: `**` does not match the `@adv` keys, by which subscribers recover lost messages; and a
publisher sends nothing until a subscription reaches it, so declarations must be allowed in that direction
too.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from beamsplat.common.config.base import Config
from beamsplat.common.errors import UserError
from beamsplat.common.security.keys import HOSTS
from beamsplat.common.topics import HEALTH, TOPICS

ROOT = "beamsplat"
ADMIN_USERS = ("supervisor", "operator")  # users of a host's router that are not nodes; they may do anything
UNRESTRICTED_CLIENTS = ("page",)  # nodes that may send any query: they forward commands of authorised users
READ_ONLY_QUERIES = ("snapshot", "render", "state", "poses", "keyframe", "params")
_DECLARE = ["declare_subscriber", "declare_queryable", "liveliness_token", "liveliness_query",
            "declare_liveliness_subscriber"]  # fmt: skip
_ANY = ["put", "delete", "query", "reply", *_DECLARE]


class HostRole(Config):
    """Role of another host, which determines its permissions on this host's router.

    robot     publishes its own uplink topics, subscribes to the topics sent down to it
    monitor   subscribes to all topics, sends read-only queries
    operator  subscribes to all topics, sends any query (changes of running nodes)
    edge      the edge server itself; it needs no rule on its own router
    """

    role: Literal["robot", "monitor", "operator", "edge"]
    # The robot whose topics the host may access; "*" = those of all robots.
    robot: Annotated[str, Field(pattern=r"^([a-z0-9][a-z0-9_-]{0,63}|\*)$")] = "*"


def read_hosts(folder: Path) -> dict[str, HostRole]:
    """Read `hosts.toml` in a folder of keys: the role of each host, by certificate name.

    Raises:
        UserError: the file is missing or invalid.
    """
    path = folder.expanduser() / HOSTS
    try:
        return TypeAdapter(dict[str, HostRole]).validate_python(tomllib.loads(path.read_text()))
    except FileNotFoundError as error:
        raise UserError(
            f"{path} is missing: it lists the hosts and their roles; create it with "
            "`beamsplat keys issue NAME --role edge`"
        ) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ValidationError) as error:
        raise UserError(f"{path}: not a table of hosts: {str(error).splitlines()[0]}") from error


def access_control(hosts: dict[str, HostRole]) -> dict[str, Any]:
    """Return Zenoh's `access_control` configuration for a router that other hosts connect to.

    Processes of this host may do anything; other hosts have the permissions of their role.
    """
    rules = [_rule("local", ["ingress", "egress"], _ANY, ["**", "**/@adv/**", "@/**", "@adv/**"])]
    subjects: list[dict[str, Any]] = [{"id": "local", "interfaces": ["lo"], "link_protocols": ["tcp"]}]
    policies = [{"rules": ["local"], "subjects": ["local"]}]
    for name, host in hosts.items():
        if host.role == "edge":
            continue
        own = _robot_rules(name, host.robot) if host.role == "robot" else _reader_rules(name, host)
        rules += own
        subjects.append({"id": name, "cert_common_names": [name], "link_protocols": ["tls", "quic"]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
            "policies": policies}  # fmt: skip


def local_access_control(users: tuple[str, ...]) -> dict[str, Any]:
    """Return Zenoh's `access_control` configuration for a router whose local clients log in by user name.

    A node may publish the topics of which it is a producer and subscribe to all; `ADMIN_USERS` may do
    anything.
    """
    rules, subjects, policies = [], [], []
    for name in users:
        own = [_rule(name, ["ingress", "egress"], _ANY, ["**", "**/@adv/**", "@/**", "@adv/**"])]
        if name not in ADMIN_USERS:
            own = _node_rules(name)
        rules += own
        subjects.append({"id": name, "usernames": [name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
            "policies": policies}  # fmt: skip


def _node_rules(name: str) -> list[dict[str, Any]]:
    # The uplink node publishes for the remote side: the "down" topics and the health of the remote nodes.
    is_bridge = name == "uplink"
    mine = [t for t, row in TOPICS.items() if (row.uplink == "down" if is_bridge else name in row.producers)]
    data = [f"{ROOT}/*/{prefix}{topic}" for topic in mine for prefix in ("", "end/")]
    adv = [f"{key}/@adv/**" for key in data]
    answers = [f"{ROOT}/*/query/{name}/*", f"{ROOT}/*/control/{name}/*/*"]
    everything = [f"{ROOT}/**", f"{ROOT}/**/@adv/**"]
    allowed = ("*",) if name in UNRESTRICTED_CLIENTS else READ_ONLY_QUERIES
    queries = [f"{ROOT}/*/query/*/{query}" for query in allowed]
    health = f"{ROOT}/*/{HEALTH}/{'*' if is_bridge else name}"
    return [
        _rule(f"{name} publish", ["ingress"], ["put", "delete", "reply"], [*data, *adv, health]),
        _rule(f"{name} answer", ["ingress"], ["declare_queryable", "reply"], [*adv, *answers]),
        _rule(f"{name} announce", ["ingress"], ["liveliness_token"], [*adv, f"{ROOT}/*/alive/{name}/*"]),
        _rule(f"{name} subscribe", ["ingress"],
              ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"], everything),
        _rule(f"{name} query", ["ingress"], ["query"], [*queries, everything[1]]),
        _rule(f"{name} receive", ["egress"], ["put", "delete", "reply", *_DECLARE], everything),
        _rule(f"{name} receive queries", ["egress"], ["query"], [*adv, *answers]),
    ]  # fmt: skip


def _rule(id: str, flows: list[str], messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": id, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}


def _keys(robot: str, directions: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Return the key expressions of a robot's topics whose `uplink` is in `directions`.

    They include the `@adv` keys, by which subscribers recover lost messages.
    """
    names = [name for name, row in TOPICS.items() if row.uplink in directions]
    data = [f"{ROOT}/{robot}/{prefix}{name}" for name in names for prefix in ("", "end/")]
    return [*data, f"{ROOT}/{robot}/{HEALTH}/*"], [f"{key}/@adv/**" for key in data]


def _robot_rules(name: str, robot: str) -> list[dict[str, Any]]:
    up, up_adv = _keys(robot, ("up", "bulk"))
    down, down_adv = _keys(robot, ("down",))
    mine = [f"{ROOT}/{robot}/**", f"{ROOT}/{robot}/**/@adv/**"]
    return [
        _rule(f"{name} publish", ["ingress"], ["put", "delete", "reply"], [*up, *up_adv]),
        _rule(f"{name} declare", ["ingress"], ["declare_queryable", "liveliness_token"], up_adv),
        _rule(f"{name} subscribe", ["ingress"],
              ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"],
              [*down, *down_adv]),
        _rule(f"{name} query", ["ingress"], ["query"], down_adv),
        _rule(f"{name} receive", ["egress"], ["put", "delete", "reply"], [*down, *down_adv]),
        _rule(f"{name} receive queries", ["egress"], ["query"], up_adv),
        _rule(f"{name} receive declarations", ["egress"], _DECLARE, mine),
    ]  # fmt: skip


def _reader_rules(name: str, host: HostRole) -> list[dict[str, Any]]:
    everything = [f"{ROOT}/{host.robot}/**", f"{ROOT}/{host.robot}/**/@adv/**"]
    allowed = ["*"] if host.role == "operator" else READ_ONLY_QUERIES
    queries = [f"{ROOT}/{host.robot}/query/*/{query}" for query in allowed]
    return [
        _rule(f"{name} subscribe", ["ingress"],
              ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"], everything),
        _rule(f"{name} query", ["ingress"], ["query"], [*queries, everything[1]]),
        _rule(f"{name} receive", ["egress"],
              ["put", "delete", "reply", "declare_queryable", "liveliness_token"], everything),
    ]  # fmt: skip
