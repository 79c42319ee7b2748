"""What a router lets other hosts do, generated from the topic table: whatever is not allowed is denied.

Hosts are known by the name in their certificate. Zenoh says nothing when it refuses, so `beamsplat doctor
--security` explains. Two traps: `**` does not match the `@adv` keys, by which subscribers recover what they
missed; and a subscription from this side must be allowed to reach a publisher, or it never sends.
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
MASTERS = ("supervisor", "operator")  # users of a host's router who are no node
ASKS_ANYTHING = ("page",)  # nodes that pass commands on, of who has their token
READ_ONLY_QUERIES = ("snapshot", "state", "params")
_DECLARE = ["declare_subscriber", "declare_queryable", "liveliness_token", "liveliness_query",
            "declare_liveliness_subscriber"]  # fmt: skip
_ANY = ["put", "delete", "query", "reply", *_DECLARE]


class Host(Config):
    """What one host may do: a robot writes what crosses the uplink under its own name, a monitor reads, an
    operator reads and asks nodes for changes, an edge is the server itself."""

    role: Literal["robot", "monitor", "operator", "edge"]
    robot: Annotated[str, Field(pattern=r"^([a-z0-9][a-z0-9_-]{0,63}|\*)$")] = "*"  # whose; "*" = all robots'


def read_hosts(folder: Path) -> dict[str, Host]:
    """The hosts in a folder of keys, by certificate name.

    Raises:
        UserError: no such file, or not what `beamsplat keys` writes.
    """
    path = folder.expanduser() / HOSTS
    try:
        return TypeAdapter(dict[str, Host]).validate_python(tomllib.loads(path.read_text()))
    except FileNotFoundError as error:
        raise UserError(
            f"{path} is missing: it says which hosts may do what; `beamsplat keys issue NAME --role edge` "
            "writes it"
        ) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ValidationError) as error:
        raise UserError(f"{path}: not a table of hosts: {str(error).splitlines()[0]}") from error


def access_control(hosts: dict[str, Host]) -> dict[str, Any]:
    """Zenoh's `access_control` for a router: all for processes of this host, the rest by certificate."""
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
    """Zenoh's `access_control` for a router whose clients log in: a node writes what it produces by the topic
    table, and reads all; those of ours that are no node (supervisor, operator) may do anything."""
    rules, subjects, policies = [], [], []
    for name in users:
        own = [_rule(name, ["ingress", "egress"], _ANY, ["**", "**/@adv/**", "@/**", "@adv/**"])]
        if name not in MASTERS:
            own = _node_rules(name)
        rules += own
        subjects.append({"id": name, "usernames": [name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
            "policies": policies}  # fmt: skip


def _node_rules(name: str) -> list[dict[str, Any]]:
    # The uplink speaks for the other side: what comes down, and the health of who is there.
    relays = name == "uplink"
    mine = [t for t, row in TOPICS.items() if (row.uplink == "down" if relays else name in row.producers)]
    data = [f"{ROOT}/*/{prefix}{topic}" for topic in mine for prefix in ("", "end/")]
    adv = [f"{key}/@adv/**" for key in data]
    answers = [f"{ROOT}/*/query/{name}/*", f"{ROOT}/*/control/*/*"]
    everything = [f"{ROOT}/**", f"{ROOT}/**/@adv/**"]
    asked = ("*",) if name in ASKS_ANYTHING else READ_ONLY_QUERIES
    queries = [f"{ROOT}/*/query/*/{query}" for query in asked]
    health = f"{ROOT}/*/{HEALTH}/{'*' if relays else name}"
    return [
        _rule(f"{name} writes", ["ingress"], ["put", "delete", "reply"], [*data, *adv, *answers, health]),
        _rule(f"{name} keeps", ["ingress"], ["declare_queryable", "liveliness_token"],
              [*adv, *answers, f"{ROOT}/*/alive/{name}/*"]),
        _rule(f"{name} reads", ["ingress"],
              ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"], everything),
        _rule(f"{name} asks", ["ingress"], ["query"], [*queries, everything[1]]),
        _rule(f"{name} hears", ["egress"], ["put", "delete", "reply", *_DECLARE], everything),
        _rule(f"{name} is asked", ["egress"], ["query"], [*adv, *answers]),
    ]  # fmt: skip


def _rule(id: str, flows: list[str], messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": id, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}


def _keys(robot: str, ways: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Keys of what crosses in these ways, and the keys beside them by which it is recovered."""
    names = [name for name, row in TOPICS.items() if row.uplink in ways]
    data = [f"{ROOT}/{robot}/{prefix}{name}" for name in names for prefix in ("", "end/")]
    return [*data, f"{ROOT}/{robot}/{HEALTH}/*"], [f"{key}/@adv/**" for key in data]


def _robot_rules(name: str, robot: str) -> list[dict[str, Any]]:
    up, up_adv = _keys(robot, ("up", "bulk"))
    down, down_adv = _keys(robot, ("down",))
    mine = [f"{ROOT}/{robot}/**", f"{ROOT}/{robot}/**/@adv/**"]
    return [
        _rule(f"{name} writes", ["ingress"], ["put", "delete", "reply"], [*up, *up_adv]),
        _rule(f"{name} keeps", ["ingress"], ["declare_queryable", "liveliness_token"], up_adv),
        _rule(f"{name} reads", ["ingress"],
              ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"],
              [*down, *down_adv]),
        _rule(f"{name} hears", ["egress"], ["put", "delete", "reply"], [*down, *down_adv]),
        _rule(f"{name} is asked", ["egress"], ["query"], up_adv),
        _rule(f"{name} is told", ["egress"], _DECLARE, mine),
    ]  # fmt: skip


def _reader_rules(name: str, host: Host) -> list[dict[str, Any]]:
    everything = [f"{ROOT}/{host.robot}/**", f"{ROOT}/{host.robot}/**/@adv/**"]
    asked = ["*"] if host.role == "operator" else READ_ONLY_QUERIES
    queries = [f"{ROOT}/{host.robot}/query/*/{query}" for query in asked]
    return [
        _rule(f"{name} reads", ["ingress"],
              ["declare_subscriber", "liveliness_query", "declare_liveliness_subscriber"], everything),
        _rule(f"{name} asks", ["ingress"], ["query"], [*queries, everything[1]]),
        _rule(f"{name} hears", ["egress"],
              ["put", "delete", "reply", "declare_queryable", "liveliness_token"], everything),
    ]  # fmt: skip
