"""What a campaign observes from outside: poses, keyframes, and the health of every process."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from beamsplat.common.messages import KeyframeAck, Message, Odometry
from beamsplat.common.messages.header import DecodeError, Header
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.streams import decode_sample
from beamsplat.tools.bench.faults.hosts import ROBOT_NAME, ROUTER, CampaignHost
from beamsplat.tools.system.health_table import HealthTable

FORGED_INSTANCE = "badbadbadbadbad0"  # of headers that the campaign itself writes
GAP_S = 1.0  # between two poses: ten scans; a shorter gap is not counted
_QUEUE_SUFFIX = ".keyframe"
_START_S = 120.0  # limit for the start of a router
_WAITING = 256  # samples in a subscription's channel


def _genuine(sample: zenoh.Sample, name: str) -> Message | None:
    """Return the message in a sample of the topic `name`; None if it is garbage that a fault has sent."""
    try:
        envelope = decode_sample(sample, topic(name))
    except DecodeError:
        return None
    return None if envelope.header.instance == FORGED_INSTANCE else envelope.message


@dataclass(frozen=True)
class Gap:
    """Time without localization: between two valid poses, in s since the start of the watch."""

    start_s: float
    end_s: float
    rejected: dict[str, int] = field(default_factory=dict)  # status of the poses in it -> count

    @property
    def seconds(self) -> float:
        return self.end_s - self.start_s


@dataclass
class PoseWatch:
    """Times of the valid poses that localization publishes; fed from a thread of the bus."""

    began: float = field(default_factory=time.monotonic)
    last_s: float = 0.0
    gaps: list[Gap] = field(default_factory=list)
    # Status of the poses since the last valid one -> count.
    rejected: dict[str, int] = field(default_factory=dict)

    def begin(self) -> None:
        """Begin again: now is time 0, and there are no gaps."""
        self.began, self.last_s = time.monotonic(), 0.0
        self.gaps, self.rejected = [], {}

    def take(self, sample: zenoh.Sample) -> None:
        """Take a sample of `localization/odometry`."""
        message = _genuine(sample, "localization/odometry")
        if not isinstance(message, Odometry):
            return
        if message.status != "ok":
            self.rejected[message.status] = self.rejected.get(message.status, 0) + 1
            return
        self.finish()
        self.last_s, self.rejected = time.monotonic() - self.began, {}

    def finish(self) -> None:
        """Add the time since the last valid pose, if it is a gap."""
        now_s = time.monotonic() - self.began
        if now_s - self.last_s > GAP_S:
            self.gaps.append(Gap(self.last_s, now_s, self.rejected))


@dataclass
class KeyframeWatch:
    """Ids of the keyframes that the robot has published or stored, and of those that the mapper refused."""

    outbox: Path
    made: set[int] = field(default_factory=set)
    acknowledged: set[int] = field(default_factory=set)
    refused: dict[int, str] = field(default_factory=dict)  # id -> reason

    def take_frame(self, sample: zenoh.Sample) -> None:
        """Take a sample of `keyframes/frame` on the robot."""
        try:
            header = Header.unpack(sample.attachment.to_bytes() if sample.attachment else b"")
        except DecodeError:
            return
        if header.producer == "keyframes" and header.instance != FORGED_INSTANCE:
            self.made.add(header.stamp_ns)

    def take_ack(self, sample: zenoh.Sample) -> None:
        """Take a sample of `keyframes/ack`."""
        ack = _genuine(sample, "keyframes/ack")
        if not isinstance(ack, KeyframeAck):
            return
        if ack.status == "ok":
            self.acknowledged.add(ack.id)
        else:
            self.refused[ack.id] = ack.status

    def waiting(self) -> set[int]:
        """Return the ids in the robot's outbox on the disk; they are also added to `made`."""
        found = {
            int(path.name.removesuffix(_QUEUE_SUFFIX))
            for path in self.outbox.glob(f"[0-9]*{_QUEUE_SUFFIX}")
            if path.name.removesuffix(_QUEUE_SUFFIX).isdecimal()
        }
        self.made |= found
        return found


class HostWatch:
    """Health of the processes of one host, through a session of the operator that reconnects by itself."""

    def __init__(self, host: CampaignHost) -> None:
        """Open the session.

        Raises:
            UserError: the router does not answer.
        """
        self.host = host
        self.session = host.session(_START_S)
        self.health = HealthTable(self.session, ROBOT_NAME)
        self._kept: list[zenoh.Subscriber] = []

    def subscribe(self, name: str, take: Callable[[zenoh.Sample], None]) -> None:
        """Call `take` with every sample on the topic `name`, from a thread."""
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(_WAITING)
        subscriber = self.session.declare_subscriber(key(ROBOT_NAME, name), channel)
        self._kept.append(subscriber)
        receive_in_thread(self.session, f"watch-{name}", subscriber, take)

    def close(self) -> None:
        """Close the session, and with it all subscriptions."""
        self.session.close()

    def unhealthy(self) -> dict[str, str]:
        """Return what is wrong with each process of the host that does not work: nothing if all do."""
        states, pids = self.health.states(), self.host.pids()
        wrong = {}
        for name in self.host.nodes:
            if name not in pids:
                wrong[name] = "not running"
            elif name == ROUTER:
                if not list(self.session.info.routers_zid()):
                    wrong[name] = "does not answer"
            elif states.get(name) != "active":
                record = self.health.records.get(name)
                detail = record.health.detail if record is not None else ""
                wrong[name] = states.get(name, "never reported") + (f" ({detail})" if detail else "")
        uplink = self.health.records.get("uplink")
        linked = uplink is None or uplink.health.detail.startswith("connected")
        if self.host.role == "robot" and uplink is not None and not linked:
            wrong.setdefault("uplink", uplink.health.detail)
        return wrong

    def instances(self) -> dict[str, str]:
        """Return the instance id of the process of each node that has reported."""
        return {name: record.health.instance for name, record in dict(self.health.records).items()}
