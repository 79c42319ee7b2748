"""The session of a running mapper: durable keyframes, checkpoints, paging, resume and hand-over."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import partial
from typing import Protocol

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Keyframe
from beamsplat.common.messages.codec import decode
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.intake import KeyframeIntake, LoadVisible
from beamsplat.services.mapping.messages import decode_keyframe, encode_keyframe
from beamsplat.services.mapping.session.checkpointer import Checkpointer, CheckpointResult
from beamsplat.services.mapping.session.inbox import Inbox

log = logging.getLogger("beamsplat.mapping")

Arrays = dict[str, np.ndarray]


class MapSession(Protocol):
    """Interface between the mapping node and its session, with or without a folder on disk.

    A keyframe is *durable* if it is on disk, so that it survives a crash of this process.
    """

    load_visible: LoadVisible | None  # for `KeyframeIntake.insert`

    def accept(self, message: Keyframe) -> bool:
        """Write a received keyframe to disk; return whether it is durable and may be acknowledged now.

        Called in the receiving thread; all other methods are called in the mapping thread.
        """

    def start(self, id: int) -> bool:
        """Start processing a keyframe; return whether it was already acknowledged on reception."""

    def store(self, message: Keyframe, known: bool) -> bool:
        """Write an inserted keyframe to disk, unless `known` and on disk; return False if writing failed.

        Without a session folder, return True.
        """

    def read(self, id: int) -> Keyframe | None:
        """Return a keyframe on disk; None if there is none, or it cannot be read."""

    def remove(self, id: int) -> None:
        """Remove a rejected keyframe from disk."""

    def skipped(self) -> Iterator[Keyframe]:
        """Yield at most one keyframe that is on disk but was dropped from the mailbox."""

    def end_of_input(self) -> None:
        """Mark all waiting keyframes as skipped, at the end of the stream."""

    @property
    def waiting(self) -> int:
        """Return the number of keyframes on disk that are not processed yet."""

    @property
    def has_skipped(self) -> bool:
        """Return whether `skipped` yields a keyframe."""

    def keep_budget(self) -> None:
        """Page Gaussians and keyframes out and in, so that the memory use is within the budget."""

    def anchors_moved(self) -> None:
        """Move paged-out Gaussians with their anchors."""

    def checkpoint(self, stamp_ns: int, last: bool = False) -> Callable[[], CheckpointResult] | None:
        """Return the job that writes a checkpoint, if one is due or this is the last one, else None.

        The next period starts at `stamp_ns`. Pass the result of the job to `finish_checkpoint`.
        """

    def finish_checkpoint(self, result: CheckpointResult) -> None:
        """Record the result of a checkpoint job."""

    def complete(self, arrays: Arrays) -> Arrays:
        """Return the arrays of a saved map, with the Gaussians that are on disk only added."""

    def save(self) -> None:
        """Write a checkpoint now, for a successor.

        Raises:
            UserError: it could not be written.
        """

    def status_text(self) -> str:
        """Return one line for the health message of the node, "" without a session."""

    def close(self) -> None:
        """Release the session's lock."""


class NoSession:
    """A `MapSession` without a folder: keyframes and Gaussians are in memory only."""

    load_visible: LoadVisible | None = None
    waiting = 0
    has_skipped = False

    def accept(self, message: Keyframe) -> bool:
        return False

    def start(self, id: int) -> bool:
        return False

    def store(self, message: Keyframe, known: bool) -> bool:
        return True

    def read(self, id: int) -> None: ...

    def remove(self, id: int) -> None: ...

    def skipped(self) -> Iterator[Keyframe]:
        return iter(())

    def end_of_input(self) -> None: ...

    def keep_budget(self) -> None: ...

    def anchors_moved(self) -> None: ...

    def checkpoint(self, stamp_ns: int, last: bool = False) -> None: ...

    def finish_checkpoint(self, result: CheckpointResult) -> None: ...

    def complete(self, arrays: Arrays) -> Arrays:
        return arrays

    def save(self) -> None: ...

    def status_text(self) -> str:
        return ""

    def close(self) -> None: ...


class LiveSession:
    """A `MapSession` in a folder on disk."""

    def __init__(self, config: MappingConfig, intake: KeyframeIntake, report: Callable[[str], None]) -> None:
        """Open the session and resume from its last checkpoint.

        Keyframes on disk that are newer than the checkpoint wait in the inbox. `report` is called with the
        progress as text; what it raises ends the opening.

        Raises:
            UserError: the folder cannot be written, is locked by another process, or cannot be read.
        """
        assert config.session is not None
        budget_bytes = None if config.memory_mb is None else config.memory_mb * 1e6
        period_ns = round(config.session_every_s * 1e9)
        self._intake, self._mapper = intake, intake.mapper
        self._checkpointer = Checkpointer(
            config.session, period_ns, budget_bytes, config.seed,
            with_device_budget=self._mapper.engine.device_budget_bytes is not None,
        )  # fmt: skip
        self.load_visible: LoadVisible | None = lambda keyframe: self._checkpointer.load_visible(
            self._mapper, keyframe
        )
        self._inbox = Inbox(self._checkpointer)
        try:
            self._resume(report)
        except BaseException:
            self._checkpointer.close()
            raise

    def _resume(self, report: Callable[[str], None]) -> None:
        c, m = self._checkpointer, self._mapper
        undistorter = self._intake.undistorter
        extra, newer = c.resume(
            m,
            lambda id, schema, body: partial(decode_keyframe, _decode_message(id, schema, body), undistorter),
            report,
        )
        self._intake.restore(extra)
        self._inbox.skip(newer)
        # A process that is killed repeatedly reaches a checkpoint too: the first period begins at the oldest.
        oldest = next(filter(None, map(self._read_message, newer)), None)
        if oldest is not None:
            c.start_period(oldest.stamp_ns)
        if m.keyframes or newer:
            log.info("resumed with %d keyframes, %d Gaussians, step %d; %d newer keyframes wait",
                     len(m.keyframes), m.store.count, m.steps, len(newer))  # fmt: skip

    def accept(self, message: Keyframe) -> bool:
        known = self._intake.knows(message.id)
        return self._inbox.accept(message.id, known, lambda: encode_keyframe(message))

    def start(self, id: int) -> bool:
        return self._inbox.start(id)

    def store(self, message: Keyframe, known: bool) -> bool:
        if known and not self._checkpointer.is_unwritten(message.id):
            return True
        return self._checkpointer.write_keyframe(message.id, *encode_keyframe(message))

    def read(self, id: int) -> Keyframe | None:
        return self._read_message(id)

    def remove(self, id: int) -> None:
        self._checkpointer.remove_keyframe(id)

    def skipped(self) -> Iterator[Keyframe]:
        if (id := self._inbox.pop_skipped()) is not None and (message := self._read_message(id)) is not None:
            yield message

    def end_of_input(self) -> None:
        self._inbox.skip_waiting()

    @property
    def waiting(self) -> int:
        return len(self._inbox)

    @property
    def has_skipped(self) -> bool:
        return self._inbox.has_skipped

    def keep_budget(self) -> None:
        self._checkpointer.page(self._mapper)

    def anchors_moved(self) -> None:
        self._checkpointer.anchors_moved(self._mapper)

    def checkpoint(self, stamp_ns: int, last: bool = False) -> Callable[[], CheckpointResult] | None:
        if not self._mapper.keyframes or not (last or self._checkpointer.due(stamp_ns)):
            return None
        return self._checkpointer.checkpoint(self._mapper, self._intake.arrays(), stamp_ns)

    def finish_checkpoint(self, result: CheckpointResult) -> None:
        self._checkpointer.finish_checkpoint(result)

    def complete(self, arrays: Arrays) -> Arrays:
        return self._checkpointer.with_disk_gaussians(arrays)

    def save(self) -> None:
        if self._mapper.keyframes:
            self._checkpointer.save(self._mapper, self._intake.arrays())

    def status_text(self) -> str:
        return self._checkpointer.status_text(self._mapper)

    def close(self) -> None:
        self._checkpointer.close()

    def _read_message(self, id: int) -> Keyframe | None:
        """Return a keyframe on disk; None, with a warning, if its file does not contain it."""
        body = self._checkpointer.read_keyframe(id)
        try:
            return None if body is None else _decode_message(id, *body)
        except ValueError as error:
            log.warning("keyframe skipped: %s", error)
            return None


def _decode_message(id: int, schema: str, body: bytes) -> Keyframe:
    """Return the keyframe `id` in the content of its file.

    Raises:
        UserError: the content is damaged, another message, or another keyframe.
    """
    try:
        message = decode(schema, body)
    except ValueError as error:
        raise UserError(f"{id}.kf: {error}") from error
    if not isinstance(message, Keyframe):
        raise UserError(f"{id}.kf: contains a {schema}, not a keyframe")
    if message.id != id:
        raise UserError(f"{id}.kf: contains keyframe {message.id}")
    return message
