"""Hostile input over the network: garbage on every key, queries with any parameter, half-open connections."""

from __future__ import annotations

import contextlib
import random
import resource
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import zenoh

from beamsplat.common.messages.codec import MEDIA_TYPE, schema_of
from beamsplat.common.messages.header import DecodeError, Header
from beamsplat.common.messages.instances import control_id
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.topics import HEALTH, TOPICS
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.tools.bench.faults.hosts import ROBOT_NAME
from beamsplat.tools.bench.faults.watch import FORGED_INSTANCE

CONNECTIONS = 1000
_QUERY_S = 3.0
_SPARE_DESCRIPTORS = 500
# Values and names of parameters; a query gets up to three of them at random.
VALUES = (
    "", "0", "-1", "nan", "inf", "-inf", "1e999", "1e308", "0,0,0", "nan,0,0", "1e308,1e308,1e308", "0,0",
    "a,b,c", "9" * 400, "x" * 50_000, "{", "[1]", "[[]]", '["kind=../../etc/passwd"]', '["nice=99"]',
    '["=", "a.b.c=1", "\\u0000=1"]', '{"said": {"": "x"}}', '{"handled": 1}', "%00%ff", "../../..", "\u202e",
)  # fmt: skip
PARAMETERS = (
    "from", "focal_px", "error_px", "position", "quaternion", "width_px", "height_px", "set",
    "cold", "after", "add", "unknown",
)  # fmt: skip
VERBS = ("swap", "params")  # of the supervisor; `restart` is a fault of its own, because it always works


def forged_header(row_producer: str, rng: random.Random) -> bytes:
    """Return a header with impossible numbers, of an instance that no process has."""
    return Header(
        stamp_ns=rng.choice((-(2**63), -1, 0, 2**62, 2**63 - 1)),
        publish_ns=rng.choice((-(2**63), 0, 2**63 - 1)),
        clock_id=rng.getrandbits(64),
        sequence=rng.choice((0, 2**32, 2**64 - 1)),
        epoch=0,  # a higher one would say: the process was replaced
        producer=row_producer,
        instance=FORGED_INSTANCE,
    ).pack()


def garbage(rng: random.Random) -> Iterator[bytes]:
    """Yield payloads that no decoder accepts: empty, short, a head that lies, random bytes, nested lists."""
    yield b""
    yield b"\x00"
    yield b"\xff" * 64
    yield (2**32 - 1).to_bytes(4, "little") + b"\x80"
    yield (20).to_bytes(4, "little") + b"\xdd\xff\xff\xff\xff" + bytes(100)
    yield (4000).to_bytes(4, "little") + b"\x91" * 4000
    for size in (16, 1000, 60_000):
        yield rng.randbytes(size)


class HeardMessages:
    """The newest message of each topic, to be sent again with damage; fed from a thread of the bus."""

    def __init__(self, session: zenoh.Session) -> None:
        self.newest: dict[str, tuple[bytes, bytes]] = {}  # topic -> (payload, header)
        self._kept = []
        for name in TOPICS:
            # The newest only: channels that hold more of each would hold gigabytes of images.
            newest = session.declare_subscriber(key(ROBOT_NAME, name), zenoh.handlers.RingChannel(1))
            self._kept.append(newest)
            receive_in_thread(session, f"heard-{name}", newest, partial(self._take, name))

    def _take(self, name: str, sample: zenoh.Sample) -> None:
        if sample.attachment is not None:
            header = sample.attachment.to_bytes()
            with contextlib.suppress(DecodeError):
                if Header.unpack(header).instance != FORGED_INSTANCE:
                    self.newest[name] = (sample.payload.to_bytes(), header)


def send_garbage(session: zenoh.Session, heard: HeardMessages, rng: random.Random, seconds: float) -> int:
    """Send garbage on every topic, on its end marker and on the health of every node; return how much.

    Among it are damaged copies of real messages, and one message beyond the limit
    of its topic.
    """
    sent, ends = 0, time.monotonic() + seconds
    names = [*TOPICS, *(f"end/{name}" for name in TOPICS)]
    names += [f"{HEALTH}/{node}" for node in ("localization", "mapping", "nobody", "")[:3]]
    oversize = rng.choice([name for name in TOPICS if TOPICS[name].limit_kb <= 8000])
    session.put(key(ROBOT_NAME, oversize), bytes(TOPICS[oversize].limit_kb * 1000 + 1),
                attachment=forged_header("x", rng))  # fmt: skip
    while time.monotonic() < ends:
        name = rng.choice(names)
        row = TOPICS.get(name)
        schema = schema_of(row.message) if row else "Health/1.0"
        encoding = rng.choice(("", MEDIA_TYPE, f"{MEDIA_TYPE};{schema}", f"{MEDIA_TYPE};Health/99.0"))
        producer = row.producers[0] if row else "localization"
        for payload in garbage(rng):
            header = rng.choice((None, b"", b"BS", rng.randbytes(60), forged_header(producer, rng)))
            session.put(key(ROBOT_NAME, name), payload, attachment=header, encoding=encoding or None)
            sent += 1
        if row is not None and name in heard.newest:
            payload, header = heard.newest[name]
            damaged = bytearray(payload)
            for _ in range(8):
                damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
            cut = payload[: rng.randrange(len(payload))]
            for body in (bytes(damaged), cut):
                session.put(key(ROBOT_NAME, name), body, attachment=forged_copy(header),
                            encoding=f"{MEDIA_TYPE};{schema}")  # fmt: skip
                sent += 1
        time.sleep(0.02)
    return sent


def forged_copy(header: bytes) -> bytes:
    """Return a header that was heard, as if from an earlier process of the same node.

    The body may decode although it is damaged; what arrives as a valid message of the running process, no
    receiver can refuse.
    """
    return replace(Header.unpack(header), epoch=0, instance=FORGED_INSTANCE).pack()


def hostile_queries(
    session: zenoh.Session,
    queries: list[tuple[str, str]],
    instances: dict[str, str],
    rng: random.Random,
    seconds: float,
) -> tuple[int, int]:
    """Send queries and hand-over requests with hostile parameters; return how many, and how many unanswered.

    Args:
        session: a session of the operator.
        queries: (node, query name).
        instances: running processes, by node; `retire` is not sent to them, because it always works.
        rng: random numbers.
        seconds: how long.
    """
    keys = [key(ROBOT_NAME, "query", node, name) for node, name in queries]
    keys += [key(ROBOT_NAME, CONTROL, node, control_id(instance), verb)
             for node, instance in instances.items()
             for verb in ("reached", "activate", "nonsense")]  # fmt: skip
    keys += [
        key(ROBOT_NAME, CONTROL, "mapping", "0" * 16, "retire"),
        key(ROBOT_NAME, "query", "nobody", "restart"),
    ]
    sent = unanswered = 0
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        selector = rng.choice(keys)
        given = {rng.choice(PARAMETERS): rng.choice(VALUES) for _ in range(rng.randrange(4))}
        if selector.endswith("/swap"):  # without `set` it is a valid request
            given["set"] = rng.choice(VALUES)
        sent += 1
        answered = False
        try:
            for _ in session.get(
                zenoh.Selector(selector, zenoh.Parameters(given)), timeout=_QUERY_S,
                payload=rng.randbytes(rng.choice((0, 10, 1000))),
            ):  # fmt: skip
                answered = True
        except zenoh.ZError:
            continue
        unanswered += not answered
    return sent, unanswered


class HalfOpenConnections:
    """Connections that send nothing, or a part of a request, and stay open until `close`."""

    def __init__(self, port: int, count: int = CONNECTIONS) -> None:
        """Open `count` connections to a port of this host in a thread; what is refused is left out."""
        self._sockets: list[socket.socket] = []
        self._closed = threading.Event()
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = count + _SPARE_DESCRIPTORS
        if soft < wanted:
            ceiling = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
            resource.setrlimit(resource.RLIMIT_NOFILE, (ceiling, hard))
        threading.Thread(target=self._open, args=(port, count), daemon=True).start()

    def _open(self, port: int, count: int) -> None:
        for number in range(count):
            if self._closed.is_set():
                break
            try:
                opened = socket.create_connection(("127.0.0.1", port), timeout=1.0)
                self._sockets.append(opened)
                if number % 3 == 1:
                    opened.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
                elif number % 3 == 2:
                    opened.sendall(bytes((number % 256, 0, 1)))
            except OSError:
                continue

    def close(self) -> int:
        """Close the connections; return how many were open."""
        self._closed.set()
        opened = list(self._sockets)
        for connection in opened:
            connection.close()
        return len(opened)
