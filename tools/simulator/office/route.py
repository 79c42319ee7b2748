"""The robot's route over an office floor: a closed walk on the grid of corridors with visits of rooms."""

from __future__ import annotations

from collections import deque

import numpy as np

from beamsplat.tools.simulator.office.floor import FloorPlan
from beamsplat.tools.simulator.office.rooms import OfficeRoom
from beamsplat.tools.simulator.office.settings import OfficeSettings
from beamsplat.tools.simulator.path import DrivePath, resample_closed

Crossing = tuple[int, int]  # of corridor i along y and corridor j along x
VISIT_NEW, VISIT_AGAIN = 0.15, 0.05  # share of open rooms that are visited in the first and in later passes
SMOOTH_M = 1.4  # length of the window that rounds corners
STEP_M = 0.05
START_M = 4.0


def plan_route(floor: FloorPlan, settings: OfficeSettings) -> DrivePath:
    """Return a closed drive of about `settings.distance_m` plus the way back to the start.

    The walk prefers corridors that it has not seen, straight ahead first: so it starts with loops around
    large parts of the floor.
    """
    rng = np.random.default_rng([settings.seed, 0x0F2])
    walk = _Walk(floor, rng)
    first = walk.choose()
    walk.go(first)
    while walk.length_m < settings.distance_m or walk.at == walk.start:
        walk.go(walk.choose())
    # The last lap joins the first without a U-turn.
    for crossing in walk.way_to(walk.start, not_from=first):
        walk.go(crossing)
    return DrivePath(_smooth(np.array(walk.points)), settings.limits)


class _Walk:
    """A walk from crossing to crossing, as way points on the floor."""

    def __init__(self, floor: FloorPlan, rng: np.random.Generator) -> None:
        self._floor, self._rng = floor, rng
        self._shape = (len(floor.corridor_x_m), len(floor.corridor_y_m))
        self.start: Crossing = (0, 0)
        self.at, self._before = self.start, self.start
        self._seen: set[frozenset[Crossing]] = set()
        self._visits = _rooms_by_edge(floor)
        self._plan: deque[Crossing] = deque()
        self.points: list[np.ndarray] = [self._position(self.start)]
        self.length_m = 0.0

    def _position(self, c: Crossing) -> np.ndarray:
        return np.array([self._floor.corridor_x_m[c[0]], self._floor.corridor_y_m[c[1]]])

    def _neighbours(self, c: Crossing) -> list[Crossing]:
        i, j = c
        near = ((i + 1, j), (i, j + 1), (i - 1, j), (i, j - 1))
        return [n for n in near if 0 <= n[0] < self._shape[0] and 0 <= n[1] < self._shape[1]]

    def choose(self) -> Crossing:
        """Return the next crossing: unseen and straight, unseen, else along the way to the nearest unseen."""
        if self._plan:
            return self._plan.popleft()
        at, before = self.at, self._before
        ahead = (2 * at[0] - before[0], 2 * at[1] - before[1])
        unseen = [n for n in self._neighbours(at) if frozenset((at, n)) not in self._seen]
        if unseen:
            return ahead if ahead in unseen else unseen[int(self._rng.integers(len(unseen)))]
        open_ends = [c for c in self._crossings() if self._has_unseen(c)] or [
            c for c in self._crossings() if c != at
        ]
        if len(open_ends) and self._has_unseen(open_ends[0]):
            distance = [len(self.way_to(c)) for c in open_ends]
            target = open_ends[int(np.argmin(distance))]
        else:
            target = open_ends[int(self._rng.integers(len(open_ends)))]
        self._plan.extend(self.way_to(target))
        return self._plan.popleft()

    def _crossings(self) -> list[Crossing]:
        return [(i, j) for i in range(self._shape[0]) for j in range(self._shape[1])]

    def _has_unseen(self, c: Crossing) -> bool:
        return any(frozenset((c, n)) not in self._seen for n in self._neighbours(c))

    def way_to(self, target: Crossing, not_from: Crossing | None = None) -> list[Crossing]:
        """Return the crossings of a shortest way from here, without a U-turn at its start where possible.

        The way does not reach its target from `not_from`.
        """
        for avoid in (self._before, None):
            came: dict[Crossing, Crossing] = {self.at: self.at}
            queue = deque([self.at])
            while queue and target not in came:
                c = queue.popleft()
                for n in self._neighbours(c):
                    barred = (c == self.at and n == avoid) or (n == target and c == not_from)
                    if n not in came and not barred:
                        came[n] = c
                        queue.append(n)
            if target in came:
                break
        way: list[Crossing] = []
        while target != self.at:
            way.append(target)
            target = came[target]
        return way[::-1]

    def go(self, to: Crossing) -> None:
        """Drive to a neighbouring crossing, with visits of rooms on the way."""
        edge = frozenset((self.at, to))
        chance = VISIT_AGAIN if edge in self._seen else VISIT_NEW
        a, b = self._position(self.at), self._position(to)
        direction = (b - a) / np.linalg.norm(b - a)
        along_x = self.at[1] == to[1]
        width = self._floor.width_y_m[to[1]] if along_x else self._floor.width_x_m[to[0]]
        lane = np.array([-direction[1], direction[0]]) * self._rng.uniform(-1.0, 1.0) * (width / 2.0 - 0.8)
        way = [a + 2.0 * direction + lane]
        visits = [r for r in self._visits.get(edge, []) if self._rng.random() < chance]
        visits.sort(key=lambda r: float((_door(r) - a) @ direction))
        for room in visits:
            door = _door(room)
            foot = a + ((door - a) @ direction) * direction + lane
            way += [foot, *room.visit(), foot]
        way += [b - 2.0 * direction + lane, b]
        for point in way:
            self.length_m += float(np.linalg.norm(point - self.points[-1]))
            self.points.append(point)
        self._seen.add(edge)
        self._before, self.at = self.at, to


def _door(room: OfficeRoom) -> np.ndarray:
    return room.to_floor(np.array([room.door_u_m, 0.0]))


def _rooms_by_edge(floor: FloorPlan) -> dict[frozenset[Crossing], list[OfficeRoom]]:
    """Return the rooms whose doors are at each piece of corridor between two crossings."""
    found: dict[frozenset[Crossing], list[OfficeRoom]] = {}
    for room in floor.rooms:
        x, y = _door(room)
        i, j = int(np.searchsorted(floor.corridor_x_m, x)), int(np.searchsorted(floor.corridor_y_m, y))
        if abs(np.sin(room.yaw_rad)) < 0.5:  # at a corridor along x
            j = int(np.argmin(np.abs(floor.corridor_y_m - y)))
            edge = frozenset(((i - 1, j), (i, j)))
        else:
            i = int(np.argmin(np.abs(floor.corridor_x_m - x)))
            edge = frozenset(((i, j - 1), (i, j)))
        found.setdefault(edge, []).append(room)
    return found


def _smooth(points_m: np.ndarray) -> np.ndarray:
    """Return a closed curve [N, 2], a point each 0.2 m, that rounds the corners of a closed polyline.

    It begins START_M after the first point, so that the robot starts on a straight.
    """
    keep = np.concatenate([[True], np.linalg.norm(np.diff(points_m, axis=0), axis=1) > 1e-6])
    dense = resample_closed(points_m[keep][:-1], STEP_M)
    window = np.hanning((int(SMOOTH_M / STEP_M) | 1) + 2)[1:-1]
    half = len(window) // 2
    padded = np.concatenate([dense[-half:], dense, dense[:half]])
    smooth = np.stack([np.convolve(padded[:, k], window / window.sum(), "valid") for k in range(2)], axis=1)
    smooth = np.roll(smooth, -round(START_M / STEP_M), axis=0)
    return smooth[: len(smooth) // 4 * 4 : 4]
