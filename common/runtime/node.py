"""Base class of nodes. A node receives and yields messages; it uses neither the bus nor the wall clock.

A subclass declares its topics and has one handler per input, a generator of the messages that it sends:

    class Localization(Node):
        name = "localization"
        inputs = ("lidar/scan", "wheel/odometry")
        outputs = ("localization/odometry",)

        def on_lidar_scan(self, scan: Scan) -> Outputs:
            yield "localization/odometry", Odometry(...)

Misspelt topics and missing handlers raise an error when the class is defined. The same node runs under
`runtime.live` (a process on Zenoh) and `runtime.lockstep` (all nodes in one reproducible thread).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages import Health, Message
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.figures import Figures
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.rejections import Rejections
from beamsplat.common.topics import ROW_NUMBER, Delivery, Topic, topic


@dataclass(frozen=True)
class Input:
    """A subscription to a topic.

    Args:
        delivery: overrides the delivery of the topic table.
        feedback: the input depends on this node's own output (an acknowledgement). It is handled in order of
            arrival, not merged by stamp, and the node ends without waiting for its end: otherwise the node
            would wait for itself. Feedback after the node's end is still handled, but the outputs of its
            handler are discarded.
        keep: messages of a `latest` input that wait while the node is busy; a further one replaces the
            oldest, which is counted as dropped. More than 1 for a node that needs every message, and falls
            behind for moments only.
        queued_bytes: limit on the payload bytes queued for an `every` input; beyond this limit the oldest
            messages are dropped and counted.
    """

    topic: str
    delivery: Delivery | None = None
    feedback: bool = False
    keep: int = 1
    queued_bytes: int = 256 * 1024 * 1024  # enough for a recorder to bridge a stalled disk

    @property
    def row(self) -> Topic:
        return topic(self.topic)

    @property
    def effective_delivery(self) -> Delivery:
        return self.delivery or self.row.delivery


@dataclass(frozen=True)
class Job:
    """Long computation, yielded by a handler; its result is passed to `on_job_<name>(result)`.

    Args:
        run: the computation; it must not access state that the node changes meanwhile.
        after: deliver the result just before the n-th next message, and wait for it if necessary:
            reproducible in both runners. None: deliver it when it is finished (in lockstep after the modelled
            `job_cost_s`): for work on a disk, and for work that must delay no message.
        of: topic whose messages `after` counts; the default counts the messages of all inputs.
    """

    name: str
    run: Callable[[], Any]
    after: int | None = None
    of: str | None = None


class SourceItem(NamedTuple):
    """A message that `source()` yields, with its topic.

    `at_ns` is the arrival time (ns) on a recording's clock, by which runners pace and order messages; None
    means now (a real device).
    """

    at_ns: int | None
    topic: str
    message: Message


Output = tuple[str, Message] | Job
Outputs = Iterator[Output]
# Sends a query: (node, query name, parameters, time-out in s) -> answers.
QueryFunction = Callable[[str, str, dict[str, str], float], Iterator[Message]]


class UndeclaredOutput(RuntimeError):
    """A node published on a topic, or started a job, that its class does not declare."""


class StopRequested(Exception):
    """The process was asked to end while a node was starting: it ends without `drain`."""


class Node:
    """Base class of all nodes. Life cycle: configure() -> messages -> drain() -> close()."""

    name: ClassVar[str] = ""
    Config: ClassVar[type[NodeConfig]] = NodeConfig
    inputs: ClassVar[tuple[str | Input, ...]] = ()
    outputs: ClassVar[tuple[str, ...]] = ()
    # Whether a second process can take over while the first one runs (`runtime.handover`): because the node's
    # state comes from the inputs of the last seconds, or, with `hands_over`, because it is written by
    # `hand_over` and read by `take_over`.
    replaceable: ClassVar[bool] = False
    hands_over: ClassVar[bool] = False

    def __init__(self, config: NodeConfig) -> None:
        self.config = config
        self.live_settings: LiveSettings | None = None  # None in lockstep
        self.without_producer: frozenset[str] = frozenset()  # inputs that nothing publishes; set by runners
        self.detail = ""  # one line that is shown with the node's health
        self.rejections = Rejections()  # of inputs and results; those with a status are counted by this class
        self.figures = Figures()  # for alerts and metrics; those in results are read by this class
        self.writes_to: Path | None = None  # the health reports this disk; None: that of the state folder
        # Whether the process was asked to end, within seconds; set by the live runner. Long work asks between
        # its steps and ends early, `configure` by raising StopRequested. `drain` then only saves the state.
        self.must_stop: Callable[[], bool] = lambda: False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if not cls.name:  # an abstract base class
            return
        cls.inputs = tuple(Input(i) if isinstance(i, str) else i for i in cls.inputs)
        for entry in subscriptions(cls):
            if not callable(getattr(cls, entry.row.handler, None)):
                raise TypeError(f"{cls.__name__} subscribes to {entry.topic}, but has no {entry.row.handler}")
        for name in cls.outputs:
            if cls.name not in topic(name).producers:
                raise TypeError(
                    f"{cls.__name__} ({cls.name}) publishes {name}, whose producers are "
                    f"{topic(name).producers}"
                )

    # --- life cycle: override what is needed ---

    def configure(self) -> None:
        """Load models and compile kernels, so that the first message is handled without delay."""

    def check_resources(self) -> None:
        """Check, before any process starts, that the files and devices named in the options exist.

        Raises:
            UserError: a file or device is missing or unusable.
        """

    def options(self) -> NodeConfig:
        """Return the options as they take effect on this machine; may be called before `configure`."""
        return self.config

    def drain(self) -> Iterable[Output]:
        """Return the node's last output messages; called once, after all inputs have ended."""
        return ()

    def close(self) -> None:
        """Release files and devices. Called once, also after an error."""

    def source(self) -> Iterator[SourceItem | None]:
        """Yield the messages of a sensor or recording; a node that overrides this has no inputs.

        A device yields None several times a second while it has no new measurement, so that the runner can
        process signals and queries.
        """
        return iter(())

    def on_health(self, health: Health) -> None:
        """Handle a health report of any node; only called live, and only if a subclass overrides it."""

    def set_query_function(self, ask: QueryFunction) -> None:
        """Receive `ask`, the function that sends queries to other nodes.

        Called by the live runner only, before `configure`. A node that sends queries overrides this method
        and stores the function.
        """

    def on_arrival(self, topic: str, message: Message) -> Iterable[Output]:
        """Process a message on arrival, before it is queued, and return output messages.

        For replies that must not wait for a long step of the node. The live runner calls this method from the
        threads of the bus, concurrently with the other methods.
        """
        return ()

    def on_header(self, header: Header) -> None:
        """Receive the header of the message that is handled next; the recorder writes it to its file."""

    def backlog(self, topic: str) -> int:
        """Return how many messages on `topic` were sent and are not acknowledged, for the header of the next.

        It is part of the header because it changes while a message waits to be sent again.
        """
        return 0

    def handover_obstacle(self, before: Node) -> str:
        """Return why this node cannot take over from the running node `before`, or "" if it can."""
        return "" if self.replaceable else "its state exists only in its process"

    def hand_over(self) -> None:
        """Write the node's state to the files that its successor reads, and release these files.

        Called between two messages, in the process that retires.

        Raises:
            UserError: the state could not be written; the node continues as before.
        """

    def take_over(self) -> None:
        """Read the state that the predecessor wrote. Only called on a process that was started in standby."""

    @property
    def in_standby(self) -> bool:
        """Whether this process is a successor: `configure` must not change the predecessor's files."""
        return self.live_settings is not None and self.live_settings.standby

    def ignored_inputs(self) -> frozenset[str]:
        """Return the topics that this node does not use with its options: they are not subscribed to."""
        return frozenset()

    def has_idle_work(self) -> bool:
        """Return whether there is work left for times in which no message waits; see `on_idle`."""
        return False

    def on_idle(self) -> Iterable[Output]:
        """Do one short piece of the work that can wait, and return output messages.

        Called while no message is ready and `has_idle_work` is True. The amount of this work follows from the
        messages: it is finite, because the lockstep runner with `idle_cost_s` = 0 does all of it at once.
        """
        return ()

    def awaits_feedback(self) -> bool:
        """Return whether the node must wait for more feedback although its other inputs have ended."""
        return False

    def on_feedback_timeout(self, seconds: float) -> Iterable[Output]:
        """Return output messages after `seconds` without the awaited feedback (see `awaits_feedback`).

        Called by the live runner only.
        """
        return ()

    # --- used by the runners ---

    @classmethod
    def is_source(cls) -> bool:
        """Return whether this node overrides `source`."""
        return cls.source is not Node.source

    @classmethod
    def watches_health(cls) -> bool:
        """Return whether this node receives the health reports of all nodes."""
        return cls.on_health is not Node.on_health

    @classmethod
    def queries(cls) -> tuple[str, ...]:
        """Return the names of the queries that this node answers.

        Each query has a method `on_query_<name>(parameters)`, a generator of the answers.
        """
        prefix = "on_query_"
        return tuple(sorted(n.removeprefix(prefix) for n in dir(cls) if n.startswith(prefix)))

    def handle(self, topic_name: str, message: Message) -> Iterator[Output]:
        """Yield the outputs of the handler of `topic_name`; raise UndeclaredOutput if one is not declared."""
        yield from self._declared(getattr(self, topic(topic_name).handler)(message))

    def handle_arrival(self, topic_name: str, message: Message) -> Iterator[Output]:
        """Yield the outputs of `on_arrival`; raise UndeclaredOutput for an undeclared output."""
        yield from self._declared(self.on_arrival(topic_name, message))

    def handle_job(self, name: str, result: Any) -> Iterator[Output]:
        """Yield the outputs of `on_job_<name>(result)`; raise UndeclaredOutput for an undeclared output."""
        yield from self._declared(getattr(self, f"on_job_{name}")(result))

    def handle_feedback_timeout(self, seconds: float) -> Iterator[Output]:
        """Yield the outputs of `on_feedback_timeout`; raise UndeclaredOutput for an undeclared output."""
        yield from self._declared(self.on_feedback_timeout(seconds))

    def handle_idle(self) -> Iterator[Output]:
        """Yield the outputs of `on_idle`; raise UndeclaredOutput for an undeclared output."""
        yield from self._declared(self.on_idle())

    def handle_drain(self) -> Iterator[Output]:
        """Yield the outputs of `drain`; raise UndeclaredOutput for an undeclared output."""
        yield from self._declared(self.drain())

    def _declared(self, outputs: Iterable[Output] | None) -> Iterator[Output]:
        for output in outputs or ():
            if isinstance(output, Job):
                if not callable(getattr(self, f"on_job_{output.name}", None)):
                    raise UndeclaredOutput(
                        f"{self.name} starts job {output.name!r} but has no method on_job_{output.name}"
                    )
            else:
                self.check_output(*output)
                self.rejections.add_status(*output)
                self.figures.note(*output)
            yield output

    def check_output(self, topic_name: str, message: Message) -> None:
        """Raise UndeclaredOutput unless `topic_name` is an output of this node and `message` has its type."""
        if topic_name not in self.outputs:
            raise UndeclaredOutput(f"{self.name} published on {topic_name}, which is not among its outputs")
        if type(message) is not topic(topic_name).message:
            raise UndeclaredOutput(f"{self.name} published a {type(message).__name__} on {topic_name}")


def subscriptions(node: type[Node]) -> tuple[Input, ...]:
    """Return the inputs of a node class as `Input` objects (plain topic names are already converted)."""
    return tuple(i for i in node.inputs if isinstance(i, Input))


def merged_topics(node: type[Node]) -> tuple[str, ...]:
    """Return the topics of the inputs that are merged by stamp, in the order of the topic table.

    These are the `every` inputs except feedback and topics with `history`.
    """
    names = [
        i.topic
        for i in subscriptions(node)
        if i.effective_delivery == "every" and not (i.feedback or i.row.history)
    ]
    return tuple(sorted(names, key=ROW_NUMBER.__getitem__))
