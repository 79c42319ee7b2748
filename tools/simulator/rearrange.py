"""Move, remove and add furniture of a generated home, with the truth: two drives through a home that changed.

All that is not changed stays bit-identical to the home of the same seed. Only pieces that one person carries
are changed, and only where the robot's camera sees their place from its route: a change that no sensor
observes cannot be found. Floor lamps stay: their poles are thinner than the spacing of lidar beams.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from beamsplat.common.geometry.transforms import inverse, se2_to_se3
from beamsplat.tools.simulator import furniture as f
from beamsplat.tools.simulator import furniture_rooms as fr
from beamsplat.tools.simulator import furniture_small as fs
from beamsplat.tools.simulator.changes import ObjectChange, Rearrangement
from beamsplat.tools.simulator.furniture import FurniturePiece
from beamsplat.tools.simulator.mesh import MeshBuilder
from beamsplat.tools.simulator.place import FurniturePlacer, Placement, Room
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.rooms import PlacedPiece

MOVABLE = frozenset({
    "armchair", "bench", "bookshelf", "chest", "coffee_table", "nightstand", "plant", "sideboard", "stool",
    "toy_box",
})  # fmt: skip
NEW: tuple[Callable[[], FurniturePiece], ...] = (
    f.armchair, fr.stool, fr.toy_box, fr.nightstand, lambda: fs.plant(1.1), lambda: fr.bench(1.1),
)  # fmt: skip
MIN_MOVE_M = 1.0  # between the centres of the old and the new place
MIN_APART_M = 0.3  # between the boxes of two changed places, so that a result belongs to one of them
EYE_M = 0.45  # height of the camera
SEEN_FROM_M = (0.6, 4.0)  # distance from the route
SEEN_HALF_ANGLE_RAD = (0.5, 0.4)  # of the field of view that counts: across, up and down
SEEN_RATIO, SEEN_POSES = 0.12, 3  # ratio of a piece's points in sight, at so many poses 0.3 m apart
TRIES = 24  # places for a piece in a room
_PROBES = 48  # points of a piece whose visibility is tested


def rearrange(
    b: MeshBuilder,
    pieces: list[PlacedPiece],
    route_m: np.ndarray,  # [N, 2], points at most 0.1 m apart
    clearance_m: float,
    wanted: Rearrangement,
) -> tuple[ObjectChange, ...]:
    """Change a furnished home in its mesh builder.

    Args:
        pieces: the furniture of the home; the rooms' lists of taken floor are extended.
        route_m: closed route of the robot; new places are at least `clearance_m` from it.

    Raises:
        ValueError: too few pieces can be changed in view of the route; the text says which option to lower.
    """
    rng = np.random.default_rng([wanted.seed, 0x43, 0x48])
    view = _RouteView(b, route_m)
    boxes: list[np.ndarray] = []  # of all changed places
    changes: list[ObjectChange] = []
    candidates = [pieces[k] for k in rng.permutation(len(pieces)) if pieces[k].piece.name in MOVABLE]
    for kind, count in (("moved", wanted.moved), ("removed", wanted.removed)):
        found = 0
        while found < count and candidates:
            change = _changed(b, candidates.pop(), kind, pieces, view, (route_m, clearance_m), boxes, rng)
            if change is not None:
                changes.append(change)
                found += 1
        _check(kind, found, count)
    rooms = list({id(p.room): p.room for p in pieces}.values())
    found = 0
    for k in range(40 * wanted.added):
        if found == wanted.added:
            break
        piece, room = NEW[int(rng.integers(len(NEW)))](), rooms[k % len(rooms)]
        change = _added(b, piece, room, view, (route_m, clearance_m), boxes, rng)
        if change is not None:
            changes.append(change)
            found += 1
    _check("added", found, wanted.added)
    return tuple(changes)


def _check(kind: str, found: int, wanted: int) -> None:
    if found < wanted:
        raise ValueError(
            f"--{kind} {wanted}: only {found} pieces of this home can be {kind} in view of the route: "
            "choose fewer, or another --seed or --changes-seed"
        )


def _changed(
    b: MeshBuilder,
    old: PlacedPiece,
    kind: str,
    pieces: list[PlacedPiece],
    view: _RouteView,
    route: tuple[np.ndarray, float],
    boxes: list[np.ndarray],
    rng: np.random.Generator,
) -> ObjectChange | None:
    """Move or remove a piece; return None if its place is not in view, or no new place was found."""
    points = b.vertices_of(old.part)
    box = _box(points)
    if not _apart(box, boxes) or not view.sees(points):
        return None
    if kind == "removed":
        boxes.append(box)
        b.remove(old.part)
        return ObjectChange(kind, old.piece.name, tuple(box.tolist()), None)
    rooms = list({id(p.room): p.room for p in [old, *pieces]}.values())
    T_world_old = se2_to_se3(np.array([old.spot.x_m, old.spot.y_m, old.spot.yaw_rad]))
    for room in rooms:
        for spot in _spots(old.piece, room, route, rng):
            if np.hypot(spot.x_m - old.spot.x_m, spot.y_m - old.spot.y_m) < MIN_MOVE_M:
                continue
            T = se2_to_se3(np.array([spot.x_m, spot.y_m, spot.yaw_rad])) @ inverse(T_world_old)
            there = points @ T[:3, :3].T + T[:3, 3]
            new = _box(there)
            if _apart(new, [*boxes, box]) and view.sees(there):
                b.move(old.part, T)
                boxes += [box, new]
                return ObjectChange(kind, old.piece.name, tuple(box.tolist()), tuple(new.tolist()))
    return None


def _added(
    b: MeshBuilder,
    piece: FurniturePiece,
    room: Room,
    view: _RouteView,
    route: tuple[np.ndarray, float],
    boxes: list[np.ndarray],
    rng: np.random.Generator,
) -> ObjectChange | None:
    """Draw a new piece; return None if no place in view was found."""
    for spot in _spots(piece, room, route, rng):
        before = b.part_from()
        piece.draw(b.placed(spot.x_m, spot.y_m, 0.0, spot.yaw_rad), rng)
        part = b.part_from(before)
        points = b.vertices_of(part)
        box = _box(points)
        if _apart(box, boxes) and view.sees(points):
            boxes.append(box)
            return ObjectChange("added", piece.name, None, tuple(box.tolist()))
        b.remove(part)
    return None


def _spots(
    piece: FurniturePiece, room: Room, route: tuple[np.ndarray, float], rng: np.random.Generator
) -> Iterator[Placement]:
    """Yield free placements of a piece in a room; a placement that is not used is free again."""
    for _ in range(TRIES):
        placer = FurniturePlacer(room, *route, rng)
        taken = len(room.taken)
        spans = {side: len(list_) for side, list_ in room.spans.items()}
        spot = None if piece.name == "coffee_table" else placer.at_wall(piece)
        spot = spot or placer.inside(piece)
        if spot is None:
            return
        yield spot
        del room.taken[taken:]
        for side, count in spans.items():
            del room.spans[side][count:]


def _box(points: np.ndarray) -> np.ndarray:
    """Return the axis-aligned box float64 [6] of points [N, 3]: the lower corner, then the upper one."""
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def _apart(box: np.ndarray, others: list[np.ndarray]) -> bool:
    gaps = [np.maximum(box[:2] - o[3:5], o[:2] - box[3:5]).max() for o in others]
    return min(gaps, default=np.inf) >= MIN_APART_M


class _RouteView:
    """Tells what the robot's camera sees from its route, in the home before it is changed."""

    def __init__(self, b: MeshBuilder, route_m: np.ndarray) -> None:
        step = float(np.linalg.norm(np.diff(route_m, axis=0), axis=1).mean())
        chosen = np.arange(0, len(route_m), max(round(0.3 / step), 1))
        ahead = route_m[(chosen + 2) % len(route_m)] - route_m[chosen - 2]
        self._heading = np.arctan2(ahead[:, 1], ahead[:, 0])
        self._eyes = np.column_stack([route_m[chosen], np.full(len(chosen), EYE_M)])
        self._caster = RayCaster.of(b.build())

    def sees(self, points: np.ndarray) -> bool:
        """Return whether enough of the points [N, 3] of a piece are in sight from enough poses.

        The piece itself does not occlude the points where it will be; where it is, its back sides count as
        hidden, which `SEEN_RATIO` allows for.
        """
        probes = points[np.linspace(0, len(points) - 1, _PROBES).astype(int)]
        ray = probes[None] - self._eyes[:, None]
        distance = np.linalg.norm(ray, axis=2)
        turn = np.arctan2(ray[..., 1], ray[..., 0]) - self._heading[:, None]
        across = np.abs(np.angle(np.exp(1j * turn)))
        up = np.abs(np.arcsin(ray[..., 2] / distance))
        inside = (across < SEEN_HALF_ANGLE_RAD[0]) & (up < SEEN_HALF_ANGLE_RAD[1])
        inside &= (distance > SEEN_FROM_M[0]) & (distance < SEEN_FROM_M[1])
        at = np.nonzero(inside)
        hidden = self._caster.occluded(self._eyes[at[0]], ray[at], np.full(len(at[0]), 0.98))
        inside[at] = ~hidden
        return int((inside.mean(axis=1) >= SEEN_RATIO).sum()) >= SEEN_POSES
