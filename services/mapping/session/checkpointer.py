"""Keeps a mapper on disk: when it is saved, what has become of that, and how it resumes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.blocks import Arrays, sync, with_blocks
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import progress_of
from beamsplat.services.mapping.keyframe import Held, Keyframe
from beamsplat.services.mapping.mapper import Mapper
from beamsplat.services.mapping.session.disk_tier import Shelf
from beamsplat.services.mapping.session.paging import Pager
from beamsplat.services.mapping.session.state import arrays_of, extras_of, restore

log = logging.getLogger("beamsplat.mapping")

Opener = Callable[[str, bytes], Keyframe]  # (schema, payload) -> keyframe; raises ValueError


@dataclass(frozen=True)
class Saved:
    """What became of a checkpoint. `fault` is "" or why there is none."""

    steps: int
    keyframes: int
    fault: str = ""
    synced: tuple[int, ...] = ()  # blocks of Gaussians that are on the disk for good,
    removed: tuple[int, ...] = ()  # and those that are not needed any more


class Keeper:
    """A mapper's session. Times are those of measurements, so that a replay saves at the same moments."""

    def __init__(self, path: Path, period_ns: int, budget_bytes: float | None = None, seed: int = 0) -> None:
        self.folder = SessionFolder(path)
        self.folder.create()
        self.folder.lock()
        self.shelf = Shelf(self.folder)
        self._pager = None if budget_bytes is None else Pager(budget_bytes, seed, self.shelf)
        self._period_ns = period_ns
        self._since_ns: int | None = None  # stamp at the last checkpoint, or the first stamp there was
        self._running = False
        self._last: Saved | None = None
        self._unsaved: set[int] = set()
        self._body_fault = ""

    # --- resuming ---

    def resume(self, mapper: Mapper, opener: Opener) -> tuple[Arrays, list[int]]:
        """Makes a fresh mapper the saved one. Gives what rode along with the state, and the ids of
        keyframes on disk that came after it: the caller takes them in.

        Raises:
            UserError: there is a saved state, but it cannot be read.
        """
        paged = self._pager is not None
        mapper.elsewhere = self.shelf
        arrays = self.folder.read_state(whole=not paged)
        self._opener = opener
        if arrays is None:
            self.shelf.tidy()
            return {}, self.folder.body_ids()
        lost = restore(mapper, arrays, self._body, rest=paged)
        self.shelf.restore(arrays, mapper.store)
        for text in lost:
            log.warning("not looked at any more: %s", text)
        progress = progress_of(arrays)
        # After a crash too, none grows older than a period.
        self._since_ns = self.folder.manifest().get("stamp_ns")
        self._last = Saved(int(progress["steps"]), len(mapper.keyframes) + len(mapper.resting))
        extra = extras_of(arrays)
        known = set(extra["taken_id"].tolist()) | set(progress["forgotten"])
        return extra, [id for id in self.folder.body_ids() if id not in known]

    def _body(self, id: int) -> Keyframe:
        return self._opener(*self.folder.read_body(id))

    def page(self, mapper: Mapper) -> None:
        """Keeps the budget, if there is one."""
        if self._pager is not None:
            self._pager.page(mapper, self._body, lambda id: id not in self._unsaved)

    def bring(self, mapper: Mapper, held: Held) -> None:
        """Has all in memory that a keyframe sees."""
        if self._pager is not None:
            self._pager.bring(mapper, held)

    def moved(self, mapper: Mapper) -> None:
        """Anchors have moved."""
        if self._pager is not None:
            self._pager.moved(mapper)

    def body(self, id: int) -> tuple[str, bytes] | None:
        """A keyframe on disk; None if it is broken, which is said."""
        try:
            return self.folder.read_body(id)
        except UserError as error:
            log.warning("left out: %s", error)
            return None

    # --- keyframes ---

    def drop(self, id: int) -> None:
        """The mapper refuses a keyframe that is on disk."""
        self.folder.remove_bodies([id])

    def keep(self, id: int, schema: str, payload: bytes) -> bool:
        """Writes a keyframe that the mapper has taken. False where it could not be: who sent it keeps it."""
        try:
            self.folder.write_body(id, schema, payload)
        except OSError as error:
            self._unsaved.add(id)
            self._body_fault = f"keyframe {id} not saved: {error.strerror}"
            log.warning("%s: %s", self.folder.path, self._body_fault)
            return False
        self._unsaved.discard(id)
        if not self._unsaved:
            self._body_fault = ""
        return True

    def lacks(self, id: int) -> bool:
        """Whether a keyframe that the mapper has could not be written."""
        return id in self._unsaved

    # --- checkpoints ---

    def whole(self, arrays: Arrays) -> Arrays:
        """A state as if all Gaussians had been in memory.

        Raises:
            UserError: some on the disk cannot be read.
        """
        return with_blocks(self.folder.blocks, arrays | self.shelf.arrays())

    def count_from(self, stamp_ns: int) -> None:
        """The first keyframe that no checkpoint holds is from then."""
        if self._since_ns is None:
            self._since_ns = stamp_ns

    def due(self, stamp_ns: int) -> bool:
        """Whether it is time for a checkpoint. A clock that leaps back counts too."""
        self.count_from(stamp_ns)
        return not self._running and abs(stamp_ns - self._since_ns) >= self._period_ns

    def checkpoint(self, mapper: Mapper, extra: Arrays, stamp_ns: int) -> Callable[[], Saved]:
        """Work for the background, on copies made now; its result belongs into `done`."""
        self._running, self._since_ns = True, stamp_ns
        arrays, folder = arrays_of(mapper, extra) | self.shelf.arrays(), self.folder
        keyframes, steps = len(mapper.keyframes) + len(mapper.resting), mapper.steps
        synced, removed = self.shelf.settled()
        summary = {
            "keyframes": keyframes, "gaussians": mapper.store.count + self.shelf.count, "steps": steps,
            "anchors": len(mapper.T_map_anchor), "stamp_ns": stamp_ns,
        }  # fmt: skip
        forgotten = mapper.progress()["forgotten"]

        def run() -> Saved:
            try:
                sync(folder.blocks, synced)
                folder.write_state(arrays, summary)
            except OSError as error:
                return Saved(steps, keyframes, error.strerror or str(error))
            folder.remove_bodies(forgotten)
            folder.remove_blocks(removed)
            return Saved(steps, keyframes, "", tuple(synced), tuple(removed))

        return run

    def done(self, saved: Saved) -> None:
        """Takes in what became of a checkpoint."""
        self._running = False
        if saved.fault:
            log.warning("%s: no checkpoint: %s; the one before stays valid", self.folder.path, saved.fault)
        self.shelf.saved(saved.synced, saved.removed)
        self._last = saved

    def save(self, mapper: Mapper, extra: Arrays) -> None:
        """A checkpoint now; none must be under way.

        Raises:
            UserError: the disk does not take it, or keyframes are in memory only.
        """
        stamp_ns = self._since_ns or 0
        self.done(self.checkpoint(mapper, extra, stamp_ns)())
        if self._unsaved or self._last.fault:
            raise UserError(f"{self.folder.path}: {self.text(mapper)}")

    def text(self, mapper: Mapper) -> str:
        """For the status: how far the session is on disk, or what keeps it from being; and the memory."""
        last = self._last
        if last is not None and last.fault:
            return f"NOT SAVED: {last.fault}; the checkpoint before stays valid"
        if self._body_fault:
            return f"NOT SAVED: {self._body_fault}"
        parts = [] if last is None else [f"saved at {last.keyframes} keyframes, step {last.steps}"]
        if self._pager is not None:
            if self._pager.fault:
                parts.insert(0, f"BUDGET NOT KEPT: {self._pager.fault}")
            parts.append(self._pager.text(mapper))
        if mapper.given_up:
            parts.append(f"{mapper.given_up} keyframes given up for others of the same place")
        return "; ".join(parts)

    def close(self) -> None:
        """Lets others write to the session."""
        self.folder.unlock()
