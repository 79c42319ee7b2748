"""What differs between two drives through a generated home: what is asked for, and the truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Rearrangement:
    """How many pieces are moved, removed and added; `seed` selects them and their places."""

    moved: int = 0
    removed: int = 0
    added: int = 0
    seed: int = 0


@dataclass(frozen=True)
class ObjectChange:
    """One changed piece: axis-aligned boxes (x0, y0, z0, x1, y1, z1) in metres in the world frame."""

    kind: str  # "moved", "removed" or "added"
    name: str  # of the piece
    before_m: tuple[float, ...] | None  # None for "added"
    after_m: tuple[float, ...] | None  # None for "removed"


def changes_json(changes: tuple[ObjectChange, ...]) -> dict[str, Any]:
    """Return the contents of changes.json: the truth beside a recording of a rearranged home."""
    boxes = "axis-aligned boxes x0, y0, z0, x1, y1, z1 in metres in the world frame of groundtruth.txt"
    return {"boxes": boxes, "changes": [asdict(change) for change in changes]}
