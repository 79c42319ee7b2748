"""Answer queries on the bus about the nodes that a supervisor runs.

query/<node>/restart               stops the node and starts it again
query/<node>/swap?set=...&cold=    changes options of the node: see `beamsplat.tools.system.swap`
query/<node>/params                returns the options of the node, defaults included, without secrets

Only options of type `Remote` can be set in this way, because other hosts and users of the page may send
queries. The same with `operator` in place of `query` sets any option: the router accepts it only from this
host, and with local logins only from the operator (common/security/access_control.py).
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from urllib.parse import unquote

import zenoh

from beamsplat.common.config.base import remote_options
from beamsplat.common.config.deployment import with_overrides
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer
from beamsplat.common.plugins import is_class_path
from beamsplat.common.redaction import Redactor
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.queries import OPERATOR_QUERY, QUERY, reply
from beamsplat.tools.system.assembly import build_node
from beamsplat.tools.system.supervisor import ROUTER, Supervisor
from beamsplat.tools.system.swap import Swap

log = logging.getLogger("beamsplat")

VERBS = ("restart", "swap", "params")


class Commands:
    """Receiver of the queries to a supervisor.

    Call `answer_pending` several times per second, in the thread that calls `Supervisor.poll`.
    """

    def __init__(self, session: zenoh.Session, robot: str, supervisor: Supervisor) -> None:
        self._session, self._supervisor = session, supervisor
        self._queryables = {
            (prefix, verb): session.declare_queryable(
                key(robot, prefix, "*", verb), zenoh.handlers.FifoChannel(16)
            )
            for prefix in (QUERY, OPERATOR_QUERY)
            for verb in VERBS
        }
        self._swaps: dict[str, tuple[Swap, zenoh.Query]] = {}  # by node, unfinished

    @property
    def busy(self) -> bool:
        """Whether a swap is in progress: call `answer_pending` soon again."""
        return bool(self._swaps)

    def answer_pending(self) -> None:
        """Answer the queries received since the last call, and continue unfinished swaps.

        A swap query is answered when its swap has finished or failed.
        """
        for (prefix, verb), queryable in self._queryables.items():
            while (query := queryable.try_recv()) is not None:
                node = str(query.key_expr).split("/")[-2]
                if node not in self._supervisor.children:  # on another host: the supervisor there answers
                    query.drop()
                elif verb == "swap":
                    self._begin_swap(node, query, anything=prefix == OPERATOR_QUERY)
                else:
                    reply(query, self._restart(node) if verb == "restart" else self._params(node))
        for node, (swap, query) in list(self._swaps.items()):
            try:
                text = swap.poll()
            except UserError as error:
                del self._swaps[node]
                log.warning("%s", error)
                reply(query, _refuse(error))
                continue
            if text is not None:
                del self._swaps[node]
                reply(query, iter([Answer(stamp_ns=time.time_ns(), text=text)]))

    def _restart(self, node: str) -> Iterator[Answer]:
        self._supervisor.restart(node)
        yield Answer(stamp_ns=time.time_ns(), text=f"{node} is stopped and starts again")

    def _params(self, node: str) -> Iterator[Answer]:
        if node == ROUTER:
            raise UserError("the router has no options that can be changed while it runs")
        options_of_node = build_node(self._supervisor.deployment, node, self._supervisor.table).options()
        options = Redactor().table(options_of_node.model_dump(mode="json"))
        yield Answer(stamp_ns=time.time_ns(), text=json.dumps(options, indent=2))

    def _check_remote(self, node: str, overrides: list[str]) -> None:
        """Raise UserError if only the operator of this host may set one of the overrides OPTION=VALUE."""
        s = self._supervisor
        allowed = remote_options(type(build_node(s.deployment, node, s.table).config))
        values = with_overrides(s.deployment, tuple(f"{node}.{o}" for o in overrides)).nodes[node]
        for option in (override.partition("=")[0].strip() for override in overrides):
            if option not in allowed or is_class_path(str(values[option])):
                raise UserError(
                    f"{node}.{option}: this value cannot be set from another host or the page; on the host "
                    f"of the node, `beamsplat swap FILE {node} --set {option}=VALUE` sets it. "
                    f"Options that can: {', '.join(allowed) or 'none'}"
                )

    def _begin_swap(self, node: str, query: zenoh.Query, anything: bool) -> None:
        try:
            if node in self._swaps:
                raise UserError(f"{node} is being swapped already: wait until that is done")
            # The stubs miss that Parameters iterates over (key, value).
            parameters: dict[str, str] = dict(query.parameters)  # type: ignore[call-overload]
            overrides = json.loads(unquote(parameters.get("set", "[]")))
            if not (isinstance(overrides, list) and all(isinstance(o, str) for o in overrides)):
                raise UserError("swap: `set` is a JSON list of OPTION=VALUE")
            if not anything:
                self._check_remote(node, overrides)
            successor = self._supervisor.successor(node, tuple(overrides), "cold" not in parameters)
        except (ValueError, RecursionError, OSError) as error:  # wrong options; no process can be started
            reply(query, _refuse(ValueError(str(error))))
            return
        self._swaps[node] = (Swap(self._session, self._supervisor, successor), query)


def _refuse(error: ValueError) -> Iterator[Answer]:
    raise error
    yield  # a generator: `reply` sends the exception as an error reply
