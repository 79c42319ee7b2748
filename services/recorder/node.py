"""The recorder service: writes all topics to an MCAP recording."""

from __future__ import annotations

import contextlib
import logging
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import count
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import check_can_write, is_disk_fault
from beamsplat.common.messages import Health, Message
from beamsplat.common.messages.header import Header, local_clock_id
from beamsplat.common.recording import RecordingError, RecordingWriter
from beamsplat.common.runtime.node import Input, Node, Output
from beamsplat.common.topics import HEALTH, TOPICS
from beamsplat.services.recorder.arrival import ArrivalClock
from beamsplat.services.recorder.config import RecorderConfig

log = logging.getLogger("beamsplat.recorder")

_RETRY_S = 5.0  # between two attempts to record again after a fault of the disk
_ROOM_BYTES = 16_000_000  # least free space for a new recording: some chunks, else it would fail at once


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
        self.writes_to = config.out.parent
        self._chosen = set(config.topics or TOPICS) - set(config.without)
        self._clock = ArrivalClock(config.clock, time.time_ns, time.monotonic_ns)
        self._clock_id = local_clock_id()
        self._header: Header | None = None
        self.writer: RecordingWriter | None = None  # None while the disk is full or broken
        self.lost: Counter[str] = Counter()  # messages that are in no recording, by topic
        self._written = 0  # messages in recordings that are closed
        self._fault = ""  # why there is no writer
        self._retry_ns = 0  # on the monotonic clock: when a new recording is tried

    def configure(self) -> None:
        """Create the recording, so that a wrong path is reported before the system starts."""
        self._open()
        self._update_detail()

    def _open(self) -> None:
        """Start a recording, unless the disk is full or broken.

        Raises:
            UserError: the path cannot be created for another reason.
        """
        try:
            self.writer = RecordingWriter(
                _unused_path(self.config.out),
                compression=CompressionType[self.config.compression.upper()],
                chunk_s=self.config.chunk_s,
                sync=self.config.sync,
            )
        except (OSError, UserError) as error:
            cause = error if isinstance(error, OSError) else error.__cause__
            if not (isinstance(cause, OSError) and is_disk_fault(cause)):
                raise
            self._stop_recording(f"{self.config.out}: {reason(cause)}")
        else:
            self._fault = ""
            log.info("recording to %s", self.writer.path)

    def _stop_recording(self, fault: str) -> None:
        """Close the recording, if there is one; another is tried after `_RETRY_S`."""
        if not self._fault:  # logged once; what is lost is counted
            log.error("%s; recording continues when the disk has room", fault)
        self._fault, self._retry_ns = fault, time.monotonic_ns() + round(_RETRY_S * 1e9)
        self._close_writer()

    def _close_writer(self) -> None:
        if (writer := self.writer) is None:
            return
        self.writer = None
        try:
            writer.close()
        except RecordingError as error:
            log.error("%s", error)
        self.lost.update(writer.lost)
        self._report_lost()
        self._written += writer.counts.total()
        if self._fault and not writer.counts:
            writer.remove_files()

    def _report_lost(self) -> None:
        self.rejections.set("messages not recorded: the disk is full or broken", self.lost.total())

    def _continue_if_possible(self) -> None:
        """Start a new recording after a fault, if the disk has room now."""
        if self.writer is None and time.monotonic_ns() >= self._retry_ns:
            self._retry_ns = time.monotonic_ns() + round(_RETRY_S * 1e9)
            with contextlib.suppress(OSError, UserError):  # still no disk: `_fault` says why
                if shutil.disk_usage(_existing_parent(self.config.out)).free >= _ROOM_BYTES:
                    self._open()

    def _update_detail(self) -> None:
        self.figures.set("recording", self.writer is not None)
        lost = self.lost.total() + (self.writer.lost.total() if self.writer is not None else 0)
        text = f"NOT RECORDING: {self._fault}" if self.writer is None else f"writing {self.writer.path}"
        self.detail = text + (f", {lost} messages LOST" if lost else "")

    def check_resources(self) -> None:
        check_can_write(self.config.out, "out", read_only_disk=True)

    def ignored_inputs(self) -> frozenset[str]:
        """Return the topics that are not recorded: they need not be received, copied and decoded."""
        return frozenset(TOPICS) - self._chosen

    def on_header(self, header: Header) -> None:
        self._header = header

    def on_health(self, health: Health) -> None:
        arrival_ns = self._clock.now_ns()
        if self.config.health and arrival_ns is not None:
            self._write(f"{HEALTH}/{health.node}", health, arrival_ns, None)
        self._update_detail()

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
        path = self.config.out if self.writer is None else self.writer.path
        self._close_writer()
        log.info("%d messages in %s, %d lost", self._written, path, self.lost.total())

    def _write(self, topic: str, message: Message, arrival_ns: int, header: Header | None) -> None:
        self._continue_if_possible()
        if self.writer is None:
            self.lost[topic] += 1
            self._report_lost()
            return
        try:
            self.writer.write(topic, message, arrival_ns, header)
        except RecordingError as error:
            self._stop_recording(str(error))
            self._update_detail()


def _existing_parent(path: Path) -> Path:
    """Return the nearest parent of `path` that exists."""
    return next(parent for parent in path.absolute().parents if parent.exists())


def _unused_path(path: Path) -> Path:
    """Return `path` if it does not exist, else the first free path with a number appended."""
    if not path.exists():
        return path
    names = (path.with_name(f"{path.stem}_{number}{path.suffix}") for number in count(2))
    return next(name for name in names if not name.exists())
