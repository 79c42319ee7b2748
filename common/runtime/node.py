"""A node: messages in, messages out. It knows neither the bus nor the time of day.

A subclass names its topics and has one handler per input, a generator of what it sends:

    class Localization(Node):
        name = "localization"
        inputs = ("lidar/scan", "wheel/odometry")
        outputs = ("localization/odometry",)

        def on_lidar_scan(self, scan: Scan) -> Outputs:
            yield "localization/odometry", Odometry(...)

What is misspelt or missing fails when the class is defined. The same node runs under
`runtime.live` (a process on Zenoh) and `runtime.lockstep` (all nodes in one reproducible thread).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages import Health, Message
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.topics import ROW_NUMBER, Delivery, Topic, topic


@dataclass(frozen=True)
class Input:
    """A subscription: a topic, and a delivery other than its row's default.

    `feedback` marks what depends on this node's own output (an acknowledgement): it is taken as it comes,
    not merged by stamp, and the node ends without waiting for its end: both would wait for themselves. What
    comes after the node's own end is still heard, but what the handler yields then goes nowhere.

    `queued_bytes` of an `every` input wait at most; beyond them the oldest goes, and is counted.
    """

    topic: str
    delivery: Delivery | None = None
    feedback: bool = False
    queued_bytes: int = 256 * 1024 * 1024  # pictures for a recorder whose disk has stalled

    @property
    def row(self) -> Topic:
        return topic(self.topic)

    @property
    def effective_delivery(self) -> Delivery:
        return self.delivery or self.row.delivery


@dataclass(frozen=True)
class Job:
    """Long work, yielded by a handler; its result comes back as `on_job_<name>(result)`.

    `run` must hold no reference to state that the node changes meanwhile. With `after = n` the result
    is taken in just before the n-th next message (on topic `of`, where given), and waited for:
    reproducible in both runners. With None it is taken in when it is there.
    """

    name: str
    run: Callable[[], Any]
    after: int | None = None
    of: str | None = None


class SourceItem(NamedTuple):
    """What `source()` yields: `at_ns` is the arrival time on a recording's clock, by which runners
    pace and order; None means now (a real device)."""

    at_ns: int | None
    topic: str
    message: Message


Output = tuple[str, Message] | Job
Outputs = Iterator[Output]
QueryFunction = Callable[
    [str, str, dict[str, str], float], Iterator[Message]
]  # node, query, parameters, time-out in s


class UndeclaredOutput(RuntimeError):
    """A node wrote a topic, or started a job, that it does not declare."""


class Node:
    """Base of all nodes. Life: configure() -> messages -> drain() -> close()."""

    name: ClassVar[str] = ""
    Config: ClassVar[type[NodeConfig]] = NodeConfig
    inputs: ClassVar[tuple[str | Input, ...]] = ()
    outputs: ClassVar[tuple[str, ...]] = ()
    # A second one may run beside it and take over: all it knows comes from its inputs of the last seconds,
    # or (`hands_over`) is left by the one and taken up by the other, whose inputs wait until then.
    replaceable: ClassVar[bool] = False
    hands_over: ClassVar[bool] = False

    def __init__(self, config: NodeConfig) -> None:
        self.config = config
        self.live_settings: LiveSettings | None = None  # live only: robot, router and state folder
        self.detail = ""  # one line that the node wants shown beside its health

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if not cls.name:  # an abstract base between Node and the real ones
            return
        cls.inputs = tuple(Input(i) if isinstance(i, str) else i for i in cls.inputs)
        for entry in cls.inputs:
            if not callable(getattr(cls, entry.row.handler, None)):
                raise TypeError(f"{cls.__name__} takes {entry.topic} but has no {entry.row.handler}")
        for name in cls.outputs:
            if cls.name not in topic(name).producers:
                raise TypeError(
                    f"{cls.__name__} ({cls.name}) writes {name}, whose producers are {topic(name).producers}"
                )

    # --- life cycle: override what is needed ---

    def configure(self) -> None:
        """Loads and warms what the first message must not wait for."""

    def check_resources(self) -> None:
        """Looks, before anything runs and without keeping it, whether what the options name is there.

        Raises:
            UserError: it is not, or cannot be used.
        """

    def drain(self) -> Iterable[Output]:
        """Last outputs, when all inputs have ended."""
        return ()

    def close(self) -> None:
        """Releases files and devices. Called once, also after an error."""

    def source(self) -> Iterator[SourceItem | None]:
        """Sensors override this; a node with a source has no inputs. A device yields None several times a
        second while it has nothing to say, so that the runner can look after the rest."""
        return iter(())

    def on_health(self, health: Health) -> None:
        """Those that watch override this: the health of every node, live only."""

    def set_query_function(self, ask: QueryFunction) -> None:
        """Those that command others override this: how to ask a node something, live only."""

    def on_arrival(self, topic: str, message: Message) -> Iterable[Output]:
        """Sees each message as it arrives, before its turn among others: what must not wait while a step
        takes long. Live it is called from other threads than everything else."""
        return ()

    def on_header(self, header: Header) -> None:
        """Sees what rode beside the message that is handled next; the recorder keeps it."""

    def handover_obstacle(self, before: Node) -> str:
        """Why this one, not configured yet, cannot take over from `before` while that runs; "" if it can."""
        return "" if self.replaceable else "what it knows lives in its process"

    def hand_over(self) -> None:
        """Between two messages: leaves what it knows where its successor finds it, and lets go of it. Raises
        UserError where that fails: it goes on as it was."""

    def take_over(self) -> None:
        """Takes up what its predecessor has left. Not called where there was none: see `in_standby`."""

    @property
    def in_standby(self) -> bool:
        """Whether `take_over` is still to come; `configure` leaves alone what a predecessor holds."""
        return self.live_settings is not None and self.live_settings.standby

    def awaits_feedback(self) -> bool:
        """Whether this node, whose inputs have ended, should hear more of what is fed back before it ends."""
        return False

    def on_feedback_timeout(self, seconds: float) -> Iterable[Output]:
        """Live only: so long nothing came to a node that awaits answers after the end of its inputs."""
        return ()

    # --- used by the runners ---

    @classmethod
    def is_source(cls) -> bool:
        """Whether this node makes messages of its own."""
        return cls.source is not Node.source

    @classmethod
    def watches_health(cls) -> bool:
        """Whether the health of all nodes is brought to this one."""
        return cls.on_health is not Node.on_health

    @classmethod
    def queries(cls) -> tuple[str, ...]:
        """Names of the queries it answers: its `on_query_<name>(parameters)` generators."""
        prefix = "on_query_"
        return tuple(sorted(n.removeprefix(prefix) for n in dir(cls) if n.startswith(prefix)))

    def handle(self, topic_name: str, message: Message) -> Iterator[Output]:
        """What the handler of `topic_name` sends, each checked to be declared."""
        yield from self._declared(getattr(self, topic(topic_name).handler)(message))

    def handle_arrival(self, topic_name: str, message: Message) -> Iterator[Output]:
        """What `on_arrival` sends."""
        yield from self._declared(self.on_arrival(topic_name, message))

    def handle_job(self, name: str, result: Any) -> Iterator[Output]:
        """What `on_job_<name>` sends."""
        yield from self._declared(getattr(self, f"on_job_{name}")(result))

    def handle_feedback_timeout(self, seconds: float) -> Iterator[Output]:
        """What `on_feedback_timeout` sends."""
        yield from self._declared(self.on_feedback_timeout(seconds))

    def handle_drain(self) -> Iterator[Output]:
        """What `drain` sends."""
        yield from self._declared(self.drain())

    def _declared(self, outputs: Iterable[Output] | None) -> Iterator[Output]:
        for output in outputs or ():
            if isinstance(output, Job):
                if not callable(getattr(self, f"on_job_{output.name}", None)):
                    raise UndeclaredOutput(
                        f"{self.name} starts job {output.name!r} but has no on_job_ for it"
                    )
            else:
                self.check_output(*output)
            yield output

    def check_output(self, topic_name: str, message: Message) -> None:
        """Raises UndeclaredOutput unless this node may send this message there."""
        if topic_name not in self.outputs:
            raise UndeclaredOutput(f"{self.name} wrote {topic_name}, which is not among its outputs")
        if type(message) is not topic(topic_name).message:
            raise UndeclaredOutput(f"{self.name} wrote a {type(message).__name__} to {topic_name}")


def merged_topics(node: type[Node]) -> tuple[str, ...]:
    """The inputs that are merged by stamp before the node sees them: its `every` ones, in row order."""
    names = [i.topic for i in node.inputs if i.effective_delivery == "every" and not i.feedback]
    return tuple(sorted(names, key=ROW_NUMBER.__getitem__))
