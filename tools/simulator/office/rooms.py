"""Rooms of an office floor: walls, doors, glass fronts, and furniture as a 2D lidar near the floor sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WALL_M = 0.12  # thickness of a wall
DOOR_M = 1.0  # clear width of a door
CLOSED_SHARE = 0.35  # doors that are closed
GLASS_SHARE = 0.2  # rooms with a glass front
POST_M = 0.06  # side of the posts of a glass front
LEG_M = 0.045  # side of the leg of a table
ROBOT_ROOM_M = 0.45  # furniture keeps this distance from the robot's path through a room


class SegmentList:
    """Collects line segments in the frame of the floor."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float, float]] = []
        self._glass: list[bool] = []

    def line(self, x1: float, y1: float, x2: float, y2: float, glass: bool = False) -> None:
        """Add one segment; its end points are in metres."""
        self._rows.append((x1, y1, x2, y2))
        self._glass.append(glass)

    def rectangle(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Add the outline of a rectangle along the axes."""
        self.polygon(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))

    def polygon(self, corners: np.ndarray) -> None:
        """Add the outline of a polygon, float64 [N, 2]."""
        for a, b in zip(corners, np.roll(corners, -1, axis=0)):
            self.line(*a.tolist(), *b.tolist())

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the segments float64 [S, 4] and their glass flags bool [S]."""
        return np.array(self._rows, dtype=np.float64).reshape(-1, 4), np.array(self._glass, dtype=bool)


@dataclass
class OfficeRoom:
    """A room in its own axes: u along its front at the corridor, v into it; (0, 0) is a front corner."""

    origin_m: np.ndarray  # float64 [2]
    yaw_rad: float  # of the u axis in the frame of the floor
    width_m: float  # along u
    depth_m: float  # along v
    door_u_m: float = 0.0  # centre of the door
    open: bool = False
    zone: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # u0, v0, u1, v1: where the robot drives

    def to_floor(self, uv: np.ndarray) -> np.ndarray:
        """Return points [..., 2] of the room in the frame of the floor."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        u, v = np.moveaxis(np.asarray(uv, dtype=np.float64), -1, 0)
        return np.stack([self.origin_m[0] + c * u - s * v, self.origin_m[1] + s * u + c * v], axis=-1)

    def visit(self) -> np.ndarray:
        """Return way points float64 [N, 2] on the floor: from the door through the room and back."""
        u0, v0, u1, v1 = self.zone
        d = self.door_u_m
        return self.to_floor(np.array([[d, 0.0], [d, v0], [u0, v1], [u1, v1], [d, v0], [d, 0.0]]))

    def is_free(self, box: tuple[float, float, float, float]) -> bool:
        """Return whether a piece of furniture (u0, v0, u1, v1) leaves the path of the robot free."""
        u0, v0, u1, v1 = box
        g = ROBOT_ROOM_M
        zone = (self.zone[0] - g, self.zone[1] - g, self.zone[2] + g, self.zone[3] + g)
        door = (self.door_u_m - 0.7, 0.0, self.door_u_m + 0.7, 1.3)
        return all(u1 <= a or u0 >= c or v1 <= b or v0 >= d for a, b, c, d in (zone, door))

    def add(self, out: SegmentList, uv: np.ndarray) -> None:
        """Add the outline of a polygon [N, 2] in the axes of the room."""
        out.polygon(self.to_floor(uv))

    def line(self, out: SegmentList, u1: float, v1: float, u2: float, v2: float, glass: bool = False) -> None:
        """Add one segment in the axes of the room."""
        x1, y1, x2, y2 = self.to_floor(np.array([[u1, v1], [u2, v2]])).ravel().tolist()
        out.line(x1, y1, x2, y2, glass)


def room_walls(out: SegmentList, room: OfficeRoom, rng: np.random.Generator, *, plain: bool) -> None:
    """Choose the door of a room and the zone where the robot drives, and add the walls.

    With `plain` the door is in the middle and open, and the front has no glass.
    """
    w, d, half = room.width_m, room.depth_m, DOOR_M / 2.0
    low = WALL_M + half + 0.15
    room.door_u_m = w / 2.0 if plain else float(rng.uniform(low, w - low))
    room.open = plain or bool(rng.random() > CLOSED_SHARE)
    centre = float(np.clip(room.door_u_m, 1.65, max(w - 1.65, 1.65))) if w > 3.3 else w / 2.0
    reach = min(0.65 if w < 4.5 else 0.9, w / 2.0 - 0.9)
    room.zone = (centre - reach, 1.2, centre + reach, d - 1.35)
    glass = not plain and room.open and bool(rng.random() < GLASS_SHARE)
    t, a, b = WALL_M / 2.0, room.door_u_m - half, room.door_u_m + half
    # Inner faces of the side walls and of the back wall, and both faces of the front beside the door.
    room.line(out, t, WALL_M, t, d - t)
    room.line(out, w - t, WALL_M, w - t, d - t)
    room.line(out, t, d - t, w - t, d - t)
    if glass:
        for u0, u1 in ((t, a), (b, w - t)):
            room.line(out, u0, t, u1, t, glass=True)
        for u in (*np.arange(t, a, 1.4), a - POST_M / 2, b + POST_M / 2, *np.arange(w - t, b, -1.4)):
            room.add(out, _box(u - POST_M / 2, t - POST_M / 2, u + POST_M / 2, t + POST_M / 2))
        for u in (t, w - t):
            room.line(out, u, 0.0, u, WALL_M)
        room.line(out, 0.0, 0.0, t, 0.0)
        room.line(out, w - t, 0.0, w, 0.0)
    else:
        for v, u_low, u_high in ((0.0, 0.0, w), (WALL_M, t, w - t)):
            room.line(out, u_low, v, a, v)
            room.line(out, b, v, u_high, v)
        room.line(out, a, 0.0, a, WALL_M)
        room.line(out, b, 0.0, b, WALL_M)
    if room.open:
        # The leaf of the door is open, turned about its hinge into the room.
        turn = np.radians(95.0 if plain else rng.uniform(85.0, 115.0))
        hinge, sign = (a, 1.0) if a > 0.95 or plain else (b, -1.0)
        tip = (hinge + sign * 0.95 * np.cos(turn), WALL_M + 0.95 * np.sin(turn))
        if t < tip[0] < w - t:
            room.line(out, hinge, WALL_M, *tip)
    else:
        room.line(out, a, 0.06, b, 0.06)


def furnish(out: SegmentList, room: OfficeRoom, rng: np.random.Generator) -> None:
    """Put desks, cabinets and shelves along the walls of a room, and tables into a large room."""
    t, w, d = WALL_M, room.width_m, room.depth_m
    for wall, length in (("back", w - 2 * t), ("left", d - 2 * t), ("right", d - 2 * t)):
        at = float(rng.uniform(0.0, 0.4))
        while at < length - 0.5:
            kind = rng.choice(["desk", "cabinet", "shelf", "gap"])
            size = {"desk": 1.6, "cabinet": 0.8, "shelf": 1.0, "gap": 0.7}[str(kind)]
            deep = {"desk": 0.75, "cabinet": 0.45, "shelf": 0.3, "gap": 0.0}[str(kind)]
            size *= float(rng.uniform(0.85, 1.2))
            variant = rng.random(4)
            box = _at_wall(room, wall, at, size, deep)
            if kind != "gap" and at + size < length and room.is_free(box):
                if kind == "desk":
                    _desk(out, room, box, wall, variant)
                else:
                    room.add(out, _box(*box))
            at += size + float(rng.uniform(0.02, 0.3))
    for _ in range(int(max(0.0, w - 5.0))):
        u, v = rng.uniform(1.2, w - 1.2), rng.uniform(1.6, d - 1.2)
        variant = rng.random(4)
        box = (float(u - 0.8), float(v - 0.4), float(u + 0.8), float(v + 0.4))
        if room.is_free(box):
            _desk(out, room, box, "left", variant)


def furnish_hall(out: SegmentList, box: tuple[float, float, float, float], rng: np.random.Generator) -> None:
    """Add an open hall without walls: columns, and groups of seats, at random places."""
    x0, y0, x1, y1 = box
    for x in np.arange(x0 + 2.0, x1 - 1.0, 6.0):
        for y in (y0 + 1.0, y1 - 1.0):
            out.rectangle(x - 0.25, y - 0.25, x + 0.25, y + 0.25)
    for _ in range(int((x1 - x0) * (y1 - y0) / 18.0)):
        x, y = rng.uniform(x0 + 1.0, x1 - 1.0), rng.uniform(y0 + 1.8, y1 - 1.8)
        yaw, size = rng.uniform(0.0, np.pi), rng.uniform([0.5, 0.4], [2.0, 0.9])
        c, s = np.cos(yaw), np.sin(yaw)
        corners = _box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
        out.polygon(corners @ np.array([[c, s], [-s, c]]) + [x, y])


def furnish_corridor(
    out: SegmentList, span: tuple[float, float], centre_m: float, width_m: float, turned: bool,
    spacing_m: float, doors_m: np.ndarray, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Put objects at both walls of a piece of a corridor, `spacing_m` apart on average.

    With `turned` the corridor is along y. Nothing is put in front of the doors, float64 [D, 2].
    """
    for sign in (-1.0, 1.0):
        at = span[0] + float(rng.exponential(spacing_m))
        while at < span[1] - 1.5:
            size, deep = float(rng.uniform(0.3, 1.2)), float(rng.uniform(0.08, width_m / 2.0 - 0.75))
            wall = centre_m + sign * width_m / 2.0
            corners = np.array(
                [[at, wall], [at, wall - sign * deep], [at + size, wall - sign * deep], [at + size, wall]]
            )
            if rng.random() < 0.3:  # a plant or a bin
                angle = np.arange(8) * np.pi / 4.0
                radius = deep / 2.0
                corners = np.stack(
                    [at + radius * np.cos(angle), wall - sign * radius + radius * np.sin(angle)], axis=1
                )
            corners = corners[:, ::-1] if turned else corners
            if len(doors_m) == 0 or np.hypot(*(doors_m - corners.mean(axis=0)).T).min() > size / 2.0 + 1.0:
                out.polygon(corners)
            at += size + float(rng.exponential(spacing_m))


def _box(u0: float, v0: float, u1: float, v1: float) -> np.ndarray:
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])


def _at_wall(
    room: OfficeRoom, wall: str, at: float, size: float, deep: float
) -> tuple[float, float, float, float]:
    """Return the box (u0, v0, u1, v1) of furniture of this size at a wall, `at` metres along it."""
    t, w, d = WALL_M, room.width_m, room.depth_m
    if wall == "back":
        return t + at, d - t / 2 - deep, t + at + size, d - t / 2
    if wall == "left":
        return t / 2, t + at, t / 2 + deep, t + at + size
    return w - t / 2 - deep, t + at, w - t / 2, t + at + size


def _desk(
    out: SegmentList, room: OfficeRoom, box: tuple[float, float, float, float], wall: str, variant: np.ndarray
) -> None:
    """Add a desk as seen at the height of the lidar: legs, perhaps a drawer unit, and the base of a chair."""
    u0, v0, u1, v1 = box
    for u in (u0, u1 - LEG_M):
        for v in (v0, v1 - LEG_M):
            room.add(out, _box(u, v, u + LEG_M, v + LEG_M))
    if variant[0] < 0.6:
        if wall == "back":
            left = u0 + 0.06 if variant[1] < 0.5 else u1 - 0.48
            room.add(out, _box(left, v0 + 0.1, left + 0.42, v1 - 0.05))
        else:
            low = v0 + 0.06 if variant[1] < 0.5 else v1 - 0.48
            room.add(out, _box(u0 + 0.05, low, u1 - 0.1, low + 0.42))
    centre = np.array(
        [u0 + (u1 - u0) * (0.35 + 0.3 * variant[2]), v0 + (v1 - v0) * (0.35 + 0.3 * variant[3])]
    )
    for angle in np.arange(5) * 2.0 * np.pi / 5.0 + 2.0 * np.pi * variant[2]:
        u, v = centre + 0.28 * np.array([np.cos(angle), np.sin(angle)])
        room.add(out, _box(u - 0.025, v - 0.025, u + 0.025, v + 0.025))
