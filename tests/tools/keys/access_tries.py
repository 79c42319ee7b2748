"""Tries with real sessions what hosts and local processes may do with each key of a robot on a router.

`keys()` lists the keys: every topic with its end marker and its history, health, liveliness, every query of every
node, hand-over requests, the router's administration. `Tries.run` returns which operations had an effect.
"""

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from beamsplat.common.security.access_control import HostRole, access_control, local_access_control
from beamsplat.common.security.keys import CA, SecurityConfig
from beamsplat.common.security.logins import OPERATOR, SUPERVISOR, Login, login_of, make_logins
from beamsplat.common.topics import TOPICS
from beamsplat.common.zenoh.bus import open_link, open_router, open_session
from beamsplat.services.nodes import NODES
from beamsplat.tools.keys.pki import CertificateAuthority
from beamsplat.tools.system.commands import VERBS
from tests.conftest import free_port

ROOT = Path(__file__).resolve().parents[3]
ROBOT = "r1"
INSTANCE = "0123456789abcdef"
READ_ONLY_QUERIES = ("keyframe", "params", "poses", "render", "snapshot", "state")
REQUESTS = ("reached", "retire", "activate")
OPERATIONS = ("put", "delete", "read", "ask", "answer", "announce", "watch")
_LAST_S = 30.0  # an operation that the policy allows must have an effect within this time
_QUERY_S = 2.0  # a refused query has no answer: the router does not report it
_MAX_REPLIES = 4096  # to one query; a full channel would block its session
_ADMIN = b"admin"  # payload of the session that checks the effects


@dataclass(frozen=True)
class Key:
    """One key expression, its class, and the part of it that the table shows."""

    kind: str
    text: str
    key: str


def query_names() -> list[str]:
    """Return the names of all queries: those that any node answers, those of the supervisor, and an unknown one."""
    code = "".join(path.read_text() for path in (ROOT / "services").rglob("*.py"))
    return sorted({*re.findall(r"def on_query_(\w+)", code), *VERBS, "unknown"})


def keys() -> list[Key]:
    """Return all keys of the robot that are tried."""
    r = f"beamsplat/{ROBOT}"
    found = []
    for name, row in TOPICS.items():
        kind = row.uplink or "host"
        found += [
            Key(kind, name, f"{r}/{name}"),
            Key(f"{kind} end", f"end/{name}", f"{r}/end/{name}"),
            Key(f"{kind} history", f"{name}/@adv", f"{r}/{name}/@adv/pub/1/2/_"),
        ]
    for node in NODES:
        found += [
            Key("health", f"health/{node}", f"{r}/health/{node}"),
            Key("alive", f"alive/{node}", f"{r}/alive/{node}/{INSTANCE}"),
        ]
        # All queries of the mapper; of the other nodes one of each kind.
        for query in query_names() if node == "mapping" else ("params", "swap"):
            kind = "reading query" if query in READ_ONLY_QUERIES else "changing query"
            found.append(Key(kind, f"query/{node}/{query}", f"{r}/query/{node}/{query}"))
        found += [
            Key("request", f"control/{node}/{verb}", f"{r}/control/{node}/{INSTANCE}/{verb}")
            for verb in (REQUESTS if node == "mapping" else ("retire",))
        ]
    found.append(Key("failed", "failed/mapping", f"{r}/failed/mapping/{INSTANCE}"))
    found += [Key("operator", f"operator/mapping/{verb}", f"{r}/operator/mapping/{verb}") for verb in VERBS]
    found += [
        Key("unknown", "an unknown key of this robot", f"{r}/anything"),
        Key("foreign", "a key of another system", "another/key"),
        Key(PATTERN, f"{r}/** (all keys in one operation)", f"{r}/**"),
    ]
    return found


# The state of the router itself, which answers this query.
ADMINISTRATION = Key("administration", "state of the router", "@/*/router")
PATTERN = "pattern"

Allowed = Callable[[str, str, Key], bool]  # (subject, operation, key)
Effects = set[tuple[str, str, str]]  # (subject, operation, key)


class Tries:
    """Tries operations from sessions of several subjects at the same time, and records their effects."""

    def __init__(
        self,
        subjects: dict[str, zenoh.Session],
        admins: tuple[zenoh.Session, zenoh.Session],
        allowed: Allowed,
    ) -> None:
        """Args:
        subjects: session of each subject, by name.
        admins: two sessions that may do anything, to check the effects.
        allowed: what the policy allows; it only decides how long to wait for an effect.
        """
        self._subjects, self._admins, self._allowed = subjects, admins, allowed
        self._keys = keys()
        self._single_keys = [key for key in self._keys if key.kind != PATTERN]
        self._effects: Effects = set()
        self._lock = threading.Lock()

    def run(self) -> Effects:
        """Try every operation of every subject on every key; return those with an effect."""
        for phase in (self._write, self._read, self._ask, self._answer, self._watch, self._announce):
            phase()
        for subject, session in self._subjects.items():
            if any(reply.ok is not None for reply in session.get(ADMINISTRATION.key, timeout=_QUERY_S)):
                self._record(subject, "ask", ADMINISTRATION.key)
        return self._effects

    def _record(self, subject: str, operation: str, key: object) -> None:
        with self._lock:
            self._effects.add((subject, operation, str(key)))

    def _wanted(self, *operations: str) -> Effects:
        return {
            (subject, operation, key.key)
            for subject in self._subjects
            for operation in operations
            for key in (self._single_keys if operation in ("answer", "announce", "watch") else self._keys)
            if self._allowed(subject, operation, key)
        }

    def _repeat(self, attempt: Callable[[list[Key]], None], *operations: str) -> None:
        """Attempt all keys; repeat those where something allowed has no effect yet; at the end, all once more.

        So what is not allowed is tried again after everything that is allowed has had its effect.
        """
        wanted, deadline = self._wanted(*operations), time.monotonic() + _LAST_S
        attempt(self._keys)
        while (missing := wanted - self._effects) and time.monotonic() < deadline:
            late = {key for _, _, key in missing}
            attempt([key for key in self._keys if key.key in late])
            time.sleep(0.1)
        attempt(self._keys)
        time.sleep(0.3)

    def _write(self) -> None:
        def take(sample: zenoh.Sample) -> None:
            operation = "put" if sample.kind == zenoh.SampleKind.PUT else "delete"
            self._record((sample.attachment or sample.payload).to_string(), operation, sample.key_expr)

        def attempt(keys: list[Key]) -> None:
            for subject, session in self._subjects.items():
                for key in keys:
                    session.put(key.key, b"x", attachment=subject, congestion_control=_BLOCK)
                    session.delete(key.key, attachment=subject, congestion_control=_BLOCK)

        watching = [self._admins[0].declare_subscriber(p, take) for p in ("**", "**/@adv/**")]
        self._repeat(attempt, "put", "delete")
        _undeclare(watching)

    def _read(self) -> None:
        def taker(subject: str) -> Callable[[zenoh.Sample], None]:
            # By the payload: Zenoh 1.10 now and then delivers samples under the key of others to a session that
            # declares a wildcard and single keys at the same time.
            return lambda sample: self._record(subject, "read", sample.payload.to_string())

        def attempt(keys: list[Key]) -> None:
            for key in keys:
                self._admins[0].put(key.key, key.key, congestion_control=_BLOCK)

        reading = [
            session.declare_subscriber(key.key, taker(subject))
            for subject, session in self._subjects.items()
            for key in self._keys
        ]
        self._repeat(attempt, "read")
        _undeclare(reading)

    def _ask(self) -> None:
        """A query counts when it reaches the process that answers; its answer must return too."""
        answered: Effects = set()

        def answerer(key: Key) -> Callable[[zenoh.Query], None]:
            def answer(query: zenoh.Query) -> None:
                with query:
                    subject = query.payload.to_string() if query.payload else ""
                    self._record(subject, "ask", key.key)
                    self._record(subject, "ask", query.key_expr)
                    query.reply(key.key, _ADMIN)

            return answer

        def attempt(keys: list[Key]) -> None:
            pending = {
                (subject, "ask", key.key): session.get(
                    key.key,
                    zenoh.handlers.FifoChannel(_MAX_REPLIES),
                    payload=subject,
                    timeout=_QUERY_S,
                    congestion_control=_BLOCK,
                )
                for subject, session in self._subjects.items()
                for key in keys
                if (subject, "ask", key.key) not in answered
            }
            for effect, replies in pending.items():
                if any(reply.ok is not None for reply in replies):
                    answered.add(effect)

        answering = [
            self._admins[0].declare_queryable(key.key, answerer(key))
            for key in self._keys
            if key.kind != PATTERN
        ]
        self._repeat(attempt, "ask")
        assert {effect for effect in self._effects if effect[1] == "ask"} == answered
        _undeclare(answering)

    def _answer(self) -> None:
        def answerer(subject: str) -> Callable[[zenoh.Query], None]:
            def answer(query: zenoh.Query) -> None:
                with query:
                    query.reply(query.key_expr, subject)

            return answer

        def attempt(keys: list[Key]) -> None:
            pending = [
                self._admins[0].get(
                    key.key, zenoh.handlers.FifoChannel(_MAX_REPLIES), timeout=_QUERY_S,
                    target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE,
                )
                for key in keys if key.kind != PATTERN
            ]  # fmt: skip
            for replies in pending:
                for reply in replies:
                    if reply.ok is not None:
                        self._record(reply.ok.payload.to_string(), "answer", reply.ok.key_expr)

        answering = [
            session.declare_queryable(key.key, answerer(subject))
            for subject, session in self._subjects.items()
            for key in self._keys
        ]
        self._repeat(attempt, "answer")
        _undeclare(answering)

    def _watch(self) -> None:
        def attempt(keys: list[Key]) -> None:
            pending = [
                (
                    subject,
                    session.liveliness().get(
                        key.key, zenoh.handlers.FifoChannel(_MAX_REPLIES), timeout=_QUERY_S
                    ),
                )
                for subject, session in self._subjects.items()
                for key in keys
                if (subject, "watch", key.key) not in self._effects
            ]
            for subject, replies in pending:
                for reply in replies:
                    if reply.ok is not None:
                        self._record(subject, "watch", reply.ok.key_expr)

        tokens = [self._admins[0].liveliness().declare_token(key.key) for key in self._single_keys]
        self._repeat(attempt, "watch")
        _undeclare(tokens)

    def _announce(self) -> None:
        """One subject after another: a token does not say whose it is."""
        for subject, session in self._subjects.items():

            def attempt(subject: str = subject) -> None:
                for key in self._tokens():
                    self._record(subject, "announce", key)

            tokens = [session.liveliness().declare_token(key.key) for key in self._single_keys]
            wanted, deadline = self._wanted("announce"), time.monotonic() + _LAST_S
            wanted = {effect for effect in wanted if effect[0] == subject}
            attempt()
            while not wanted <= self._effects and time.monotonic() < deadline:
                attempt()
            attempt()
            _undeclare(tokens)
            while self._tokens() and time.monotonic() < deadline:
                time.sleep(0.02)

    def _tokens(self) -> list[str]:
        liveliness = self._admins[1].liveliness()
        return [
            str(reply.ok.key_expr)
            for pattern in ("**", "**/@adv/**")
            for reply in liveliness.get(pattern, zenoh.handlers.FifoChannel(_MAX_REPLIES), timeout=_QUERY_S)
            if reply.ok is not None
        ]


_BLOCK = zenoh.CongestionControl.BLOCK


def _undeclare(declared: list) -> None:
    for one in declared:
        one.undeclare()


# Subject of the edge server's router -> certificate: role and robot. The names are those of the table.
HOSTS = {
    "robot": HostRole(role="robot", robot=ROBOT),
    "another_robot": HostRole(role="robot", robot="r2"),
    "monitor": HostRole(role="monitor"),
    "monitor_of_another": HostRole(role="monitor", robot="r2"),
    "operator": HostRole(role="operator"),
    "operator_of_another": HostRole(role="operator", robot="r2"),
    "edge": HostRole(role="edge"),
    "removed": HostRole(role="robot", robot=ROBOT),
}
LOCAL = "local"  # processes of the edge server itself


@dataclass(frozen=True)
class Router:
    """A running router with the sessions of its subjects, and the subjects that it refuses."""

    subjects: dict[str, zenoh.Session]
    admins: tuple[zenoh.Session, zenoh.Session]
    refused: dict[str, bool]  # subject -> whether the router refused the connection
    policy: dict[str, Any]  # the router's access control


@contextlib.contextmanager
def edge_router(folder: Path) -> Iterator[Router]:
    """Run the router of an edge server with certificates, and connect every kind of host to it."""
    authority, other = (
        CertificateAuthority.create(folder / "ca"),
        CertificateAuthority.create(folder / "other"),
    )
    for name, host in HOSTS.items():
        authority.issue(name, host, ("127.0.0.1",) if host.role == "edge" else ())
    keys_of = {name: _kept(authority.folder / "hosts" / name, folder / name) for name in HOSTS}
    authority.remove("removed")
    strange = other.issue("robot", HOSTS["robot"])
    (strange / CA).write_bytes((authority.folder / CA).read_bytes())
    near, far = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    edge_keys = authority.folder / "hosts" / "edge"
    with open_router((near, far), security=SecurityConfig(keys=edge_keys)), contextlib.ExitStack() as stack:
        subjects = {LOCAL: stack.enter_context(open_session((near,)))}
        for name, keys_folder in keys_of.items():
            subjects[name] = stack.enter_context(open_link(far, 2.0, SecurityConfig(keys=keys_folder)))
        admins = tuple(stack.enter_context(open_session((near,))) for _ in range(2))
        refused = {
            "certificate of another authority": _is_refused(
                lambda: open_link(far, 1.0, SecurityConfig(keys=strange))
            ),
            "no certificate": _is_refused(lambda: _open_without_certificate(far, authority.folder / CA)),
        }
        yield Router(subjects, admins, refused, access_control(authority.hosts()))


def _kept(source: Path, target: Path) -> Path:
    target.mkdir()
    for path in source.iterdir():
        (target / path.name).write_bytes(path.read_bytes())
        (target / path.name).chmod(0o600)
    return target


@contextlib.contextmanager
def local_router(folder: Path) -> Iterator[Router]:
    """Run the router of a robot that requires logins, and connect every process of that robot to it."""
    users = (*NODES, SUPERVISOR, OPERATOR)
    security = SecurityConfig(local=folder)
    make_logins(folder, users)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router((endpoint,), security=security), contextlib.ExitStack() as stack:

        def connect(login: Login | None) -> zenoh.Session:
            return open_session((endpoint,), 1.0, login=login)

        subjects = {name: stack.enter_context(connect(login_of(security, name))) for name in users}
        admins = tuple(stack.enter_context(connect(login_of(security, SUPERVISOR))) for _ in range(2))
        refused = {
            "no login": _is_refused(lambda: connect(None)),
            "wrong password": _is_refused(lambda: connect(Login("camera", "wrong"))),
            "unknown user": _is_refused(lambda: connect(Login("stranger", "wrong"))),
        }
        yield Router(subjects, admins, refused, local_access_control(users))


def _is_refused(connect: Callable[[], zenoh.Session]) -> bool:
    try:
        session = connect()
    except Exception:
        return True
    session.close()
    return False


def _open_without_certificate(endpoint: str, root: Path) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect", f'{{endpoints: ["{endpoint}"], timeout_ms: 1000, exit_on_failure: true}}')
    config.insert_json5(
        "transport/link/tls", f'{{root_ca_certificate: "{root}", verify_name_on_connect: true}}'
    )
    return zenoh.open(config)
