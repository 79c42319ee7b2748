"""The plan of an office floor: corridors on a grid, blocks of rooms between them, as line segments."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beamsplat.tools.simulator.office.rooms import (
    OfficeRoom,
    SegmentList,
    furnish,
    furnish_corridor,
    furnish_hall,
    room_walls,
)
from beamsplat.tools.simulator.office.settings import OfficeSettings

CORRIDOR_M = (1.9, 2.7)  # widths of corridors, walls to walls
ALIASED_CORRIDOR_M = 2.2
ROW_DEPTH_M = 5.5  # depth of a row of rooms
BLOCK_LENGTH_M = 32.0  # distance between two parallel corridors along x
ROOM_WIDTH_M = (3.2, 7.0)
ALIASED_ROOM_M = 4.1
BARE_SHARE = 0.3  # corridors with almost no objects
HALL_SHARE = 0.1  # blocks that are open halls with columns
LONGEST_ROOM_M, SHORTEST_ROOM_M = 9.0, 3.0


@dataclass
class FloorPlan:
    """All surfaces at the height of the lidar, and where the robot can drive."""

    segments: np.ndarray  # float64 [S, 4], x1, y1, x2, y2 in metres
    glass: np.ndarray  # bool [S]
    corridor_x_m: np.ndarray  # float64 [I], centre lines of the corridors along y
    corridor_y_m: np.ndarray  # float64 [J], centre lines of the corridors along x
    width_x_m: np.ndarray  # float64 [I], widths of the corridors along y
    width_y_m: np.ndarray  # float64 [J], widths of the corridors along x
    rooms: list[OfficeRoom] = field(default_factory=list)  # only rooms that can be entered


def build_floor(settings: OfficeSettings) -> FloorPlan:
    """Generate the floor plan of a seed.

    Raises:
        ValueError: the floor is too small for two corridors in each direction.
    """
    rng = np.random.default_rng([settings.seed, 0x0F1])
    aliased = settings.aliased
    x, wx = _corridors(settings.length_m, BLOCK_LENGTH_M, aliased, rng)
    y, wy = _corridors(settings.width_m, 2.0 * ROW_DEPTH_M, aliased, rng)
    edges_x = _edges(settings.length_m, x, wx)
    edges_y = _edges(settings.width_m, y, wy)
    out = SegmentList()
    out.rectangle(0.0, 0.0, settings.length_m, settings.width_m)
    rooms: list[OfficeRoom] = []
    for i, (x0, x1) in enumerate(edges_x):
        for j, (y0, y1) in enumerate(edges_y):
            inner_x, inner_y = 0 < i < len(edges_x) - 1, 0 < j < len(edges_y) - 1
            if inner_x and inner_y and not aliased and rng.random() < HALL_SHARE:
                furnish_hall(out, (x0, y0, x1, y1), rng)
                continue
            rooms += _block(out, (x0, y0, x1, y1), _doors_of(i, j, len(edges_x), len(edges_y)), aliased, rng)
    if not aliased:
        doors = np.array([r.to_floor(np.array([r.door_u_m, 0.0])) for r in rooms]).reshape(-1, 2)
        _corridor_objects(out, (x, wx, edges_x), (y, wy, edges_y), doors, rng)
    segments, glass = out.arrays()
    return FloorPlan(segments, glass, x, y, wx, wy, rooms)


def _corridors(
    size_m: float, block_m: float, aliased: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return centre lines and widths float64 [N] of the parallel corridors across a floor of this size."""
    count = round((size_m - 2.0 * ROW_DEPTH_M + block_m) / (block_m + ALIASED_CORRIDOR_M))
    if count < 2:
        raise ValueError(f"a floor of {size_m:g} m has no place for two parallel corridors; use more")
    width = np.full(count, ALIASED_CORRIDOR_M) if aliased else rng.uniform(*CORRIDOR_M, count)
    share = np.ones(count - 1) if aliased else rng.uniform(0.87, 1.15, count - 1)
    gaps = share / share.sum() * (size_m - 2.0 * ROW_DEPTH_M - width.sum())
    left = ROW_DEPTH_M + np.concatenate([[0.0], np.cumsum(width[:-1] + gaps)])
    return left + width / 2.0, width


def _edges(size_m: float, centre: np.ndarray, width: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals between parallel corridors, from wall to wall of the floor."""
    low = np.concatenate([[0.0], centre + width / 2.0])
    high = np.concatenate([centre - width / 2.0, [size_m]])
    return [(float(a), float(b)) for a, b in zip(low, high)]


def _doors_of(i: int, j: int, columns: int, rows: int) -> str:
    """Return the sides of block (i, j) that have doors: "s", "n", "w", "e", "sn", or "" for a corner."""
    inner_x, inner_y = 0 < i < columns - 1, 0 < j < rows - 1
    if inner_x:
        return "sn" if inner_y else "n" if j == 0 else "s"
    return "" if not inner_y else "e" if i == 0 else "w"


def _block(
    out: SegmentList, box: tuple[float, float, float, float], sides: str, aliased: bool,
    rng: np.random.Generator,
) -> list[OfficeRoom]:  # fmt: skip
    """Add the rooms of one block to `out`; return those that the robot can enter.

    A room has its own axes: u along its front at the corridor, v into the room.
    """
    x0, y0, x1, y1 = box
    if not sides:
        out.rectangle(*box)
        return []
    middle = 0.5 * (y0 + y1)
    fronts = {
        "s": (np.array([x0, y0]), 0.0, x1 - x0, (middle if "n" in sides else y1) - y0),
        "n": (np.array([x1, y1]), np.pi, x1 - x0, y1 - (middle if "s" in sides else y0)),
        "w": (np.array([x0, y1]), -np.pi / 2, y1 - y0, x1 - x0),
        "e": (np.array([x1, y0]), np.pi / 2, y1 - y0, x1 - x0),
    }
    rooms = []
    for side in sides:
        origin, yaw, length, depth = fronts[side]
        along = np.array([np.cos(yaw), np.sin(yaw)])
        start = 0.0
        for width in _room_widths(length, aliased, rng):
            local = np.random.default_rng(0x100) if aliased else rng
            room = OfficeRoom(origin + start * along, yaw, width, depth)
            room_walls(out, room, local, plain=aliased)
            furnish(out, room, local)
            if room.open:
                rooms.append(room)
            start += width
    # The two ends of the block have no doors.
    if sides in ("sn", "s", "n"):
        out.line(x0, y0, x0, y1)
        out.line(x1, y0, x1, y1)
    else:
        out.line(x0, y0, x1, y0)
        out.line(x0, y1, x1, y1)
    return rooms


def _room_widths(length_m: float, aliased: bool, rng: np.random.Generator) -> list[float]:
    """Return widths of rooms side by side that fill a length."""
    if aliased:
        count = max(1, int(length_m // ALIASED_ROOM_M))
        return [length_m / count] * count
    widths: list[float] = []
    while (rest := length_m - sum(widths)) > 0.0:
        width = float(rng.uniform(*ROOM_WIDTH_M))
        if rest - width < SHORTEST_ROOM_M:
            width = rest if rest <= LONGEST_ROOM_M else rest / 2.0
        widths.append(width)
    return widths


def _corridor_objects(
    out: SegmentList,
    along_y: tuple[np.ndarray, np.ndarray, list[tuple[float, float]]],
    along_x: tuple[np.ndarray, np.ndarray, list[tuple[float, float]]],
    doors_m: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Add columns, cabinets and plants at the walls of the corridors, but not in front of open doors."""
    for (centre, width, _), spans, turned in (
        (along_x, along_y[2], False),
        (along_y, along_x[2], True),
    ):
        for c, w in zip(centre, width):
            spacing_m = 25.0 if rng.random() < BARE_SHARE else 5.0
            for low, high in spans[1:-1]:
                furnish_corridor(out, (low, high), float(c), float(w), turned, spacing_m, doors_m, rng)
