"""Publications and subscriptions of one topic on Zenoh."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import msgpack
import zenoh
import zenoh.ext

from beamsplat.common.messages import Message
from beamsplat.common.messages.codec import MEDIA_TYPE, decode, encode, encode_into, schema_of
from beamsplat.common.messages.header import MAX_BACKLOG, DecodeError, Header
from beamsplat.common.runtime.mailbox import Envelope
from beamsplat.common.runtime.rate_limited_log import RateLimitedLog
from beamsplat.common.topics import Topic
from beamsplat.common.zenoh.receiving import receive_in_thread

log = logging.getLogger(__name__)

T = TypeVar("T")

FIFO_MESSAGES = 256  # queue between Zenoh and the receiving thread, for an `every` input without a cache
_KEPT_BUFFER_BYTES = 2_000_000  # of the payloads of one topic; a larger buffer is freed after each message
ENCODING = zenoh.Encoding(MEDIA_TYPE)


def declare_publication(
    session: zenoh.Session,
    key_expr: str,
    row: Topic,
    congestion: zenoh.CongestionControl = zenoh.CongestionControl.DROP,
    priority: zenoh.Priority = zenoh.Priority.DATA,
) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
    """Declare a publisher for a row of the topic table; subscribers recover lost messages from its cache."""
    encoding = ENCODING.with_schema(schema_of(row.message))
    if not row.cache:
        return session.declare_publisher(
            key_expr, encoding=encoding, congestion_control=congestion, priority=priority
        )
    return zenoh.ext.declare_advanced_publisher(
        session,
        key_expr,
        encoding=encoding,
        congestion_control=congestion,
        priority=priority,
        cache=zenoh.ext.CacheConfig(row.cache),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
        publisher_detection=True,
    )


def declare_subscription(
    session: zenoh.Session,
    key_expr: str,
    row: Topic,
    delivery: str,
    channel: zenoh.handlers.FifoChannel | zenoh.handlers.RingChannel | Callable[[zenoh.Sample], None],
    origin: zenoh.Locality = zenoh.Locality.ANY,
) -> zenoh.Subscriber | zenoh.ext.AdvancedSubscriber:
    """Declare a subscriber for a row of the topic table.

    Unless the delivery is "latest", it recovers lost messages from the publisher's cache. On a latched topic
    it also receives the last message published before it was declared, on a topic with `history` all that
    the publisher's cache has.
    """
    if not row.cache or delivery == "latest":
        return session.declare_subscriber(key_expr, channel, allowed_origin=origin)
    with_history = row.history or row.delivery == "latched"
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=row.cache)
    return zenoh.ext.declare_advanced_subscriber(
        session,
        key_expr,
        channel,
        allowed_origin=origin,
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        history=history if with_history else None,
    )


@dataclass
class Producer:
    """Header fields that are common to all messages of one process."""

    node: str
    instance: str
    epoch: int  # increases with each process of the node; subscribers ignore messages of lower epochs
    clock_id: int


class Publication:
    """Publication of one topic, with the counts of sent and refused messages. `put` is thread-safe."""

    def __init__(self, session: zenoh.Session, producer: Producer, row: Topic, key_expr: str) -> None:
        self._producer = producer
        self._lock = threading.Lock()
        self.row = row
        self.sent = 0
        self.bytes = 0
        self.refused = 0  # messages that are larger than the limit of the topic
        self._refusal_log = RateLimitedLog()
        self._buffer = bytearray()  # of the payload that is being published
        self._publisher = declare_publication(session, key_expr, row)

    def put(self, message: Message, backlog: int = 0) -> Header | None:
        """Publish one message and return its header; never waits for a subscriber.

        `backlog` is for the header: the number of messages sent that are not acknowledged.

        Return None, and count and log the message, if it is larger than the limit of its topic: routers and
        subscribers would drop it.
        """
        with self._lock:
            try:
                payload = encode_within(message, self.row.limit_kb, self.row.name, self._buffer)
            except ValueError as error:
                self.refused += 1
                if (count := self._refusal_log.due(self.row.name)) is not None:
                    log.error("not published (%d more since the last report): %s", count, error)
                return None
            header = Header(
                stamp_ns=message.stamp_ns,
                publish_ns=time.monotonic_ns(),
                clock_id=self._producer.clock_id,
                sequence=self.sent,
                epoch=self._producer.epoch,
                producer=self._producer.node,
                instance=self._producer.instance,
                backlog=min(backlog, MAX_BACKLOG),
            )
            self._publisher.put(payload, attachment=header.pack())  # copies the payload
            self.sent += 1
            self.bytes += len(payload)
            if len(self._buffer) > _KEPT_BUFFER_BYTES:
                self._buffer = bytearray()
        return header


def encode_within(
    message: Message, limit_kb: int, subject: str, buffer: bytearray | None = None,
) -> bytes | bytearray:  # fmt: skip
    """Return the payload of a message of a topic or query, `subject`; for `buffer` see `encode_into`.

    Raises:
        ValueError: the payload is larger than `limit_kb`, or its texts and numbers are too long (`encode`).
    """
    payload = encode(message) if buffer is None else encode_into(message, buffer)
    if len(payload) > limit_kb * 1000:
        raise ValueError(
            f"{subject}: {len(payload) / 1e6:.2f} MB in a {type(message).__name__} with stamp "
            f"{message.stamp_ns}, the limit is {limit_kb / 1e3:g} MB"
        )
    return payload


class Subscription(Generic[T]):
    """One input of a node: a thread that receives samples from a Zenoh channel."""

    def __init__(
        self,
        session: zenoh.Session,
        row: Topic,
        delivery: str,
        key_expr: str,
        decode: Callable[[zenoh.Sample], T],
        on_decoded: Callable[[T], None],
        on_undecodable: Callable[[str, str], None],
    ) -> None:
        """Subscribe; `on_undecodable` is called with (topic, reason) if `decode` raises a DecodeError."""
        self.row = row
        self._decode = decode
        self._on_decoded = on_decoded
        self._on_undecodable = on_undecodable
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] | zenoh.handlers.RingChannel[zenoh.Sample]
        if delivery == "every":
            channel = zenoh.handlers.FifoChannel(max(row.cache, FIFO_MESSAGES))
        else:
            channel = zenoh.handlers.RingChannel(1)
        self._subscriber = declare_subscription(session, key_expr, row, delivery, channel)
        receive_in_thread(session, f"sub-{row.name}", self._subscriber, self._handle)

    def _handle(self, sample: zenoh.Sample) -> None:
        try:
            decoded = self._decode(sample)
        except DecodeError as error:
            self._on_undecodable(self.row.name, str(error))
        else:
            self._on_decoded(decoded)


def decode_header(sample: zenoh.Sample, row: Topic) -> Header:
    """Return the header of a Zenoh sample received on the topic `row`; the payload is not decoded.

    Raises:
        DecodeError: no valid header, or a payload above the limit of the topic.
    """
    if sample.attachment is None:
        raise DecodeError("sample without a header")
    header = Header.unpack(sample.attachment.to_bytes())
    if len(sample.payload) > row.limit_kb * 1000:
        size, most = len(sample.payload) / 1e6, row.limit_kb / 1e3
        raise DecodeError(f"{size:.1f} MB on {row.name}, the limit is {most:g} MB (common/topics.py)")
    return header


def decode_end_marker(sample: zenoh.Sample) -> tuple[Header, int]:
    """Return header and content (number of sent messages) of an end-of-stream marker.

    Raises:
        DecodeError: no valid header, or the content is not a number of messages.
    """
    header = Header.unpack(sample.attachment.to_bytes() if sample.attachment else b"")
    try:
        sent = msgpack.unpackb(sample.payload.to_bytes(), max_array_len=0, max_map_len=0)
    except (ValueError, msgpack.UnpackException) as error:
        raise DecodeError(str(error)) from error
    if type(sent) is not int or sent < 0:
        raise DecodeError(f"{str(sent)[:40]!r} is not a number of messages")
    return header, sent


def decode_sample(sample: zenoh.Sample, row: Topic) -> Envelope:
    """Decode a Zenoh sample received on the topic `row`, and return it as an envelope.

    Raises:
        DecodeError: no header, too large, the schema of another message, or an undecodable payload.
    """
    header = decode_header(sample, row)
    schema = str(sample.encoding).partition(";")[2]
    payload = sample.payload.to_bytes()
    message = decode(schema, payload)
    if type(message) is not row.message:
        raise DecodeError(f"{schema} on {row.name}, expected {row.message.schema_name()}")
    return Envelope(row.name, header, message, len(payload))
