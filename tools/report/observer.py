"""Run a deployment live, as processes in real time, and record its messages, CPU time and memory."""

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
from beamsplat.common.mapfiles.anchor_poses import AnchorPoses
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.node import Input
from beamsplat.common.topics import Delivery, topic
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor

IMAGES = "camera/image"
TOPICS = (
    "localization/odometry", "localization/correction", "depth/estimate", "fusion/depth",
    "keyframes/frame", "keyframes/ack", "mapping/chunk", "mapping/anchors", "mapping/poses",
    "mapping/preview", "mapping/status",
)  # fmt: skip
DEPTH_STRIDE = 2  # recorded depth maps keep every second row and column


@dataclass
class RunRecord:
    """Contents of the messages of one run. Stamps are in ns.

    Times of publication are monotonic clock readings in ns; all publishers run on the same host.
    """

    images: dict[int, int] = field(default_factory=dict)  # stamp -> time of publication
    poses: list[tuple[int, np.ndarray, str, bool]] = field(default_factory=list)  # T_map_body, status, metric
    pose_at_ns: dict[int, int] = field(default_factory=dict)  # stamp -> time of publication
    estimates: dict[int, str] = field(default_factory=dict)  # stamp -> status
    fused: dict[int, tuple[int, str, bool]] = field(
        default_factory=dict
    )  # stamp -> publication, status, keyframe
    kept_estimates: dict[int, np.ndarray] = field(
        default_factory=dict
    )  # float16, every DEPTH_STRIDE-th pixel
    kept_fused: dict[int, np.ndarray] = field(default_factory=dict)
    kinds: set[str] = field(default_factory=set)
    keyframes: dict[int, int] = field(default_factory=dict)  # stamp -> time of first publication
    acks: dict[int, tuple[int, str]] = field(default_factory=dict)  # id -> publication, status
    link_bytes: int = 0
    chunks: dict[int, Any] = field(default_factory=dict)  # newest chunk of each anchor
    online_chunks: dict[int, Any] | None = None  # `chunks` at the end of the data
    keyframe_poses: np.ndarray | None = None  # float64 [K, 4, 4] T_map_body, refined
    previews: list[tuple[int, np.ndarray, bytes]] = field(default_factory=list)  # stamp, T_map_camera, JPEG
    statuses: list[Any] = field(default_factory=list)
    refusals: dict[str, int] = field(default_factory=dict)  # reason for a missing pose or depth -> count
    undecodable: int = 0


class BusObserver:
    """Subscriber to `IMAGES` and all `TOPICS` of one run, which stores the messages in `record`.

    Depth maps are stored only for the stamps `keep_depth_at`.
    """

    def __init__(self, keep_depth_at: frozenset[int]) -> None:
        self.record = RunRecord()
        self._keep_at = keep_depth_at
        self._T_map_odom = np.eye(4)
        self._ended_ns = 0
        self._mapper = ""  # instance of the mapper process that has sent `chunks`
        self._poses = AnchorPoses()
        self._lock = threading.Lock()

    def subscribe(self, bus: Bus) -> None:
        """Subscribe to IMAGES and all TOPICS; callbacks run in threads of the bus."""
        # Of images only the time of publication is recorded: their payloads are not read.
        bus.subscribe_headers(Input(IMAGES, "every"), self._receive_image, self._count_undecodable)
        for name in TOPICS:
            delivery: Delivery | None = None if topic(name).delivery == "latched" else "every"
            bus.subscribe(Input(name, delivery), self._receive, self._count_undecodable, lambda *_: None)

    def _count_undecodable(self, topic_name: str, why: str) -> None:
        self.record.undecodable += 1

    def _receive(self, envelope: Envelope) -> None:
        with self._lock:
            getattr(self, "_" + envelope.topic.replace("/", "_"))(envelope, envelope.message)
            if topic(envelope.topic).uplink in ("up", "bulk"):
                self.record.link_bytes += envelope.size_bytes

    def _receive_image(self, header: Header) -> None:
        with self._lock:
            self.record.images[header.stamp_ns] = header.publish_ns

    def _localization_correction(self, envelope: Envelope, m: Any) -> None:
        self._T_map_odom = m.T_map_odom.copy()

    def _localization_odometry(self, envelope: Envelope, m: Any) -> None:
        self.record.poses.append((m.stamp_ns, self._T_map_odom @ m.T_odom_body, m.status, m.metric))
        if m.status == "ok":
            self.record.pose_at_ns[m.stamp_ns] = envelope.header.publish_ns
        else:
            self._count_refusal(f"pose, {m.status}: {m.detail}")

    def _count_refusal(self, why: str) -> None:
        """Count a reason for a missing pose or depth; texts that differ only in numbers are one reason."""
        reason = re.sub(r"-?\d+(\.\d+)?", "#", why)
        self.record.refusals[reason] = self.record.refusals.get(reason, 0) + 1

    def _depth_estimate(self, envelope: Envelope, m: Any) -> None:
        self.record.estimates[m.stamp_ns] = m.status
        self.record.kinds.add(m.kind)
        if m.stamp_ns in self._keep_at and m.status == "ok" and m.values.size:
            self.record.kept_estimates[m.stamp_ns] = m.values[::DEPTH_STRIDE, ::DEPTH_STRIDE].astype(
                np.float16
            )

    def _fusion_depth(self, envelope: Envelope, m: Any) -> None:
        self.record.fused[m.stamp_ns] = (envelope.header.publish_ns, m.status, m.keyframe)
        if m.status != "ok":
            self._count_refusal(f"depth: {m.status}")
        if m.stamp_ns in self._keep_at and m.status == "ok":
            self.record.kept_fused[m.stamp_ns] = m.depth_m[::DEPTH_STRIDE, ::DEPTH_STRIDE].astype(np.float16)

    def _keyframes_frame(self, envelope: Envelope, m: Any) -> None:
        self.record.keyframes.setdefault(m.stamp_ns, envelope.header.publish_ns)

    def _keyframes_ack(self, envelope: Envelope, m: Any) -> None:
        self.record.acks.setdefault(m.id, (envelope.header.publish_ns, m.status))

    def _follow_mapper(self, instance: str) -> None:
        """Discard the map of a mapper process that was replaced: the new one sends its own map."""
        if self._mapper not in ("", instance):
            self.record.chunks.clear()
            self._poses.clear()
            self.record.keyframe_poses = None
        self._mapper = instance

    def _mapping_chunk(self, envelope: Envelope, m: Any) -> None:
        self._follow_mapper(envelope.header.instance)
        self._poses.update(m.pose_revision, [(m.anchor_id, m.T_map_anchor)])
        for chunks in self._maps(envelope):
            chunks[m.anchor_id] = self._posed(m)

    def _mapping_anchors(self, envelope: Envelope, m: Any) -> None:
        self._follow_mapper(envelope.header.instance)
        self._poses.update(m.pose_revision, zip(m.anchor_ids.tolist(), m.T_map_anchor))
        for chunks in self._maps(envelope):
            chunks.update({anchor: self._posed(chunk) for anchor, chunk in chunks.items()})

    def _posed(self, chunk: Any) -> Any:
        """Return a chunk with the newest pose of its anchor."""
        return chunk.model_copy(update={"T_map_anchor": self._poses.pose(chunk.anchor_id)})

    def _maps(self, envelope: Envelope) -> list[dict[int, Any]]:
        """Return the chunks of the maps to which a message belongs: one sent before the final poses, and
        received after them, belongs to the map at the end of the drive too."""
        online = self.record.online_chunks
        late = online is not None and envelope.header.publish_ns <= self._ended_ns
        return [self.record.chunks, online] if late and online is not None else [self.record.chunks]

    def _mapping_poses(self, envelope: Envelope, m: Any) -> None:
        self._follow_mapper(envelope.header.instance)
        if self.record.online_chunks is None:
            self.record.online_chunks, self._ended_ns = dict(self.record.chunks), envelope.header.publish_ns
        self.record.keyframe_poses = m.T_map_body.copy()

    def _mapping_preview(self, envelope: Envelope, m: Any) -> None:
        self.record.previews.append((m.stamp_ns, m.T_map_camera.copy(), m.render.tobytes()))

    def _mapping_status(self, envelope: Envelope, m: Any) -> None:
        self.record.statuses.append(m)


@dataclass
class RunCosts:
    """CPU time and memory of the processes of a run, from the first image to the end of the drive."""

    wall_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=dict)
    startup_cpu_s: float = 0.0
    peak_rss_mb: float = 0.0
    drained: bool = True  # whether all nodes finished by themselves
    dropped: dict[str, int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)


class RunObserver:
    """Recorder of the messages, CPU time and memory of a supervised system while a recording is played."""

    def __init__(self, supervisor: Supervisor, deployment: Deployment, keep_depth_at: frozenset[int]) -> None:
        endpoints = deployment.router.listen
        self._bus_observer, self.costs = BusObserver(keep_depth_at), RunCosts()
        self._bus = Bus(open_session(endpoints), deployment.robot, "observer", secrets.token_hex(8), 1)
        self._bus_observer.subscribe(self._bus)
        self._meter = _ProcessMeter(supervisor)
        self._began = self._started = time.monotonic()
        self._state = "starting"

    @property
    def record(self) -> RunRecord:
        """Contents of the messages received so far."""
        return self._bus_observer.record

    def poll(self) -> None:
        """Measure CPU time and memory of the processes; call this several times per second.

        After the end of the drive, nothing is measured any more.
        """
        if self._state == "over":
            return
        self._meter.read()
        if self._state == "starting" and self.record.images:
            self._state, self._started = "driving", time.monotonic()
            self.costs.startup_cpu_s = self._meter.mark()
        self._update_costs()
        if self.record.online_chunks is not None:  # the drive has ended; from now on the map is only refined
            self._state = "over"

    def _update_costs(self) -> None:
        self.costs.wall_s = time.monotonic() - self._started
        self.costs.cpu_s, self.costs.peak_rss_mb = self._meter.since_mark(), self._meter.peak_rss_mb

    def finish(self, board: HealthTable, drained: bool) -> tuple[RunRecord, RunCosts]:
        """Wait 0.5 s for the last messages, disconnect from the bus, and return messages and costs.

        Args:
            board: health of the nodes, from which counts of dropped and lost messages are copied.
            drained: whether all nodes have finished their work.
        """
        self.costs.drained = drained
        for name, record in board.records.items():
            self.costs.dropped[name] = sum(i.dropped for i in record.health.inputs)
            self.costs.lost[name] = sum(i.lost for i in record.health.inputs)
        time.sleep(0.5)
        self._bus.session.close()
        return self.record, self.costs


def run_live(
    deployment: Deployment, keep_depth_at: frozenset[int], longest_s: float, log: Callable[[str], None]
) -> tuple[RunRecord, RunCosts]:
    """Run a deployment until all nodes have drained; return its messages, CPU time and memory.

    Args:
        keep_depth_at: stamps in ns whose depth maps are stored.
        longest_s: time limit after which the run is stopped, s.
        log: receives the events of the supervisor.

    Raises:
        UserError: a node cannot run.
    """
    events: list[str] = []
    with (
        Supervisor(deployment, on_event=events.append) as supervisor,
        open_session(deployment.router.listen) as board_session,
    ):
        observer = RunObserver(supervisor, deployment, keep_depth_at)
        board = HealthTable(board_session, deployment.robot)
        deadline = time.monotonic() + longest_s
        drained = False
        while not drained and time.monotonic() < deadline:
            time.sleep(0.2)
            supervisor.poll()
            supervisor.observe(board.reported())
            observer.poll()
            if supervisor.obstacle:
                raise UserError(supervisor.obstacle)
            states = board.states()
            drained = all(states.get(name) == "drained" for name in deployment.nodes)
        result = observer.finish(board, drained)
    for event in events:
        log(event)
    return result


class _ProcessMeter:
    """Meter of CPU time (s) and memory (proportional set size, MB) of the supervisor's child processes."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._last: dict[tuple[str, int], float] = {}
        self._marked: dict[tuple[str, int], float] = {}
        self.peak_rss_mb = 0.0
        self._memory_read_s = 0.0

    def read(self) -> None:
        """Read CPU time and memory of all child processes; an exited process keeps its last CPU time."""
        memory, now = 0.0, time.monotonic()
        read_memory = now - self._memory_read_s > 1.0  # it costs milliseconds per process
        self._memory_read_s = now if read_memory else self._memory_read_s
        seen: set[int] = set()
        for child in self._supervisor.children.values():
            try:
                pid = child.process.pid
                if pid is None or pid in seen:  # not started, or shared with another node
                    continue
                seen.add(pid)
                process = psutil.Process(pid)
                times = process.cpu_times()
                if read_memory:  # PSS counts shared pages once: all processes are forked from one server
                    memory += process.memory_full_info().pss / 1e6
            except psutil.Error:
                continue
            self._last[self._supervisor.process_name(child.name), pid] = times.user + times.system
        self.peak_rss_mb = max(self.peak_rss_mb, memory)

    def mark(self) -> float:
        """Set the reference of `since_mark` to the last `read`; return the CPU time in s used until then."""
        self._marked = dict(self._last)
        return sum(self._marked.values())

    def since_mark(self) -> dict[str, float]:
        """Return the CPU time in s since `mark`, by name of the node."""
        out: dict[str, float] = {}
        for (name, pid), seconds in self._last.items():
            out[name] = out.get(name, 0.0) + seconds - self._marked.get((name, pid), 0.0)
        return out
