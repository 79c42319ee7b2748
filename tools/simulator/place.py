"""Where furniture goes: along walls or free in a room, clear of doors, windows, the drive and each other."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beamsplat.tools.simulator.furniture import Piece

SIDES = ("south", "east", "north", "west")
YAW = {"south": np.pi, "east": -np.pi / 2, "north": 0.0, "west": np.pi / 2}


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: from s0 to s1 along it, from z0 to z1; all metres."""

    s0: float
    s1: float
    z0: float
    z1: float
    kind: str  # door, window or glass (a glazed door)


@dataclass
class Room:
    """Inner rectangle of a room in house coordinates, and what has been put there."""

    name: str
    x0: float
    y0: float
    x1: float
    y1: float
    openings: dict[str, list[Opening]] = field(default_factory=lambda: {s: [] for s in SIDES})
    taken: list[tuple[float, float, float, float, float]] = field(default_factory=list)  # x0 y0 x1 y1 height
    spans: dict[str, list[tuple[float, float, float]]] = field(default_factory=lambda: {s: [] for s in SIDES})

    def length(self, side: str) -> float:
        return self.x1 - self.x0 if side in ("south", "north") else self.y1 - self.y0

    def corner(self, side: str) -> tuple[float, float]:
        """The lower left corner of a wall as seen from inside: the origin of its frame."""
        return {
            "south": (self.x1, self.y0),
            "east": (self.x1, self.y1),
            "north": (self.x0, self.y1),
            "west": (self.x0, self.y0),
        }[side]

    def to_house(self, side: str, s: float, out_m: float) -> tuple[float, float]:
        """The point s metres along a wall and `out_m` metres into the room."""
        x, y = self.corner(side)
        cos, sin = np.cos(YAW[side]), np.sin(YAW[side])
        return float(x + cos * s + sin * out_m), float(y + sin * s - cos * out_m)


@dataclass(frozen=True)
class Spot:
    """A chosen place: centre and yaw in house coordinates."""

    x_m: float
    y_m: float
    yaw_rad: float


class Placer:
    """Draws random places for pieces in one room until one is clear."""

    def __init__(self, room: Room, route_m: np.ndarray, clearance_m: float, rng: np.random.Generator) -> None:
        self.room = room
        self.rng = rng
        self.clearance_m = clearance_m
        near = (
            (route_m[:, 0] > room.x0 - 1.0)
            & (route_m[:, 0] < room.x1 + 1.0)
            & (route_m[:, 1] > room.y0 - 1.0)
            & (route_m[:, 1] < room.y1 + 1.0)
        )
        self.route_m = route_m[near]

    def at_wall(self, piece: Piece, *, tries: int = 60, sides: tuple[str, ...] = SIDES) -> Spot | None:
        """Somewhere with its back to a wall, or None."""
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
            spot = Spot(x, y, YAW[side])
            if self._floor_is_free(spot, piece):
                self._take(spot, piece)
                self.room.spans[side].append((s - piece.width_m / 2, s + piece.width_m / 2, piece.height_m))
                return spot
        return None

    def inside(self, piece: Piece, *, tries: int = 80, margin_m: float = 0.25) -> Spot | None:
        """Somewhere free in the room, turned by a multiple of 90 degrees, or None."""
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
            spot = Spot(float(x), float(y), yaw)
            if self._floor_is_free(spot, piece):
                self._take(spot, piece)
                return spot
        return None

    def at(self, spot: Spot, piece: Piece) -> bool:
        """Takes a given place if it is clear."""
        if not self._floor_is_free(spot, piece):
            return False
        self._take(spot, piece)
        return True

    def _wall_is_free(self, side: str, s: float, piece: Piece) -> bool:
        s0, s1 = s - piece.width_m / 2, s + piece.width_m / 2
        for hole in self.room.openings[side]:
            margin = 0.12 if hole.kind == "window" else 0.30
            if s1 > hole.s0 - margin and s0 < hole.s1 + margin and piece.height_m > hole.z0 - 0.05:
                return False
        return True

    def _floor_is_free(self, spot: Spot, piece: Piece) -> bool:
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

    def _take(self, spot: Spot, piece: Piece) -> None:
        self.room.taken.append((*_rectangle(spot, piece), piece.height_m))


def _rectangle(spot: Spot, piece: Piece) -> tuple[float, float, float, float]:
    half_x, half_y = piece.width_m / 2, piece.depth_m / 2
    if abs(np.sin(spot.yaw_rad)) > 0.5:
        half_x, half_y = half_y, half_x
    return spot.x_m - half_x, spot.y_m - half_y, spot.x_m + half_x, spot.y_m + half_y
