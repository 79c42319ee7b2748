"""Queries to a node, and their answers: a stream of messages."""

from __future__ import annotations

import time
from collections.abc import Iterator

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer, Message
from beamsplat.common.messages.codec import decode, encode, schema_of
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import ENCODING

_DISCOVERY_S = 2.0  # right after a (re)connection, queries to a running node get no answer yet


def ask(
    session: zenoh.Session, robot: str, node: str, name: str, parameters: dict[str, str], timeout_s: float
) -> Iterator[Message]:
    """Send the query `name` with `parameters` to a node, and yield the answer messages as they arrive.

    Raises:
        UserError: no node answered this query in time, or the node rejected it.
    """
    yield from _ask(session, key(robot, "query", node, name), (node, name), parameters, timeout_s)


def command(
    session: zenoh.Session, robot: str, instance: str, verb: str, parameters: dict[str, str], timeout_s: float
) -> str:
    """Send a hand-over request to one process and return its answer (common/runtime/handover.py).

    Raises:
        UserError: the process did not answer in time, or rejected the request.
    """
    key_expr = key(robot, CONTROL, instance, verb)
    answer = next(_ask(session, key_expr, (instance, verb), parameters, timeout_s))
    assert isinstance(answer, Answer)  # the message type of all hand-over requests
    return answer.text


def _ask(
    session: zenoh.Session,
    key_expr: str,
    target: tuple[str, str],  # node or instance, and query name; for error texts
    parameters: dict[str, str],
    timeout_s: float,
) -> Iterator[Message]:
    who, name = target
    selector = zenoh.Selector(key_expr, zenoh.Parameters(parameters))
    deadline = time.monotonic() + min(timeout_s, _DISCOVERY_S)
    while True:
        answered = False
        for reply in session.get(
            selector,
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        ):
            if reply.ok is None:
                assert reply.err is not None  # a reply is one or the other
                raise UserError(f"{who} rejected {name}: {reply.err.payload.to_string()}")
            answered = True
            yield decode(str(reply.ok.encoding).partition(";")[2], reply.ok.payload.to_bytes())
        if answered:
            return
        if time.monotonic() > deadline:
            raise UserError(
                f"no answer from node {who!r} to the query {name!r}: is the node running? "
                "(`beamsplat top` shows it)"
            )
        time.sleep(0.1)


def reply(query: zenoh.Query, messages: Iterator[Message]) -> None:
    """Send `messages` as the answer to a query.

    A ValueError raised by the iterator (invalid parameters) is sent as an error reply and not raised here:
    a query must not be able to stop a node.
    """
    with query:
        try:
            for message in messages:
                encoding = ENCODING.with_schema(schema_of(message))
                query.reply(query.key_expr, encode(message), encoding=encoding)
        except ValueError as error:
            query.reply_err(str(error).encode())
