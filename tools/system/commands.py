"""Answer queries on the bus about the nodes that a supervisor runs.

query/<node>/restart               stops the node and starts it again
query/<node>/swap?set=...&cold=    changes options of the node: see `beamsplat.tools.system.swap`
query/<node>/params                returns the options of the node, defaults included
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from urllib.parse import unquote

import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.queries import reply
from beamsplat.tools.system.assembly import build_node
from beamsplat.tools.system.supervisor import ROUTER, Supervisor
from beamsplat.tools.system.swap import Swap

VERBS = ("restart", "swap", "params")


class Commands:
    """Receiver of the queries to a supervisor.

    Call `answer_pending` several times per second, in the thread that calls `Supervisor.poll`.
    """

    def __init__(self, session: zenoh.Session, robot: str, supervisor: Supervisor) -> None:
        self._session, self._supervisor = session, supervisor
        self._queryables = {
            verb: session.declare_queryable(key(robot, "query", "*", verb), zenoh.handlers.FifoChannel(16))
            for verb in VERBS
        }
        self._swaps: dict[str, tuple[Swap, zenoh.Query]] = {}  # by node, unfinished

    def answer_pending(self) -> None:
        """Answer the queries received since the last call, and continue unfinished swaps.

        A swap query is answered when its swap has finished or failed.
        """
        for verb, queryable in self._queryables.items():
            while (query := queryable.try_recv()) is not None:
                node = str(query.key_expr).split("/")[-2]
                if node not in self._supervisor.children:  # on another host: the supervisor there answers
                    query.drop()
                elif verb == "swap":
                    self._begin_swap(node, query)
                else:
                    reply(query, self._restart(node) if verb == "restart" else self._params(node))
        for node, (swap, query) in list(self._swaps.items()):
            try:
                text = swap.poll()
            except UserError as error:
                del self._swaps[node]
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
        config = build_node(self._supervisor.deployment, node, self._supervisor.table).config
        yield Answer(stamp_ns=time.time_ns(), text=config.model_dump_json(indent=2))

    def _begin_swap(self, node: str, query: zenoh.Query) -> None:
        try:
            if node in self._swaps:
                raise UserError(f"{node} is being swapped already: wait until that is done")
            # The stubs miss that Parameters iterates over (key, value).
            parameters: dict[str, str] = dict(query.parameters)  # type: ignore[call-overload]
            overrides = json.loads(unquote(parameters.get("set", "[]")))
            if not (isinstance(overrides, list) and all(isinstance(o, str) for o in overrides)):
                raise UserError("swap: `set` is a JSON list of OPTION=VALUE")
            successor = self._supervisor.successor(node, tuple(overrides), "cold" not in parameters)
        except ValueError as error:  # a UserError, or invalid JSON
            reply(query, _refuse(error))
            return
        self._swaps[node] = (Swap(self._session, self._supervisor, successor), query)


def _refuse(error: ValueError) -> Iterator[Answer]:
    raise error
    yield  # a generator: `reply` sends the exception as an error reply
