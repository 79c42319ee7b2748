"""Keeps a mapper on disk: when it is saved, what has become of that, and how it resumes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from common.errors import UserError
from services.mapping.keyframe import Held, Keyframe
from services.mapping.mapper import Mapper
from services.mapping.session.folder import Arrays, SessionFolder
from services.mapping.session.paging import Pager
from services.mapping.session.state import arrays_of, extras_of, progress_of, restore

log = logging.getLogger("beamsplat.mapping")

Opener = Callable[[str, bytes], Keyframe]  # (schema, payload) -> keyframe; raises ValueError


@dataclass(frozen=True)
class Saved:
    """What became of a checkpoint. `fault` is "" or why there is none."""

    steps: int
    keyframes: int
    fault: str = ""


class Keeper:
    """A mapper's session. Times are those of measurements, so that a replay saves at the same moments."""

    def __init__(self, path: Path, period_ns: int, pager: Pager | None = None) -> None:
        self.folder = SessionFolder(path)
        self.folder.create()
        self.folder.lock()
        self._pager = pager
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
        arrays = self.folder.read_state()
        self._opener = opener
        if arrays is None:
            return {}, self.folder.body_ids()
        lost = restore(mapper, arrays, self._body, None if self._pager is None else self._pager.parked)
        for text in lost:
            log.warning("not looked at any more: %s", text)
        progress = progress_of(arrays)
        # After a crash too, none grows older than a period.
        self._since_ns = self.folder.manifest().get("stamp_ns")
        self._last = Saved(int(progress["steps"]), len(mapper.keyframes) + len(self.parked))
        extra = extras_of(arrays)
        known = set(extra["taken_id"].tolist()) | set(progress["forgotten"])
        return extra, [id for id in self.folder.body_ids() if id not in known]

    def _body(self, id: int) -> Keyframe:
        return self._opener(*self.folder.read_body(id))

    def page(self, mapper: Mapper) -> None:
        """Keeps the keyframes' pictures within the budget, if there is one."""
        if self._pager is not None:
            self._pager.page(mapper, self._body, lambda id: id not in self._unsaved)

    @property
    def parked(self) -> dict[int, Held]:
        """Keyframes whose pictures are on disk only."""
        return {} if self._pager is None else self._pager.parked

    def body(self, id: int) -> tuple[str, bytes] | None:
        """A keyframe on disk; None if it is broken, which is said."""
        try:
            return self.folder.read_body(id)
        except UserError as error:
            log.warning("left out: %s", error)
            return None

    def drop(self, id: int) -> None:
        """The mapper refuses a keyframe that is on disk."""
        self.folder.remove_bodies([id])

    # --- keyframes ---

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

    def due(self, stamp_ns: int) -> bool:
        """Whether it is time for a checkpoint. A clock that leaps back counts too."""
        if self._since_ns is None:
            self._since_ns = stamp_ns
        return not self._running and abs(stamp_ns - self._since_ns) >= self._period_ns

    def checkpoint(self, mapper: Mapper, extra: Arrays, stamp_ns: int) -> Callable[[], Saved]:
        """Work for the background, on copies made now; its result belongs into `done`."""
        self._running, self._since_ns = True, stamp_ns
        arrays, folder = arrays_of(mapper, extra, self.parked), self.folder
        keyframes, steps = len(mapper.keyframes) + len(self.parked), mapper.steps
        summary = {
            "keyframes": keyframes, "gaussians": mapper.store.count, "steps": steps,
            "anchors": len(mapper.T_map_anchor), "stamp_ns": stamp_ns,
        }  # fmt: skip
        forgotten = mapper.progress()["forgotten"]

        def run() -> Saved:
            try:
                folder.write_state(arrays, summary)
            except OSError as error:
                return Saved(steps, keyframes, error.strerror or str(error))
            folder.remove_bodies(forgotten)
            return Saved(steps, keyframes)

        return run

    def done(self, saved: Saved) -> None:
        """Takes in what became of a checkpoint."""
        self._running = False
        if saved.fault:
            log.warning("%s: no checkpoint: %s; the one before stays valid", self.folder.path, saved.fault)
        self._last = saved

    def save(self, mapper: Mapper, extra: Arrays) -> None:
        """A checkpoint now; none must be under way.

        Raises:
            UserError: the disk does not take it, or keyframes are in memory only.
        """
        stamp_ns = self._since_ns or 0
        self.done(self.checkpoint(mapper, extra, stamp_ns)())
        if self._unsaved or self._last.fault:
            raise UserError(f"{self.folder.path}: {self.text()}")

    def text(self) -> str:
        """For the status: how far the session is on disk, or what keeps it from being."""
        last = self._last
        if last is not None and last.fault:
            return f"NOT SAVED: {last.fault}; the checkpoint before stays valid"
        if self._body_fault:
            return f"NOT SAVED: {self._body_fault}"
        paged = f", {len(self.parked)} keyframes on disk only" if self.parked else ""
        lost = f", {self._pager.lost} lost" if self._pager is not None and self._pager.lost else ""
        return (
            ("" if last is None else f"saved at {last.keyframes} keyframes, step {last.steps}") + paged + lost
        )

    def close(self) -> None:
        """Lets others write to the session."""
        self.folder.unlock()
