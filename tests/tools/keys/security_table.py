"""The table of what each host, login and request may do, from real connections: docs/security_table.md.

`python -m tests.tools.keys.security_table` writes it.
"""

import json
import tempfile
from pathlib import Path

from beamsplat.common.security.access_control import ROOT as KEY_ROOT
from beamsplat.common.topics import TOPICS
from beamsplat.services.nodes import NODES
from tests.common.security.test_access_control import Policy
from tests.services.page.test_page_server import TOKEN, Serving
from tests.tools.keys.access_tries import (
    ADMINISTRATION,
    LOCAL,
    OPERATIONS,
    PATTERN,
    ROOT,
    Effects,
    Key,
    Router,
    Tries,
    edge_router,
    keys,
    local_router,
)

DOCUMENT = ROOT / "docs" / "security_table.md"
LETTERS = {
    "put": "p", "delete": "d", "read": "r", "ask": "q", "answer": "a", "announce": "t", "watch": "w",
}  # fmt: skip
# Columns of the edge's table: subject -> heading.
HOST_HEADINGS = {
    LOCAL: "process of the edge's host", "robot": "this robot", "another_robot": "another robot",
    "monitor": "monitor", "monitor_of_another": "monitor of another robot", "operator": "operator",
    "operator_of_another": "operator of another robot", "edge": "an edge server", "removed": "removed host",
}  # fmt: skip
KIND_HEADINGS = {
    "up": "topics to the edge, small", "up end": "their end markers", "up history": "their caches (`@adv`)",
    "bulk": "topics to the edge, large", "bulk end": "their end markers", "bulk history": "their caches",
    "down": "topics to the robot", "down end": "their end markers", "down history": "their caches",
    "host": "topics that stay on a host", "host end": "their end markers", "host history": "their caches",
    "health": "health of any node", "alive": "tokens of active nodes", "failed": "tokens of failed nodes",
    "reading query": "queries `keyframe`, `params`, `poses`, `render`, `snapshot`, `state`",
    "changing query": "all other queries (`restart`, `swap`, ...)",
    "request": "hand-over requests to a process", "operator": "commands of the operator", "unknown": "any other key of this robot",
    "foreign": "keys outside `beamsplat/`", PATTERN: "one wildcard for all keys of this robot",
    "administration": "state of the router",
}  # fmt: skip


def policy_allows(policy: dict, subject: str, operation: str, key: Key) -> bool:
    """Return whether the rules of a router permit an operation; a sender's own filters are not relied on."""
    rules = Policy(policy, subject)

    def enters(message: str) -> bool:
        return rules.may("ingress", message, key.key)

    def leaves(message: str) -> bool:
        return rules.may("egress", message, key.key)

    return {
        "put": lambda: enters("put"),
        "delete": lambda: enters("delete"),
        "read": lambda: enters("declare_subscriber") and leaves("put"),
        "ask": lambda: enters("query"),
        "answer": lambda: enters("declare_queryable") and leaves("query") and enters("reply"),
        "announce": lambda: enters("liveliness_token"),
        "watch": lambda: enters("liveliness_query") and leaves("liveliness_token"),
    }[operation]()


def try_all(router: Router) -> Effects:
    """Try everything on a running router."""
    return Tries(
        router.subjects,
        router.admins,
        lambda s, operation, key: policy_allows(router.policy, s, operation, key),
    ).run()


# Columns of the logins' table: what a user asks -> class of key.
ASKED = {
    "reading": "reading query", "changing": "changing query", "operator": "operator", "requests": "request",
}  # fmt: skip

# --- HTTP ---

_AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}
# Cases of a request: column -> headers besides Host, and the host name.
REQUESTS = {
    "no token": ({}, "localhost"),
    "wrong token": ({"Authorization": "Bearer wrong"}, "localhost"),
    "right token": (_AUTHORIZED, "localhost"),
    "right token, foreign host name": (_AUTHORIZED, "evil.example"),
    "right token, page of another origin": ({**_AUTHORIZED, "Origin": "http://evil.example"}, "localhost"),
}


def try_requests() -> dict[tuple[str, str], dict[str, int]]:
    """Send each kind of request to each route of a page; return the status codes by (method, path)."""
    found: dict[tuple[str, str], dict[str, int]] = {}
    with Serving() as serving:
        router = serving.server._runner.app.router
        routes = {(route.method, route.resource.canonical) for route in router.routes()}
        for method, path in sorted(routes, key=lambda route: (route[1], route[0])):
            if method != "HEAD":
                found[method, path] = {
                    case: _status(
                        serving,
                        method,
                        path.format(name="camera", robot="r1", anchor="0", id="0", file="none.js"),
                        headers,
                        host,
                    )
                    for case, (headers, host) in REQUESTS.items()
                }
        for method in ("OPTIONS", "PUT"):
            found[method, "any"] = {
                case: _status(serving, method, "/command", headers, host)
                for case, (headers, host) in REQUESTS.items()
            }
    return found


def _status(serving: Serving, method: str, path: str, headers: dict[str, str], host: str) -> int:
    body = json.dumps({"action": "restart", "node": "depth"}) if method == "POST" else ""
    lines = [f"{method} {path} HTTP/1.1", f"Host: {host}", f"Content-Length: {len(body)}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    return serving.status("\r\n".join([*lines, "", body]).encode())


# --- text ---


def cell(effects: Effects, subject: str, key: str) -> str:
    """Return the letters of the operations of a subject that had an effect on a key."""
    return "".join(LETTERS[o] for o in OPERATIONS if (subject, o, key) in effects)


def _table(header: list[str], rows: list[list[str]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *rows)]


def _edge_rows(effects: Effects) -> list[list[str]]:
    rows = []
    for kind, heading in KIND_HEADINGS.items():
        of_kind = [key for key in (*keys(), ADMINISTRATION) if key.kind == kind]
        cells = {tuple(cell(effects, subject, key.key) for subject in HOST_HEADINGS) for key in of_kind}
        assert len(cells) == 1, f"{kind}: not the same for all keys: {cells}"
        rows.append([heading, *(text or "-" for text in cells.pop())])
    return rows


def _local_rows(effects: Effects, users: list[str]) -> list[list[str]]:
    found = keys()

    def texts(user: str, operation: str, *kinds: str) -> list[str]:
        return [k.text for k in found if k.kind in kinds and (user, operation, k.key) in effects]

    def summary(own: list[str], everything: int) -> str:
        return "-" if not own else "all" if len(own) == everything else ", ".join(f"`{t}`" for t in own)

    def nodes(user: str, operation: str, *kinds: str) -> str:
        return summary(sorted({t.split("/")[1] for t in texts(user, operation, *kinds)}), len(NODES))

    rows = []
    for user in users:
        asks = [name for name, kind in ASKED.items() if texts(user, "ask", kind)]
        asks += ["router"] if (user, "ask", ADMINISTRATION.key) in effects else []
        of_robot = [key for key in found if key.kind != "foreign"]
        reads = all((user, "read", key.key) in effects for key in of_robot)
        rows.append([
            f"`{user}`", summary(texts(user, "put", "up", "bulk", "down", "host"), len(TOPICS)),
            nodes(user, "put", "health"), "all" if reads else "part", ", ".join(asks),
            nodes(user, "answer", "reading query", "changing query"), nodes(user, "answer", "request"),
        ])  # fmt: skip
    return rows


def render(edge: tuple[Router, Effects], local: tuple[Router, Effects], requests: dict) -> str:
    """Return the document from the effects of all tries."""
    lines = [
        "# Who may do what: measured",
        "",
        "Written by `python -m tests.tools.keys.security_table` from real connections to real routers and a real page;",
        "`tests/tools/keys/test_security_table.py` fails if it is outdated, if it differs from the rules in",
        "`common/security/access_control.py`, or from what the test expects.",
        "",
        "## Other hosts at the router of an edge server",
        "",
        f"Keys of one robot (`{KEY_ROOT}/ROBOT/...`). " + ", ".join(
            f"{letter} = {text}" for letter, text in {
                "p": "publishes", "d": "deletes", "r": "receives", "q": "its queries are answered", "a": "answers queries",
                "t": "declares a liveliness token", "w": "sees liveliness tokens",
            }.items()
        ) + ". Certificates decide, except for processes of the edge's own host, which connect over loopback.",
        "",
        *_table(["", *HOST_HEADINGS.values()], _edge_rows(edge[1])),
        "",
        "Refused at the connection: " + ", ".join(name for name, refused in edge[0].refused.items() if refused) + ".",
        "",
        "## Processes of a robot with `security.local`",
        "",
        "Queries: reading = `keyframe`, `params`, `poses`, `render`, `snapshot`, `state`; changing = all others; operator = commands that may set any",
        "option; requests = hand-over of a process; router = state of the router. Who publishes a topic also publishes its end marker and answers queries to its cache.",
        "",
        *_table(
            ["login", "publishes topics", "publishes the health of", "receives", "sends queries", "answers queries to",
             "answers hand-over requests"],
            _local_rows(local[1], list(local[0].subjects)),
        ),
        "",
        "Refused at the connection: " + ", ".join(name for name, refused in local[0].refused.items() if refused) + ".",
        "",
        "## The web page",
        "",
        "Status codes; 404 of an image, a chunk or a file of the viewer: there is none; 400 of a render: without a pose.",
        "Without the option `token` every command is refused with 403.",
        "",
        *_table(
            ["", *REQUESTS],
            [[f"{method} {path}", *map(str, cases.values())] for (method, path), cases in requests.items()],
        ),
        "",
    ]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    """Write the document."""
    with tempfile.TemporaryDirectory() as folder:
        with edge_router(Path(folder, "edge")) as router:
            edge = router, try_all(router)
        with local_router(Path(folder, "local")) as router:
            local = router, try_all(router)
    DOCUMENT.write_text(render(edge, local, try_requests()))


if __name__ == "__main__":
    main()
