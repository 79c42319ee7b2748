"""A subscription to one topic of a ROS 2 robot by rmw_zenoh's keys, visible to the robot's nodes."""

from __future__ import annotations

from collections.abc import Callable

import zenoh

from beamsplat.common.recording import ros_types as ros
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.common.zenoh.rmw import NO_TYPE_HASH, OWN_NODE, RmwEntity, RmwQos, data_key

_ENTITY_IDS = 1 << 20  # beyond those of our publishers in the same session


class RosSubscription:
    """Calls `handle` in a thread with the newest message of a ROS topic; it skips those it has no time for.

    Nodes of all distributions are heard. The subscription is announced by a liveliness token with the hash of
    Iron and newer and by one without: `ros2 topic pub --once` waits for it.
    """

    def __init__(
        self,
        session: zenoh.Session,
        domain: int,
        topic: str,
        type_name: str,
        handle: Callable[[bytes], None],
    ) -> None:
        """Args:
        topic: with or without its leading slash.
        handle: gets the message as CDR. An exception in it ends the process (`receive_in_thread`).
        """
        newest: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
        self._subscriber = session.declare_subscriber(data_key(domain, topic, type_name, "*"), newest)
        self._tokens = [
            session.liveliness().declare_token(
                RmwEntity(
                    domain, str(session.zid()), 0, _ENTITY_IDS + number, "MS", OWN_NODE,
                    topic="/" + topic.strip("/"), type_name=type_name, type_hash=type_hash,
                    qos=RmwQos(depth=1),
                ).token()
            )
            for number, type_hash in enumerate((ros.typestore().hash_rihs01(type_name), NO_TYPE_HASH))
        ]  # fmt: skip
        receive_in_thread(session, "ros2-in", self._subscriber, lambda s: handle(s.payload.to_bytes()))
