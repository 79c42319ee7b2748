"""One deployment run live, as processes at the data's own speed, with a witness on the bus and on the CPU."""

from __future__ import annotations

import re
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import psutil

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.node import Input
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.tools.system.health_table import HealthBoard
from beamsplat.tools.system.supervisor import Supervisor

TOPICS = (
    "camera/image", "localization/odometry", "localization/correction", "depth/estimate", "fusion/depth",
    "keyframes/frame", "keyframes/ack", "mapping/chunk", "mapping/poses", "mapping/preview", "mapping/status",
)  # fmt: skip
DEPTH_STEP = 2  # kept depth is sampled so much


@dataclass
class Seen:
    """What went over the bus; times are the senders' monotonic clocks of one host."""

    images: dict[int, int] = field(default_factory=dict)  # stamp -> published
    poses: list[tuple[int, np.ndarray, str, bool]] = field(default_factory=list)  # T_map_body, status, metric
    pose_at_ns: dict[int, int] = field(default_factory=dict)  # stamp -> published
    estimates: dict[int, str] = field(default_factory=dict)  # stamp -> status
    fused: dict[int, tuple[int, str, bool]] = field(default_factory=dict)  # published, status, keyframe
    kept_estimates: dict[int, np.ndarray] = field(default_factory=dict)  # float16, every DEPTH_STEP-th pixel
    kept_fused: dict[int, np.ndarray] = field(default_factory=dict)
    kinds: set[str] = field(default_factory=set)
    keyframes: dict[int, int] = field(default_factory=dict)  # stamp -> published, the first time
    acks: dict[int, tuple[int, str]] = field(default_factory=dict)  # id -> published, status
    link_bytes: int = 0
    chunks: dict[int, Any] = field(default_factory=dict)  # the newest of each anchor
    online_chunks: dict[int, Any] | None = None  # when the data ended, before any refinement
    keyframe_poses: np.ndarray | None = None  # float64 [K, 4, 4] T_map_body, refined
    previews: list[tuple[int, np.ndarray, bytes]] = field(default_factory=list)  # stamp, T_map_camera, JPEG
    statuses: list[Any] = field(default_factory=list)
    refusals: dict[str, int] = field(default_factory=dict)  # why there was no pose or depth -> how often
    undecodable: int = 0


class Witness:
    """Takes every message of one run; depth is kept whole only at the stamps that have a truth."""

    def __init__(self, keep_depth_at: frozenset[int]) -> None:
        self.seen = Seen()
        self._keep_at = keep_depth_at
        self._T_map_odom = np.eye(4)
        self._ended_ns = 0
        self._lock = threading.Lock()

    def listen(self, bus: Bus) -> None:
        """Subscribes; callbacks come from threads of the bus."""
        for name in TOPICS:
            delivery = None if topic(name).delivery == "latched" else "every"
            bus.subscribe(Input(name, delivery), self._take, self._broken, lambda *_: None)

    def _broken(self, topic_name: str, why: str) -> None:
        self.seen.undecodable += 1

    def _take(self, envelope: Envelope) -> None:
        with self._lock:
            getattr(self, "_" + envelope.topic.replace("/", "_"))(envelope, envelope.message)
            if topic(envelope.topic).uplink in ("up", "bulk"):
                self.seen.link_bytes += envelope.size_bytes

    def _camera_image(self, envelope: Envelope, m: Any) -> None:
        self.seen.images[m.stamp_ns] = envelope.header.publish_ns

    def _localization_correction(self, envelope: Envelope, m: Any) -> None:
        self._T_map_odom = m.T_map_odom.copy()

    def _localization_odometry(self, envelope: Envelope, m: Any) -> None:
        self.seen.poses.append((m.stamp_ns, self._T_map_odom @ m.T_odom_body, m.status, m.metric))
        if m.status == "ok":
            self.seen.pose_at_ns[m.stamp_ns] = envelope.header.publish_ns
        else:
            self._count_refusal(f"pose, {m.status}: {m.detail}")

    def _count_refusal(self, why: str) -> None:
        """Numbers in the sentence do not make another reason."""
        reason = re.sub(r"-?\d+(\.\d+)?", "#", why)
        self.seen.refusals[reason] = self.seen.refusals.get(reason, 0) + 1

    def _depth_estimate(self, envelope: Envelope, m: Any) -> None:
        self.seen.estimates[m.stamp_ns] = m.status
        self.seen.kinds.add(m.kind)
        if m.stamp_ns in self._keep_at and m.status == "ok" and m.values.size:
            self.seen.kept_estimates[m.stamp_ns] = m.values[::DEPTH_STEP, ::DEPTH_STEP].astype(np.float16)

    def _fusion_depth(self, envelope: Envelope, m: Any) -> None:
        self.seen.fused[m.stamp_ns] = (envelope.header.publish_ns, m.status, m.keyframe)
        if m.status != "ok":
            self._count_refusal(f"depth: {m.status}")
        if m.stamp_ns in self._keep_at and m.status == "ok":
            self.seen.kept_fused[m.stamp_ns] = m.depth_m[::DEPTH_STEP, ::DEPTH_STEP].astype(np.float16)

    def _keyframes_frame(self, envelope: Envelope, m: Any) -> None:
        self.seen.keyframes.setdefault(m.stamp_ns, envelope.header.publish_ns)

    def _keyframes_ack(self, envelope: Envelope, m: Any) -> None:
        self.seen.acks.setdefault(m.id, (envelope.header.publish_ns, m.status))

    def _mapping_chunk(self, envelope: Envelope, m: Any) -> None:
        self.seen.chunks[m.anchor_id] = m
        if self.seen.online_chunks is not None and envelope.header.publish_ns <= self._ended_ns:
            self.seen.online_chunks[m.anchor_id] = m  # overtaken by the poses that ended the drive

    def _mapping_poses(self, envelope: Envelope, m: Any) -> None:
        if self.seen.online_chunks is None:
            self.seen.online_chunks, self._ended_ns = dict(self.seen.chunks), envelope.header.publish_ns
        self.seen.keyframe_poses = m.T_map_body.copy()

    def _mapping_preview(self, envelope: Envelope, m: Any) -> None:
        self.seen.previews.append((m.stamp_ns, m.T_map_camera.copy(), m.render.tobytes()))

    def _mapping_status(self, envelope: Envelope, m: Any) -> None:
        self.seen.statuses.append(m)


@dataclass
class Costs:
    """What the processes of a run used while data played, by node; start-up apart."""

    wall_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=dict)
    startup_cpu_s: float = 0.0
    peak_rss_mb: float = 0.0
    drained: bool = True  # all nodes had come to their end by themselves
    dropped: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)


class Observer:
    """A witness on the bus of a supervised system, and its costs while the data play."""

    def __init__(self, supervisor: Supervisor, deployment: Deployment, keep_depth_at: frozenset[int]) -> None:
        endpoints = deployment.router.listen
        self._witness, self.costs = Witness(keep_depth_at), Costs()
        self._bus = Bus(open_session(endpoints), deployment.robot, "witness", secrets.token_hex(8), 1)
        self._witness.listen(self._bus)
        self._meter = _Meter(supervisor)
        self._began = self._started = time.monotonic()
        self._state = "starting"

    @property
    def seen(self) -> Seen:
        """What went over the bus so far."""
        return self._witness.seen

    def poll(self) -> None:
        """Looks at the processes; to be called a few times a second."""
        if self._state == "over":
            return
        self._meter.read()
        if self._state == "starting" and self.seen.images:
            self._state, self._started = "driving", time.monotonic()
            self.costs.startup_cpu_s = self._meter.mark()
        self._count()
        if self.seen.online_chunks is not None:  # what comes now is refinement of a map that is whole
            self._state = "over"

    def _count(self) -> None:
        self.costs.wall_s = time.monotonic() - self._started
        self.costs.cpu_s, self.costs.peak_rss_mb = self._meter.since_mark(), self._meter.peak_rss_mb

    def finish(self, board: HealthBoard, drained: bool) -> tuple[Seen, Costs]:
        """Takes what is still on its way and what the nodes counted, and leaves the bus."""
        self.costs.drained = drained
        for name, record in board.records.items():
            self.costs.dropped[name] = sum(i.dropped for i in record.health.inputs)
            self.costs.lost[name] = sum(i.lost for i in record.health.inputs)
        time.sleep(0.5)
        self._bus.session.close()
        return self.seen, self.costs


def run_live(
    deployment: Deployment, keep_depth_at: frozenset[int], longest_s: float, say: Callable[[str], None]
) -> tuple[Seen, Costs]:
    """Runs until all nodes have drained.

    Raises:
        UserError: a node cannot run.
    """
    events: list[str] = []
    with (
        Supervisor(deployment, on_event=events.append) as supervisor,
        open_session(deployment.router.listen) as board_session,
    ):
        observer = Observer(supervisor, deployment, keep_depth_at)
        board = HealthBoard(board_session, deployment.robot)
        deadline = time.monotonic() + longest_s
        drained = False
        while not drained and time.monotonic() < deadline:
            time.sleep(0.2)
            supervisor.poll()
            observer.poll()
            failed = next((c.name for c in supervisor.children.values() if c.gave_up), None)
            if failed:
                raise UserError(next(e for e in events if e.startswith(f"{failed} cannot run")))
            states = board.states()
            drained = all(states.get(name) == "drained" for name in deployment.nodes)
        result = observer.finish(board, drained)
    for event in events:
        say(event)
    return result


class _Meter:
    """CPU seconds and memory (proportional set size) of the supervisor's children."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._last: dict[tuple[str, int], float] = {}
        self._marked: dict[tuple[str, int], float] = {}
        self.peak_rss_mb = 0.0
        self._weighed = 0.0

    def read(self) -> None:
        """Looks at all children; a process that has gone keeps what it was last seen with."""
        memory, now = 0.0, time.monotonic()
        weigh = now - self._weighed > 1.0  # reading it costs milliseconds a process
        self._weighed = now if weigh else self._weighed
        for child in self._supervisor.children.values():
            try:
                process = psutil.Process(child.process.pid)
                times = process.cpu_times()
                if weigh:  # shared pages count once: the processes come from one fork server
                    memory += process.memory_full_info().pss / 1e6
            except psutil.Error:
                continue
            self._last[child.name, child.process.pid] = times.user + times.system
        self.peak_rss_mb = max(self.peak_rss_mb, memory)

    def mark(self) -> float:
        """Counts from here; gives the CPU seconds before."""
        self._marked = dict(self._last)
        return sum(self._marked.values())

    def since_mark(self) -> dict[str, float]:
        """CPU seconds by node since `mark`."""
        out: dict[str, float] = {}
        for (name, pid), seconds in self._last.items():
            out[name] = out.get(name, 0.0) + seconds - self._marked.get((name, pid), 0.0)
        return out
