"""Saving of a growing map: what is new is appended to a journal, a small state with the poses is replaced."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.files.journal import Record, append_records
from beamsplat.common.files.numbered_state import numbered_files, read_json
from beamsplat.services.localization.lidar2d import map_records
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.map_records import SavedMap
from beamsplat.services.localization.lidar2d.pose_graph_data import Constraint
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import (
    FORMAT,
    PREFIX,
    VERSION,
    manifest_settings,
    map_files,
)
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord

_SUFFIX = ".journal"
# A journal is written anew when it is larger than this many times what the map needs, and than 4 MB more.
_MAX_GROWTH, _SPARE_BYTES = 2.0, 4_000_000
_CONSTRAINT_BYTES = 120  # of one in a record


@dataclass(frozen=True)
class _Journal:
    """What the journal of a map contains: it is up to date when the manifest names it with this length."""

    name: str
    length: int = 0
    record: TrajectoryRecord | None = None
    scans: int = 0  # rows of `record`
    nodes: dict[int, int] = field(default_factory=dict)  # id of a node in use -> its number
    node_count: int = 0  # with those that have been removed from the map
    # The object stands for the constraint, which has no id. It is referred to, so that its id() stays unique.
    constraints: dict[int, tuple[Constraint, int]] = field(default_factory=dict)
    constraint_count: int = 0
    submaps: dict[int, FrozenMap] = field(default_factory=dict)


class MapSaver:
    """Writes the states of one growing map to a folder; one process at a time may write there.

    The first state is written as a whole. Later ones append the new nodes, finished submaps, constraints and
    scans. A crash or an error at any moment leaves the new or the previous state valid.
    """

    def __init__(self, folder: Path, settings: LidarSlamSettings) -> None:
        self.folder = Path(folder)
        self.bytes_written = 0  # to the journal, since the creation
        self._settings = manifest_settings(settings)
        self._journal: _Journal | None = None

    def save(self, saved: SavedMap) -> None:
        """Write a map in place of the previous one.

        Raises:
            OSError: the disk is full or broken; the new or the previous state is valid.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        journal = self._journal
        if journal is None or journal.record is not saved.record or self._is_too_large(journal, saved):
            journal = _Journal(self._unused_name())
        news = _with_news(journal, saved)
        candidates = [journal]
        try:
            records = _records(journal, news, saved)
            length = append_records(self.folder / journal.name, journal.length, records)
            candidates.append(replace(news, length=length))
            self.bytes_written += length - journal.length
            map_files(self.folder).write(_state(news, saved), self._entries(candidates[-1], saved))
        except BaseException:
            self._journal = self._valid_journal(candidates)
            raise
        self._journal = candidates[-1]
        for old in numbered_files(self.folder, PREFIX, _SUFFIX).values():
            if old.name != journal.name:
                with contextlib.suppress(OSError):  # removed after the next state
                    old.unlink()

    def _is_too_large(self, journal: _Journal, saved: SavedMap) -> bool:
        """Return whether much of the journal is not needed any more: rebuilt submaps, trimmed nodes."""
        finished = [s.frozen for s in saved.submaps if s.frozen is not None]
        needed = (
            sum(len(n.scan.data) + 64 for n in saved.nodes)
            + sum(len(f.packed) + f.means.nbytes + f.omegas.nbytes + f.views.nbytes for f in finished)
            + _CONSTRAINT_BYTES * len(saved.constraints)
            + TrajectoryRecord.ROW_BYTES * saved.scans
        )
        return journal.length > _MAX_GROWTH * needed + _SPARE_BYTES

    def _unused_name(self) -> str:
        number = 1 + max(numbered_files(self.folder, PREFIX, _SUFFIX), default=0)
        while (self.folder / f"{PREFIX}{number}{_SUFFIX}").exists():  # a folder of this name
            number += 1
        return f"{PREFIX}{number}{_SUFFIX}"

    def _entries(self, journal: _Journal, saved: SavedMap) -> dict[str, object]:
        return {
            "format": FORMAT, "version": VERSION, "uuid": saved.uuid, "keynodes": len(saved.nodes),
            "submaps": len(saved.submaps), "constraints": len(saved.constraints), "journal": journal.name,
            "journal_bytes": journal.length, "settings": self._settings,
        }  # fmt: skip

    def _valid_journal(self, candidates: list[_Journal]) -> _Journal | None:
        """Return which of the journals the manifest names after an error; None if it is not known.

        A journal that was being created, and that the manifest does not name, is removed: the disk may be
        full.
        """
        manifest = map_files(self.folder).manifest_path
        try:
            table = read_json(manifest, "") if manifest.exists() else {}
        except (UserError, OSError):
            return None
        named = table.get("journal"), table.get("journal_bytes")
        for journal in candidates:
            if journal.length and named == (journal.name, journal.length):
                return journal
        if named[0] != candidates[0].name:
            with contextlib.suppress(OSError):
                (self.folder / candidates[0].name).unlink()
        return None


def _with_news(journal: _Journal, saved: SavedMap) -> _Journal:
    """Return what the journal contains once everything that is new in a map has been appended."""
    nodes, count = {}, journal.node_count
    for node in saved.nodes:
        nodes[node.id] = journal.nodes.get(node.id, count)
        count += nodes[node.id] == count
    constraints, constraint_count = {}, journal.constraint_count
    for constraint in saved.constraints:
        known = journal.constraints.get(id(constraint))
        constraints[id(constraint)] = known or (constraint, constraint_count)
        constraint_count += known is None
    submaps = {s.id: s.frozen for s in saved.submaps if s.frozen is not None}
    return _Journal(
        journal.name, journal.length, saved.record, saved.scans, nodes, count, constraints, constraint_count,
        submaps,
    )  # fmt: skip


def _records(before: _Journal, after: _Journal, saved: SavedMap) -> Iterator[Record]:
    """Yield the records of what is new."""
    yield from map_records.node_records([n for n in saved.nodes if after.nodes[n.id] >= before.node_count])
    for submap in saved.submaps:
        if submap.frozen is not None and before.submaps.get(submap.id) is not submap.frozen:
            yield map_records.submap_record(submap)
    new = [c for c in saved.constraints if after.constraints[id(c)][1] >= before.constraint_count]
    yield from map_records.constraint_records(new)
    yield from map_records.trajectory_records(saved.record, before.scans, saved.scans)


def _state(journal: _Journal, saved: SavedMap) -> dict[str, np.ndarray]:
    numbers = np.array([journal.nodes[n.id] for n in saved.nodes], dtype=np.int64)
    nodes = np.zeros(journal.node_count, dtype=bool)
    nodes[numbers] = True
    constraints = np.zeros(journal.constraint_count, dtype=bool)
    constraints[[number for _, number in journal.constraints.values()]] = True
    return map_records.state_arrays(saved, np.argsort(numbers), nodes, constraints)
