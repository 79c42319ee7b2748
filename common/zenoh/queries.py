"""Questions to a node and their answers: messages, streamed as they are made."""

from __future__ import annotations

import time
from collections.abc import Iterator

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Message
from beamsplat.common.messages.codec import decode, encode, schema_of
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import ENCODING

_APPEAR_S = 2.0  # right after a (re)connection a queryable is not known yet, and nobody answers


def ask(
    session: zenoh.Session, robot: str, node: str, name: str, parameters: dict[str, str], timeout_s: float
) -> Iterator[Message]:
    """The replies to a query, as they come.

    Raises:
        UserError: nobody answers to this query, the node refused it, or it took too long.
    """
    yield from _ask(session, key(robot, "query", node, name), (node, name), parameters, timeout_s)


def command(
    session: zenoh.Session, robot: str, instance: str, verb: str, parameters: dict[str, str], timeout_s: float
) -> str:
    """What one process answers to its supervisor (common/takeover.py).

    Raises:
        UserError: it does not answer, or refuses.
    """
    place = key(robot, CONTROL, instance, verb)
    return next(_ask(session, place, (instance, verb), parameters, timeout_s)).text


def _ask(
    session: zenoh.Session,
    place: str,
    what: tuple[str, str],  # who is asked for what
    parameters: dict[str, str],
    timeout_s: float,
) -> Iterator[Message]:
    who, name = what
    selector = zenoh.Selector(place, zenoh.Parameters(parameters))
    deadline = time.monotonic() + min(timeout_s, _APPEAR_S)
    while True:
        answered = False
        for reply in session.get(
            selector,
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        ):
            if reply.ok is None:
                raise UserError(f"{who} refused {name}: {reply.err.payload.to_string()}")
            answered = True
            yield decode(str(reply.ok.encoding).partition(";")[2], reply.ok.payload.to_bytes())
        if answered:
            return
        if time.monotonic() > deadline:
            raise UserError(
                f"nobody answers {name} of node {who!r}: is it running? (`beamsplat top` shows it)"
            )
        time.sleep(0.1)


def reply(query: zenoh.Query, messages: Iterator[Message]) -> None:
    """Answers a query with messages; bad input (a ValueError) becomes an error reply: who asks must not
    be able to end a node."""
    with query:
        try:
            for message in messages:
                encoding = ENCODING.with_schema(schema_of(message))
                query.reply(query.key_expr, encode(message), encoding=encoding)
        except ValueError as error:
            query.reply_err(str(error).encode())
