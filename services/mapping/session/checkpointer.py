"""Checkpoints of a mapper in a session folder: when to write them, how to write and load them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from beamsplat.common.engines.protocol import identity_in
from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import is_disk_fault
from beamsplat.common.mapfiles.blocks import Arrays, sync, with_blocks
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import progress_of
from beamsplat.services.mapping.keyframe import RgbdKeyframe, StoredKeyframe
from beamsplat.services.mapping.mapper import Mapper
from beamsplat.services.mapping.session.disk_tier import DiskTier
from beamsplat.services.mapping.session.paging import Pager
from beamsplat.services.mapping.session.state import arrays_of, extras_of, restore

log = logging.getLogger("beamsplat.mapping")

# (id, schema, payload) -> function that decodes the images of this keyframe; both raise ValueError
KeyframeDecoder = Callable[[int, str, bytes], Callable[[], RgbdKeyframe]]


@dataclass(frozen=True)
class CheckpointResult:
    """The result of writing a checkpoint. `fault` is "", or the reason why it was not written."""

    steps: int
    keyframes: int
    fault: str = ""
    synced: tuple[int, ...] = ()  # blocks that were flushed to the disk
    removed: tuple[int, ...] = ()  # blocks whose files were removed


class Checkpointer:
    """The session folder of a mapper, locked for writing, with checkpoints at regular periods.

    Periods are measured with the stamps of the keyframes, so that a replay is reproducible.
    """

    def __init__(
        self,
        path: Path,
        period_ns: int,
        budget_bytes: float | None = None,
        seed: int = 0,
        *,
        with_device_budget: bool = False,
    ) -> None:
        """Args:
        budget_bytes: of host memory; None = no limit.
        seed: of the pager.
        with_device_budget: whether the mapper's engine has a budget of its device's memory.
        """
        self.folder = SessionFolder(path)
        self._opening, self._opened = threading.Lock(), False
        self._write_fault = ""
        try:
            self._open()
        except OSError as error:
            if not is_disk_fault(error):
                raise UserError(f"{path}: cannot create a session here ({reason(error)})") from error
            self._write_fault = f"the session cannot be opened: {reason(error)}"
            log.error("%s: %s; this is tried again with each keyframe", path, self._write_fault)
        self.disk_tier = DiskTier(self.folder)
        paged = budget_bytes is not None or with_device_budget
        self._pager = Pager(budget_bytes, seed, self.disk_tier) if paged else None
        self._period_ns = period_ns
        self._since_ns: int | None = None  # stamp of the last checkpoint, or of the first keyframe
        self._running = False
        self._last: CheckpointResult | None = None
        self._unwritten: set[int] = set()  # keyframes that the mapper has and the disk has not

    def _open(self) -> None:
        """Create and lock the session, unless that is done; on a disk that is full, it is done later.

        Raises:
            UserError: another process uses the session, or it cannot be read.
            OSError: the disk is full or broken, or the folder cannot be written.
        """
        with self._opening:  # of threads of the bus and of jobs
            if not self._opened:
                self.folder.create()
                self.folder.lock()
                self._opened = True

    # --- resuming ---

    def resume(
        self, mapper: Mapper, decoder: KeyframeDecoder, report: Callable[[str], None] = lambda _: None
    ) -> tuple[Arrays, list[int]]:
        """Restore the last checkpoint into a new mapper; `report` as in `restore`.

        Returns:
            The `extra` arrays that were passed to `checkpoint`, and the ids of keyframes on disk that are
            newer than the checkpoint, which the caller has to insert.

        Raises:
            UserError: there is a checkpoint, but it cannot be read.
        """
        paged = self._pager is not None
        mapper.disk_gaussians = self.disk_tier
        arrays = self.folder.read_state(whole=not paged) if self.folder.exists() else None
        self._decoder = decoder
        if arrays is None:
            self.disk_tier.find_stale_files()
            return {}, self.folder.keyframe_ids()
        lost = restore(mapper, arrays, self._read, keep_paged_out=paged, report=report)
        self.disk_tier.restore(arrays, mapper.store)
        for text in lost:
            log.warning("the mapper no longer optimises on this keyframe: %s", text)
        progress = progress_of(arrays)
        # Counted from the stored checkpoint: a mapper that crashes repeatedly still writes one per period.
        manifest = self.folder.manifest()
        assert manifest is not None  # there is a state
        self._since_ns = manifest.get("stamp_ns")
        writer = identity_in(manifest)
        if writer is not None and writer != mapper.engine.identity:
            log.info("the map was computed by %s; %s continues it", writer, mapper.engine.identity)
        keyframes = len(mapper.keyframes) + len(mapper.paged_out)
        self._last = CheckpointResult(int(progress["steps"]), keyframes)
        extra = extras_of(arrays)
        known = set(extra["taken_id"].tolist()) | set(progress["forgotten"])
        return extra, [id for id in self.folder.keyframe_ids() if id not in known]

    def _read(self, id: int) -> Callable[[], RgbdKeyframe]:
        return self._decoder(id, *self.folder.read_keyframe(id))

    def _decode(self, id: int) -> RgbdKeyframe:
        return self._read(id)()

    # --- paging ---

    def page(self, mapper: Mapper) -> None:
        """Page keyframes and Gaussians in and out, within the memory budget; no effect without a budget."""
        if self._pager is not None:
            self._pager.page(mapper, self._decode, lambda id: id not in self._unwritten)

    def load_visible(self, mapper: Mapper, keyframe: StoredKeyframe) -> None:
        """Page in all Gaussians that a keyframe observes."""
        if self._pager is not None:
            self._pager.load_visible(mapper, keyframe)

    def anchors_moved(self, mapper: Mapper) -> None:
        """Page keyframes and Gaussians after the anchors have moved, see `Pager.anchors_moved`."""
        if self._pager is not None:
            self._pager.anchors_moved(mapper)

    # --- keyframes ---

    def read_keyframe(self, id: int) -> tuple[str, bytes] | None:
        """Return (schema, payload) of a keyframe on disk; None, with a warning, if it cannot be read."""
        try:
            return self.folder.read_keyframe(id)
        except UserError as error:
            log.warning("keyframe skipped: %s", error)
            return None

    def remove_keyframe(self, id: int) -> None:
        """Remove the file of a keyframe that the mapper has rejected, or forget that it is not written."""
        self._unwritten.discard(id)
        self.folder.remove_keyframes([id])

    def write_keyframe(self, id: int, schema: str, payload: bytes) -> bool:
        """Write a keyframe to disk; return False on failure: the keyframe must not be acknowledged then."""
        try:
            self._open()
            self.folder.write_keyframe(id, schema, payload)
        except (OSError, UserError) as error:
            self._unwritten.add(id)
            self._write_fault = f"keyframe {id} not saved: {reason(error)}"
            log.warning("%s: %s", self.folder.path, self._write_fault)
            return False
        self._unwritten.discard(id)
        if not self._unwritten:
            self._write_fault = ""
        return True

    def is_unwritten(self, id: int) -> bool:
        """Return whether a keyframe is not on disk because the last attempt to write it failed."""
        return id in self._unwritten

    # --- checkpoints ---

    def with_disk_gaussians(self, arrays: Arrays) -> Arrays:
        """Return the arrays of a saved map with all Gaussians, including Gaussians on disk only.

        Raises:
            UserError: a block cannot be read.
        """
        return with_blocks(self.folder.blocks, arrays | self.disk_tier.arrays())

    def start_period(self, stamp_ns: int) -> int:
        """Start the first checkpoint period at the stamp of a keyframe, unless one is running.

        Returns the start of the period (ns).
        """
        if self._since_ns is None:
            self._since_ns = stamp_ns
        return self._since_ns

    def due(self, stamp_ns: int) -> bool:
        """Return whether a checkpoint is due: one period after the last (or before, if the clock jumped)."""
        since_ns = self.start_period(stamp_ns)
        return not self._running and abs(stamp_ns - since_ns) >= self._period_ns

    def checkpoint(self, mapper: Mapper, extra: Arrays, stamp_ns: int) -> Callable[[], CheckpointResult]:
        """Copy the mapper's state now and return the job that writes it, for a background thread.

        The result of the job must be passed to `finish_checkpoint`.
        """
        self._running, self._since_ns = True, stamp_ns
        arrays, folder = arrays_of(mapper, extra) | self.disk_tier.arrays(), self.folder
        keyframes, steps = len(mapper.keyframes) + len(mapper.paged_out), mapper.steps
        synced, removed = self.disk_tier.pending_files()
        summary = {
            "keyframes": keyframes, "gaussians": mapper.store.count + self.disk_tier.count, "steps": steps,
            "anchors": len(mapper.T_map_anchor), "stamp_ns": stamp_ns,
            "engine": asdict(mapper.engine.identity),
        }  # fmt: skip
        dropped = mapper.progress()["forgotten"]

        def run() -> CheckpointResult:
            try:
                self._open()
                sync(folder.blocks, synced)
                folder.write_state(arrays, summary)
            except (OSError, UserError) as error:
                return CheckpointResult(steps, keyframes, reason(error))
            folder.remove_keyframes(dropped)
            folder.remove_blocks(removed)
            return CheckpointResult(steps, keyframes, "", tuple(synced), tuple(removed))

        return run

    def finish_checkpoint(self, result: CheckpointResult) -> None:
        """Record the result of a checkpoint job."""
        self._running = False
        if result.fault:
            log.warning(
                "%s: checkpoint not written: %s; the previous one stays valid", self.folder.path, result.fault
            )
        self.disk_tier.mark_saved(result.synced, result.removed)
        self._last = result

    def save(self, mapper: Mapper, extra: Arrays) -> None:
        """Write a checkpoint now; no checkpoint job may be running.

        Raises:
            UserError: it could not be written, or some keyframes are not on disk.
        """
        stamp_ns = self._since_ns or 0
        self.finish_checkpoint(self.checkpoint(mapper, extra, stamp_ns)())
        if self._unwritten or (self._last is not None and self._last.fault):
            raise UserError(f"{self.folder.path}: {self.status_text(mapper)}")

    def status_text(self, mapper: Mapper) -> str:
        """Return a text for the user: the last checkpoint, or why it was not written, and the memory use."""
        last = self._last
        if last is not None and last.fault:
            return f"NOT SAVED: {last.fault}; the previous checkpoint stays valid"
        if self._write_fault:
            return f"NOT SAVED: {self._write_fault}"
        parts = [] if last is None else [f"saved at {last.keyframes} keyframes, step {last.steps}"]
        if self._pager is not None:
            if self._pager.fault:
                parts.insert(0, f"MEMORY BUDGET EXCEEDED: {self._pager.fault}")
            parts.append(self._pager.status_text(mapper))
        if mapper.dropped_count:
            parts.append(f"{mapper.dropped_count} keyframes dropped in favour of others with the same pose")
        return "; ".join(parts)

    def close(self) -> None:
        """Release the write lock of the session."""
        self.folder.unlock()
