"""Queries to a node, and their answers: a stream of messages."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer, Message
from beamsplat.common.messages.codec import decode, schema_of
from beamsplat.common.messages.header import DecodeError
from beamsplat.common.messages.instances import control_id
from beamsplat.common.redaction import without_secrets
from beamsplat.common.runtime.handover import CONTROL
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.common.topics import LIMIT_KB
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import ENCODING, encode_within

log = logging.getLogger(__name__)
# First part of the key after the robot: queries, and commands from the host of the node.
QUERY, OPERATOR_QUERY = "query", "operator"


class NoQueryAnswer(UserError):
    """No node, or no process, has answered a query."""


_DISCOVERY_S = 2.0  # right after a (re)connection, queries to a running node get no answer yet


def ask(
    session: zenoh.Session,
    robot: str,
    node: str,
    name: str,
    parameters: dict[str, str],
    timeout_s: float,
    prefix: str = QUERY,
) -> Iterator[Message]:
    """Send the query `name` with `parameters` to a node, and yield the answer messages as they arrive.

    With `prefix` = `OPERATOR_QUERY` it is a command of the operator, which may set any option of a node.

    Raises:
        NoQueryAnswer: no node answered this query in time.
        UserError: the node rejected it, or its answer cannot be decoded.
    """
    yield from _ask(session, key(robot, prefix, node, name), (node, name), parameters, timeout_s)


def command(
    session: zenoh.Session,
    robot: str,
    process: tuple[str, str],  # node, instance
    verb: str,
    parameters: dict[str, str],
    timeout_s: float,
) -> str:
    """Send a hand-over request to one process and return its answer (common/runtime/handover.py).

    Raises:
        NoQueryAnswer: the process did not answer in time.
        UserError: it rejected the request, or answered with something else.
    """
    node, instance = process
    key_expr = key(robot, CONTROL, node, control_id(instance), verb)
    answer = next(_ask(session, key_expr, (instance, verb), parameters, timeout_s))
    if not isinstance(answer, Answer):  # the message type of all hand-over requests
        raise UserError(f"{instance} answered {verb} with a message {schema_of(answer)}, expected an Answer")
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
                text = reply.err.payload.to_string()
                if text == "Timeout":  # of Zenoh itself: the query was received, and not answered
                    raise NoQueryAnswer(f"{who} did not answer {name} within {timeout_s:g} s")
                raise UserError(f"{who} rejected {name}: {text}")
            answered = True
            try:
                answer = decode(str(reply.ok.encoding).partition(";")[2], reply.ok.payload.to_bytes())
            except DecodeError as error:
                raise UserError(
                    f"{who} answered {name} with a message of another version: {error}"
                ) from error
            yield answer
        if answered:
            return
        if time.monotonic() > deadline:
            raise NoQueryAnswer(
                f"no answer from node {who!r} to the query {name!r}: is the node running? "
                "(`beamsplat top` shows it)"
            )
        time.sleep(0.1)


_fault_log = RateLimitedLog()


def reply(query: zenoh.Query, messages: Iterator[Message]) -> str:
    """Send `messages` as the answer to a query; no exception of the iterator is raised here.

    An exception is sent as an error reply: a query must not be able to stop a node. A ValueError says what is
    wrong with the parameters. Any other exception is a fault of the node itself: it is also logged.

    Returns:
        The fault of the node, as "ZeroDivisionError: division by zero"; "" without a fault.
    """
    with query:
        try:
            for message in messages:
                encoding = ENCODING.with_schema(schema_of(message))
                payload = encode_within(message, LIMIT_KB, f"answer to {query.key_expr}")
                query.reply(query.key_expr, payload, encoding=encoding)
        except ValueError as error:
            _reply_error(query, str(error))
        except Exception as error:
            fault = f"{type(error).__name__}: {error}"
            if (count := _fault_log.due(str(query.key_expr))) is not None:
                log.exception("%s failed (%d more since the last report)", query.key_expr, count)
            _reply_error(query, f"fault in this node: {fault}; its log has the details")
            return fault
    return ""


def reject(query: zenoh.Query, text: str) -> None:
    """Answer a query with the error `text`."""
    with query:
        _reply_error(query, text)


def _reply_error(query: zenoh.Query, text: str) -> None:
    with contextlib.suppress(zenoh.ZError):  # the asker has left
        query.reply_err(without_secrets(text).encode())
