"""The recorder service: writes all topics to an MCAP recording."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from itertools import count
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import check_can_write
from beamsplat.common.messages import Health, Message
from beamsplat.common.messages.header import Header, local_clock_id
from beamsplat.common.recording import RecordingError, RecordingWriter
from beamsplat.common.runtime.node import Input, Node, Output
from beamsplat.common.topics import HEALTH, TOPICS
from beamsplat.services.recorder.arrival import ArrivalClock
from beamsplat.services.recorder.config import RecorderConfig

log = logging.getLogger("beamsplat.recorder")


def _record_handler(topic: str) -> Callable[[Any, Message], Iterable[Output]]:
    def record(self: RecorderNode, message: Message) -> Iterable[Output]:
        self.record(topic, message)
        return ()

    return record


# A handler for each row of the topic table, so that new topics are recorded without a change here.
_Handlers: Any = type("_Handlers", (), {row.handler: _record_handler(row.name) for row in TOPICS.values()})


class RecorderNode(_Handlers, Node):
    """Records every message of all topics, and the health of all nodes."""

    name = "recorder"
    Config = RecorderConfig
    config: RecorderConfig
    inputs = tuple(Input(row.name, None if row.delivery == "latched" else "every") for row in TOPICS.values())

    def __init__(self, config: RecorderConfig) -> None:
        super().__init__(config)
        for name in (*config.topics, *config.without):
            if name not in TOPICS:
                raise UserError(f"recorder: no topic called {name!r}; there are {', '.join(TOPICS)}")
        self._chosen = set(config.topics or TOPICS) - set(config.without)
        self._clock = ArrivalClock(config.clock, time.time_ns, time.monotonic_ns)
        self._clock_id = local_clock_id()
        self._header: Header | None = None
        self.writer: RecordingWriter | None = None

    def configure(self) -> None:
        """Create the recording, so that a wrong path is reported before the system starts."""
        self.writer = RecordingWriter(
            _unused_path(self.config.out),
            compression=CompressionType[self.config.compression.upper()],
            chunk_s=self.config.chunk_s,
            sync=self.config.sync,
        )
        log.info("recording to %s", self.writer.path)

    @property
    def _open_writer(self) -> RecordingWriter:
        assert self.writer is not None  # opened by `configure`
        return self.writer

    def check_resources(self) -> None:
        check_can_write(self.config.out, "out", read_only_disk=True)

    def on_header(self, header: Header) -> None:
        self._header = header

    def on_health(self, health: Health) -> None:
        arrival_ns = self._clock.now_ns()
        if self.config.health and arrival_ns is not None:
            self._write(f"{HEALTH}/{health.node}", health, arrival_ns, None)
        writer = self._open_writer
        lost = writer.lost.total()
        self.detail = f"writing {writer.path}" + (f", {lost} messages LOST" if lost else "")

    def record(self, topic: str, message: Message) -> None:
        """Write one message with its header."""
        header, self._header = self._header, None
        if topic in self._chosen:
            publish_ns = None
            if header is not None and header.clock_id == self._clock_id:
                publish_ns = header.publish_ns
            arrival_ns = self._clock.arrival_ns(message.stamp_ns, publish_ns)
            self._write(topic, message, arrival_ns, header)

    def close(self) -> None:
        if self.writer is None:
            return
        try:
            self.writer.close()
        except RecordingError as error:
            log.error("%s", error)
        lost = self.writer.lost.total()
        log.info("%d messages in %s, %d lost", self.writer.counts.total(), self.writer.path, lost)

    def _write(self, topic: str, message: Message, arrival_ns: int, header: Header | None) -> None:
        writer = self._open_writer
        failed_before = writer.lost.total() > 0
        try:
            writer.write(topic, message, arrival_ns, header)
        except RecordingError as error:
            if not failed_before:  # logged once; the count is in `lost` and in the last log line
                log.error("%s", error)


def _unused_path(path: Path) -> Path:
    """Return `path` if it does not exist, else the first free path with a number appended."""
    if not path.exists():
        return path
    names = (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in count(2))
    return next(name for name in names if not name.exists())
