"""Furniture placement: at walls or free-standing, clear of doors, windows, the route and other pieces.

House coordinates are the x and y of the world frame. The frame of a wall has its origin at the lower left
corner of the wall, seen from inside the room; s is the distance in metres along the wall from there.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beamsplat.tools.simulator.furniture import FurniturePiece
from beamsplat.tools.simulator.mesh import MeshPart

SIDES = ("south", "east", "north", "west")
YAW = {"south": np.pi, "east": -np.pi / 2, "north": 0.0, "west": np.pi / 2}


@dataclass(frozen=True)
class WallOpening:
    """An opening in a wall, from s0 to s1 along the wall and from z0 to z1 in height, in metres."""

    s0: float
    s1: float
    z0: float
    z1: float
    kind: str  # "door", "window" or "glass" (a glazed door)


@dataclass
class Room:
    """Inner rectangle of a room in house coordinates, its openings and the furniture placed in it.

    `taken` contains the footprint and height of each piece; `spans` contains (s0, s1, height) of each piece
    at a wall.
    """

    name: str
    x0: float
    y0: float
    x1: float
    y1: float
    openings: dict[str, list[WallOpening]] = field(default_factory=lambda: {s: [] for s in SIDES})
    taken: list[tuple[float, float, float, float, float]] = field(default_factory=list)  # x0 y0 x1 y1 height
    spans: dict[str, list[tuple[float, float, float]]] = field(default_factory=lambda: {s: [] for s in SIDES})

    def length(self, side: str) -> float:
        """Return the length of a wall in metres."""
        return self.x1 - self.x0 if side in ("south", "north") else self.y1 - self.y0

    def corner(self, side: str) -> tuple[float, float]:
        """Return the origin (x, y) of the frame of a wall, in house coordinates."""
        return {
            "south": (self.x1, self.y0),
            "east": (self.x1, self.y1),
            "north": (self.x0, self.y1),
            "west": (self.x0, self.y0),
        }[side]

    def to_house(self, side: str, s: float, out_m: float) -> tuple[float, float]:
        """Return the house coordinates of the point `s` along a wall and `out_m` metres into the room."""
        x, y = self.corner(side)
        cos, sin = np.cos(YAW[side]), np.sin(YAW[side])
        return float(x + cos * s + sin * out_m), float(y + sin * s - cos * out_m)


@dataclass(frozen=True)
class Placement:
    """Position of a piece's centre and its yaw, in house coordinates."""

    x_m: float
    y_m: float
    yaw_rad: float


class FurniturePlacer:
    """Places furniture in one room by rejection sampling: tries random placements until one is free.

    Pieces are at least `clearance_m` from the route, points (x, y) [N, 2] in house coordinates.
    """

    def __init__(self, room: Room, route_m: np.ndarray, clearance_m: float, rng: np.random.Generator) -> None:
        self.room = room
        self.rng = rng
        self.clearance_m = clearance_m
        # Pieces that were drawn, with their placement and their surfaces in the mesh builder.
        self.drawn: list[tuple[FurniturePiece, Placement, MeshPart]] = []
        near = (
            (route_m[:, 0] > room.x0 - 1.0)
            & (route_m[:, 0] < room.x1 + 1.0)
            & (route_m[:, 1] > room.y0 - 1.0)
            & (route_m[:, 1] < room.y1 + 1.0)
        )
        self.route_m = route_m[near]

    def at_wall(
        self, piece: FurniturePiece, *, tries: int = 60, sides: tuple[str, ...] = SIDES
    ) -> Placement | None:
        """Place a piece with its back to a random wall; return None if no tried placement is free."""
        for _ in range(tries):
            side = str(self.rng.choice(sides))
            length = self.room.length(side)
            margin = piece.width_m / 2 + 0.04
            if length < 2 * margin:
                continue
            s = float(self.rng.uniform(margin, length - margin))
            if not self._wall_is_free(side, s, piece):
                continue
            x, y = self.room.to_house(side, s, piece.depth_m / 2 + 0.01)
            spot = Placement(x, y, YAW[side])
            if self._floor_is_free(spot, piece):
                self._take(spot, piece)
                self.room.spans[side].append((s - piece.width_m / 2, s + piece.width_m / 2, piece.height_m))
                return spot
        return None

    def inside(self, piece: FurniturePiece, *, tries: int = 80, margin_m: float = 0.25) -> Placement | None:
        """Place a piece at least `margin_m` from all walls, at a yaw that is a multiple of 90 degrees.

        Return None if none of the tried placements is free.
        """
        room = self.room
        for _ in range(tries):
            yaw = float(self.rng.integers(4)) * np.pi / 2
            half = np.array([piece.width_m, piece.depth_m]) / 2
            if abs(np.sin(yaw)) > 0.5:
                half = half[::-1]
            low = np.array([room.x0, room.y0]) + half + margin_m
            high = np.array([room.x1, room.y1]) - half - margin_m
            if np.any(high <= low):
                continue
            x, y = self.rng.uniform(low, high)
            spot = Placement(float(x), float(y), yaw)
            if self._floor_is_free(spot, piece):
                self._take(spot, piece)
                return spot
        return None

    def at(self, spot: Placement, piece: FurniturePiece) -> bool:
        """Place a piece at the placement `spot` if its floor is free; return whether the piece was placed."""
        if not self._floor_is_free(spot, piece):
            return False
        self._take(spot, piece)
        return True

    def _wall_is_free(self, side: str, s: float, piece: FurniturePiece) -> bool:
        s0, s1 = s - piece.width_m / 2, s + piece.width_m / 2
        for hole in self.room.openings[side]:
            margin = 0.12 if hole.kind == "window" else 0.30
            if s1 > hole.s0 - margin and s0 < hole.s1 + margin and piece.height_m > hole.z0 - 0.05:
                return False
        return True

    def _floor_is_free(self, spot: Placement, piece: FurniturePiece) -> bool:
        x0, y0, x1, y1 = _rectangle(spot, piece)
        room = self.room
        if x0 < room.x0 or y0 < room.y0 or x1 > room.x1 or y1 > room.y1:
            return False
        for tx0, ty0, tx1, ty1, _ in room.taken:
            if x1 > tx0 - 0.04 and x0 < tx1 + 0.04 and y1 > ty0 - 0.04 and y0 < ty1 + 0.04:
                return False
        dx = np.maximum(np.maximum(x0 - self.route_m[:, 0], self.route_m[:, 0] - x1), 0.0)
        dy = np.maximum(np.maximum(y0 - self.route_m[:, 1], self.route_m[:, 1] - y1), 0.0)
        return bool(np.all(np.hypot(dx, dy) > self.clearance_m))

    def _take(self, spot: Placement, piece: FurniturePiece) -> None:
        self.room.taken.append((*_rectangle(spot, piece), piece.height_m))


def _rectangle(spot: Placement, piece: FurniturePiece) -> tuple[float, float, float, float]:
    half_x, half_y = piece.width_m / 2, piece.depth_m / 2
    if abs(np.sin(spot.yaw_rad)) > 0.5:
        half_x, half_y = half_y, half_x
    return spot.x_m - half_x, spot.y_m - half_y, spot.x_m + half_x, spot.y_m + half_y
