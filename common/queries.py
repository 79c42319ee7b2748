"""Questions to a node and their answers: messages, streamed as they are made."""

from __future__ import annotations

import time
from collections.abc import Iterator

import zenoh

from common.bus import key
from common.codec import decode, encode, schema_of
from common.errors import UserError
from common.messages import Message
from common.streams import ENCODING

_APPEAR_S = 2.0  # right after a (re)connection a queryable is not known yet, and nobody answers


def ask(
    session: zenoh.Session, robot: str, node: str, name: str, parameters: dict[str, str], timeout_s: float
) -> Iterator[Message]:
    """The replies to a query, as they come.

    Raises:
        UserError: nobody answers to this query, the node refused it, or it took too long.
    """
    selector = zenoh.Selector(key(robot, "query", node, name), zenoh.Parameters(parameters))
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
                raise UserError(f"{node} refused {name}: {reply.err.payload.to_string()}")
            answered = True
            yield decode(str(reply.ok.encoding).partition(";")[2], reply.ok.payload.to_bytes())
        if answered:
            return
        if time.monotonic() > deadline:
            raise UserError(
                f"nobody answers {name} of node {node!r}: is it running? (`beamsplat top` shows it)"
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
