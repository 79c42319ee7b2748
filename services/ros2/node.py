"""A ROS 2 robot as a source, over rmw_zenoh's keys and without ROS."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Iterator

import zenoh
import zenoh.ext

from beamsplat.common.geometry.rig import check_rig_option
from beamsplat.common.recording.ros_types import typestore
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.rmw import ADMIN, Address, Attachment, Entity, Qos, dds_type
from beamsplat.services.ros2.config import Ros2Config
from beamsplat.services.ros2.robot import Robot, RobotOptions
from beamsplat.services.ros2.topics import IMAGE, TF, WANTED

_POLL_S = 0.1
_QUEUED = 1000
_FIFO = 256


class Ros2Node(Node):
    """Sensors of a robot that speaks ROS 2: calibration, scans, pictures, odometry, pose."""

    name = "ros2"
    Config = Ros2Config
    config: Ros2Config
    outputs = ("rig", "wheel/odometry", "lidar/scan", "camera/image", "external/pose")

    def configure(self) -> None:
        c = self.config
        words = {
            "image": c.image_topic,
            "scan": c.scan_topic,
            "odometry": c.odometry_topic,
            "pose": c.pose_topic,
        }
        options = RobotOptions(
            topics={word: name for word, name in words.items() if name},
            camera_info_topic=c.camera_info_topic, body_frame=c.body_frame, rig=c.rig,
            without=frozenset(c.without), assume_mounts=c.assume_mounts, settle_s=c.settle_s,
        )  # fmt: skip
        self.robot = Robot(options)
        self._clock = StampClock()
        self._samples: queue.Queue[zenoh.Sample] = queue.Queue(_QUEUED)
        self._overflowed = 0
        self._kept: list[object] = []  # what is dropped would be undeclared
        self._subscribed: dict[str, str] = {}  # type by key
        self._unwanted: set[str] = set()  # keys whose subscribers are to end
        self._tidied = False
        self._own: set[bytes] = set()  # publishers of /tf that are ours
        self._session = open_session((c.router,))
        self._listen()

    def check_resources(self) -> None:
        check_rig_option(self.config.rig)

    def source(self) -> Iterator[SourceItem | None]:
        """What the robot's sensors say; None while they say nothing."""
        while True:
            try:
                sample = self._samples.get(timeout=_POLL_S)
            except queue.Empty:
                self.detail = self.robot.status
                yield None
                continue
            yield from self._take(sample) or (None,)
            lost = f"; {self._overflowed} overtaken" if self._overflowed else ""
            self.detail = f"{self.robot.status}{lost}"

    def close(self) -> None:
        if hasattr(self, "_session"):
            self._session.close()

    def _take(self, sample: zenoh.Sample) -> list[SourceItem]:
        key = str(sample.key_expr)
        if key.startswith(ADMIN):
            self._hear_of(key, sample.kind)
            return []
        address = Address.of(key)
        if address is None or address.type_name not in WANTED:
            return []
        if address.type_name == TF and self._is_own(sample):
            return []
        found = self.robot.take(
            address.topic,
            address.type_name,
            sample.payload.to_bytes(),
            self._clock.now_ns(),
            time.monotonic(),
        )
        if self.robot.rig is not None and not self._tidied:
            self._tidy()
        return [SourceItem(None, topic, message) for topic, message in found]

    def _is_own(self, sample: zenoh.Sample) -> bool:
        attachment = Attachment.unpack(sample.attachment.to_bytes()) if sample.attachment else None
        return attachment is not None and attachment.gid in self._own

    def _tidy(self) -> None:
        """The topics are chosen: transforms and raw pictures of others need not come any more."""
        self._tidied = True
        chosen = {topic.strip("/") for topic in self.robot.chosen}
        for key, type_name in self._subscribed.items():
            topic = key.split("/", 1)[1].rsplit("/", 2)[0]
            if (type_name == TF and not self.robot.wants_frames) or (
                type_name == IMAGE and topic not in chosen
            ):
                self._unwanted.add(key)

    def _hear_of(self, token: str, kind: zenoh.SampleKind) -> None:
        """A publisher has shown itself. Raw pictures are heavy: only those that exist are asked for."""
        entity = Entity.parse(token)
        if entity is None or entity.kind != "MP" or kind != zenoh.SampleKind.PUT:
            return
        if entity.node_name == "beamsplat":  # our own answers
            if entity.type_name == TF:  # the robot's own comes under the same name
                self._own.add(entity.gid())
            else:
                self.robot.ignore(entity.topic)
            return
        self.robot.offer(entity.topic, entity.type_name)
        asked = self.config.image_topic.strip("/") in ("", entity.topic.strip("/"))
        if entity.type_name == IMAGE and asked and "image" not in self.config.without:
            self._subscribe(f"{entity.domain}/{entity.topic.strip('/')}/{dds_type(IMAGE)}/*", IMAGE)

    def _listen(self) -> None:
        domain = self.config.domain
        for type_name in sorted(WANTED - {IMAGE}):
            self._subscribe(f"{domain}/**/{dds_type(type_name)}/*", type_name)
        if self.config.image_topic:
            self._subscribe(f"{domain}/{self.config.image_topic.strip('/')}/{dds_type(IMAGE)}/*", IMAGE)
        tokens = self._session.liveliness().declare_subscriber(
            f"{ADMIN}/{domain}/**", zenoh.handlers.FifoChannel(_FIFO), history=True
        )
        self._pump(tokens, ADMIN)
        # Transforms said once, kept by publishers from before Zenoh's advanced ones.
        for reply in self._session.get(f"{domain}/tf_static/*/*", timeout=1.0):
            if reply.ok is not None:
                self._put(reply.ok)
        self._kept.append(
            self._session.liveliness().declare_token(
                Entity(domain, str(self._session.zid()), 0, 0, "NN", "beamsplat").token()
            )
        )

    def _subscribe(self, key: str, type_name: str) -> None:
        if key in self._subscribed or self._tidied:
            return
        channel = zenoh.handlers.FifoChannel(_FIFO)
        if type_name == TF:  # /tf_static is said once, to be found by who comes later
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session, key, channel,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True),
            )  # fmt: skip
        else:
            subscriber = self._session.declare_subscriber(key, channel)
        self._subscribed[key] = type_name
        self._pump(subscriber, key)
        topic = key.split("/", 1)[1].rsplit("/", 2)[0]
        if topic != "**":
            entity = Entity(
                self.config.domain, str(self._session.zid()), 0, len(self._subscribed), "MS", "beamsplat",
                topic="/" + topic, type_name=type_name, type_hash=typestore().hash_rihs01(type_name),
                qos=Qos(best_effort=True, depth=10),
            )  # fmt: skip
            self._kept.append(self._session.liveliness().declare_token(entity.token()))

    def _pump(self, subscriber: object, key: str) -> None:
        """A thread that empties a channel, so that none ever stalls the transport; it ends what has become
        unwanted itself, since nobody else may while it waits."""
        self._kept.append(subscriber)

        def run() -> None:
            while True:
                try:
                    sample = subscriber.recv()
                except zenoh.ZError:
                    return
                if key in self._unwanted:
                    subscriber.undeclare()
                    return
                self._put(sample)

        threading.Thread(target=run, name="ros2-in", daemon=True).start()

    def _put(self, sample: zenoh.Sample) -> None:
        """Queues a sample; where the node is too slow, the oldest goes, and is counted."""
        while True:
            try:
                self._samples.put_nowait(sample)
                return
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._samples.get_nowait()
                    self._overflowed += 1
