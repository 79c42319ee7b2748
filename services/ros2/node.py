"""The ros2 node: a ROS 2 robot as sensor source, by rmw_zenoh's keys, without a ROS installation."""

from __future__ import annotations

import contextlib
import logging
import queue
import time
from collections import deque
from collections.abc import Iterator

import zenoh
import zenoh.ext

from beamsplat.common.geometry.rig import check_rig_option
from beamsplat.common.runtime.clock import StampClock
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.rmw import (
    LIVELINESS_PREFIX,
    OWN_NODE,
    RmwAttachment,
    RmwEntity,
    RmwKey,
    RmwQos,
    dds_type,
)
from beamsplat.services.ros2.config import Ros2Config
from beamsplat.services.ros2.robot import RosRobot, RosRobotOptions
from beamsplat.services.ros2.topics import IMAGE, SUPPORTED_TYPES, TF, kind_of

log = logging.getLogger("beamsplat.ros2")

_POLL_S = 0.1
_QUEUED = 1000  # messages; the oldest is dropped when the queue is full
_FIFO = 256  # messages in the channel of each subscriber
_MAX_IMAGE_TOPICS = 16  # raw images that are subscribed to until topics are selected
_MAX_OWN_PUBLISHERS = 64  # of /tf and /tf_static; the newest are known
_MAX_ANNOUNCED = 256  # topics whose publishers are told of our subscription


class Ros2Node(Node):
    """Publishes calibration, scans, images, odometry and external poses of a ROS 2 robot."""

    name = "ros2"
    Config = Ros2Config
    config: Ros2Config
    outputs = ("rig", "wheel/odometry", "lidar/scan", "camera/image", "external/pose")

    def configure(self) -> None:
        c = self.config
        named_topics = {
            "image": c.image_topic,
            "scan": c.scan_topic,
            "odometry": c.odometry_topic,
            "pose": c.pose_topic,
        }
        self._named_topics = {kind: name for kind, name in named_topics.items() if name}
        options = RosRobotOptions(
            topics=self._named_topics,
            camera_info_topic=c.camera_info_topic, body_frame=c.body_frame, rig=c.rig,
            without=frozenset(c.without), assume_mounts=c.assume_mounts, settle_s=c.settle_s,
        )  # fmt: skip
        self.robot = RosRobot(options)
        self._clock = StampClock()
        self._samples: queue.Queue[zenoh.Sample] = queue.Queue(_QUEUED)
        self._dropped = 0
        self._declarations: list[object] = []  # references keep subscribers and tokens declared
        self._announced: dict[str, tuple[str, zenoh.LivelinessToken]] = {}  # by topic: type and our token
        self._type_by_key: dict[str, str] = {}  # ROS type by subscribed key
        self._unused_keys: set[str] = set()  # keys to unsubscribe
        self._topics_selected = False
        self._own_tf_gids: deque[bytes] = deque(maxlen=_MAX_OWN_PUBLISHERS)  # of our own publishers of /tf
        self._session = open_session((c.router,))
        self._subscribe_all()

    def check_resources(self) -> None:
        check_rig_option(self.config.rig)

    def source(self) -> Iterator[SourceItem | None]:
        """Yield the converted messages of the robot's sensors; None while there are none."""
        while True:
            try:
                sample = self._samples.get(timeout=_POLL_S)
            except queue.Empty:
                self.detail = self.robot.status
                yield None
                continue
            yield from self._process(sample) or (None,)
            lost = f"; {self._dropped} dropped" if self._dropped else ""
            self.detail = f"{self.robot.status}{lost}"
            self.figures.set("calibration_doubts", len(self.robot.doubts))
            self.rejections.set("messages dropped, the queue was full", self._dropped)
            for topic, count in self.robot.rejected.items():
                self.rejections.set(f"{topic}: messages not usable", count)
            for found in self.robot.report.findings:
                self.rejections.set(found.reason, found.count)

    def close(self) -> None:
        if hasattr(self, "_session"):
            self._session.close()

    def _process(self, sample: zenoh.Sample) -> list[SourceItem]:
        key = str(sample.key_expr)
        if key.startswith(LIVELINESS_PREFIX):
            self._on_liveliness_token(key, sample.kind)
            return []
        address = RmwKey.parse(key)
        if address is None or address.type_name not in SUPPORTED_TYPES:
            return []
        if address.type_name == TF and self._is_own_tf(sample):
            return []
        found = self.robot.convert(
            address.topic,
            address.type_name,
            sample.payload.to_bytes(),
            self._clock.now_ns(),
            time.monotonic(),
        )
        if self.robot.rig is not None and not self._topics_selected:
            self._unsubscribe_unused()
        return [SourceItem(None, topic, message) for topic, message in found]

    def _is_own_tf(self, sample: zenoh.Sample) -> bool:
        attachment = RmwAttachment.unpack(sample.attachment.to_bytes()) if sample.attachment else None
        return attachment is not None and attachment.gid in self._own_tf_gids

    def _unsubscribe_unused(self) -> None:
        """Unsubscribe, after topic selection, from unneeded transforms and from other raw images."""
        self._topics_selected = True
        for note in [*self.robot.notes, *self.robot.doubts]:
            log.info("%s", note)
        chosen = {topic.strip("/") for topic in self.robot.selected_topics}
        for key, type_name in self._type_by_key.items():
            topic = key.split("/", 1)[1].rsplit("/", 2)[0]
            if (type_name == TF and not self.robot.needs_tf) or (type_name == IMAGE and topic not in chosen):
                self._unused_keys.add(key)
        for topic, (type_name, token) in list(self._announced.items()):
            if kind_of(type_name) and topic.strip("/") not in chosen:
                token.undeclare()
                del self._announced[topic]

    def _on_liveliness_token(self, token: str, kind: zenoh.SampleKind) -> None:
        """Register a publisher of the robot, announced by its liveliness token.

        Raw images are large: only image topics that exist are subscribed to.
        """
        entity = RmwEntity.parse(token)
        if entity is None or entity.kind != "MP" or kind != zenoh.SampleKind.PUT:
            return
        if entity.node_name == OWN_NODE:  # published by our node ros2_out
            if entity.type_name == TF:  # the robot uses the same topic
                self._own_tf_gids.append(entity.gid())
            else:
                self.robot.ignore_topic(entity.topic)
            return
        self.robot.add_publisher(entity.topic, entity.type_name)
        self._announce(entity)
        asked = self.config.image_topic.strip("/") in ("", entity.topic.strip("/"))
        if entity.type_name == IMAGE and asked and "image" not in self.config.without:
            if sum(type_name == IMAGE for type_name in self._type_by_key.values()) < _MAX_IMAGE_TOPICS:
                self._subscribe(f"{entity.domain}/{entity.topic.strip('/')}/{dds_type(IMAGE)}/*", IMAGE)
            else:
                self.rejections.add(f"more than {_MAX_IMAGE_TOPICS} topics of raw images: set image_topic")

    def _announce(self, publisher: RmwEntity) -> None:
        """Declare a token of our subscription to the topic of a publisher, as rmw_zenoh does.

        Without it some publish nothing: cameras and image_transport work only for subscribers, and Lyrical
        publishes arrays on the plain key only if a subscriber does not list buffer backends in its token.
        """
        topic, kind = publisher.topic, kind_of(publisher.type_name)
        named = self._named_topics.get(kind, topic).strip("/")
        if publisher.type_name not in SUPPORTED_TYPES or kind in self.config.without:
            return
        if named != topic.strip("/") or self._topics_selected or topic in self._announced:
            return
        if len(self._announced) < _MAX_ANNOUNCED:
            ours = RmwEntity(
                self.config.domain, str(self._session.zid()), 0, 1 + len(self._announced), "MS", OWN_NODE,
                topic=topic, type_name=publisher.type_name, type_hash=publisher.type_hash,
                qos=RmwQos(best_effort=True, depth=10),
            )  # fmt: skip
            token = self._session.liveliness().declare_token(ours.token())
            self._announced[topic] = (publisher.type_name, token)

    def _subscribe_all(self) -> None:
        domain = self.config.domain
        for type_name in sorted(SUPPORTED_TYPES - {IMAGE}):
            self._subscribe(f"{domain}/**/{dds_type(type_name)}/*", type_name)
        if self.config.image_topic:
            self._subscribe(f"{domain}/{self.config.image_topic.strip('/')}/{dds_type(IMAGE)}/*", IMAGE)
        tokens = self._session.liveliness().declare_subscriber(
            f"{LIVELINESS_PREFIX}/{domain}/**", zenoh.handlers.FifoChannel(_FIFO), history=True
        )
        self._start_receiver(tokens, LIVELINESS_PREFIX)
        # Static transforms of publishers that answer queries (before Zenoh's advanced publishers).
        for reply in self._session.get(f"{domain}/tf_static/*/*", timeout=1.0):
            if reply.ok is not None:
                self._enqueue(reply.ok)
        self._declarations.append(
            self._session.liveliness().declare_token(
                RmwEntity(domain, str(self._session.zid()), 0, 0, "NN", OWN_NODE).token()
            )
        )

    def _subscribe(self, key: str, type_name: str) -> None:
        if key in self._type_by_key or self._topics_selected:
            return
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(_FIFO)
        subscriber: zenoh.Subscriber | zenoh.ext.AdvancedSubscriber
        if type_name == TF:  # /tf_static is published once and fetched from the publisher's cache
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session, key, channel,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )  # fmt: skip
        else:
            subscriber = self._session.declare_subscriber(key, channel)
        self._type_by_key[key] = type_name
        self._start_receiver(subscriber, key)

    def _start_receiver(self, subscriber: zenoh.Subscriber | zenoh.ext.AdvancedSubscriber, key: str) -> None:
        """Start a thread that receives a subscriber's messages, so that it never blocks the transport.

        The thread itself undeclares the subscriber when it is unused, because no other thread can undeclare
        it while `recv` waits.
        """
        self._declarations.append(subscriber)

        def is_unused() -> bool:
            if key not in self._unused_keys:
                return False
            subscriber.undeclare()
            return True

        receive_in_thread(self._session, "ros2-in", subscriber, self._enqueue, is_unused)

    def _enqueue(self, sample: zenoh.Sample) -> None:
        """Queue a message; if the queue is full, drop the oldest message and count it."""
        while True:
            try:
                self._samples.put_nowait(sample)
                return
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._samples.get_nowait()
                    self._dropped += 1
