"""The shell of a room: walls with doorways and windows, floor, ceiling, skirting, curtains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.furniture import LACQUER, OAK, STEEL
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.place import SIDES, YAW, Room, WallOpening
from beamsplat.tools.simulator.shapes import box, curtain, rod

HALF_WALL_M = 0.06
CEILING_M = 2.55
DAYLIGHT = np.array([1.0, 1.04, 1.10])


@dataclass(frozen=True)
class RoomFinish:
    """Materials of a room's surfaces; `accent` is the material of the whole wall `accent_side`."""

    floor: Material
    wall: Material
    ceiling: Material
    accent: Material | None = None
    accent_side: str = "north"
    dado: Material | None = None  # lower part of all other walls
    beams: bool = False  # whether the ceiling has wooden beams
    trim: Material = LACQUER  # skirting boards and frames of doors and windows


def draw_shell(b: MeshBuilder, room: Room, finish: RoomFinish, rng: np.random.Generator) -> None:
    """Draw walls with doorways and windows, floor, ceiling and ceiling beams of a room."""
    width, depth = room.x1 - room.x0, room.y1 - room.y0
    b.quad(
        (room.x0, room.y0, 0.0), (width, 0, 0), (0, depth, 0), finish.floor, offset=(0.3, 0.1), edge_m=0.07
    )
    b.quad((room.x0, room.y1, CEILING_M), (width, 0, 0), (0, -depth, 0), finish.ceiling, edge_m=0.16)
    for side in SIDES:
        frame = b.placed(*room.corner(side), 0.0, YAW[side])
        accent = finish.accent is not None and side == finish.accent_side
        upper = finish.accent if accent and finish.accent else finish.wall
        lower = upper if accent or finish.dado is None else finish.dado
        _wall(frame, room.length(side), room.openings[side], upper, lower, finish, dado=not accent)
        for opening in room.openings[side]:
            if opening.kind == "door":
                _doorway(frame, opening, finish)
            else:
                _window(frame, opening, finish, rng)
    if finish.beams:
        count = max(3, int(width / 1.1))
        for k in range(count):
            x = room.x0 + (k + 0.5) * width / count
            box(b, (x, (room.y0 + room.y1) / 2, CEILING_M - 0.16), (0.13, depth, 0.16), OAK, skip=("top",))


def _wall(
    b: MeshBuilder,
    length: float,
    openings: list[WallOpening],
    upper: Material,
    lower: Material,
    finish: RoomFinish,
    *,
    dado: bool,
) -> None:
    split = 0.92 if dado and finish.dado is not None else 0.0
    cuts = [0.0]
    for opening in sorted(openings, key=lambda o: o.s0):
        cuts += [opening.s0, opening.s1]
    cuts.append(length)
    for k in range(len(cuts) - 1):
        s0, s1 = cuts[k], cuts[k + 1]
        hole = sorted(openings, key=lambda o: o.s0)[k // 2] if k % 2 else None
        spans = [(0.0, CEILING_M)] if hole is None else [(0.0, hole.z0), (hole.z1, CEILING_M)]
        for z0, z1 in spans:
            for low, high, material in ((z0, min(z1, split), lower), (max(z0, split), z1, upper)):
                if high - low > 1e-3:
                    # The offset follows the position on the wall, so the texture is continuous across a
                    # doorway.
                    size = b.texture_size_m[material.texture]
                    shift = (s0 / size[0], low / size[1])
                    b.quad((s0, 0, low), (s1 - s0, 0, 0), (0, 0, high - low), material, offset=shift)
        if hole is None or hole.z0 > 0.2:
            box(b, ((s0 + s1) / 2, -0.007, 0), (s1 - s0, 0.014, 0.09), finish.trim, skip=("bottom", "back"))
        if split and (hole is None or hole.z0 > split):
            box(b, ((s0 + s1) / 2, -0.011, split - 0.02), (s1 - s0, 0.022, 0.05), finish.trim, skip=("back",))


def _doorway(b: MeshBuilder, hole: WallOpening, finish: RoomFinish) -> None:
    width, t = hole.s1 - hole.s0, HALF_WALL_M
    b.quad((hole.s0, 0, 0), (0, t, 0), (0, 0, hole.z1), finish.trim)
    b.quad((hole.s1, t, 0), (0, -t, 0), (0, 0, hole.z1), finish.trim)
    b.quad((hole.s0, t, hole.z1), (width, 0, 0), (0, -t, 0), finish.trim)
    b.quad((hole.s0, 0, 0.0), (width, 0, 0), (0, t, 0), OAK)
    for s in (hole.s0 - 0.035, hole.s1 + 0.035):
        box(b, (s, -0.01, 0), (0.07, 0.02, hole.z1 + 0.07), finish.trim, skip=("back", "bottom"))
    box(b, ((hole.s0 + hole.s1) / 2, -0.01, hole.z1), (width, 0.02, 0.07), finish.trim, skip=("back",))


def _window(b: MeshBuilder, hole: WallOpening, finish: RoomFinish, rng: np.random.Generator) -> None:
    width, height, t = hole.s1 - hole.s0, hole.z1 - hole.z0, 0.14
    reveal = finish.wall if hole.kind == "window" else finish.trim
    b.quad((hole.s0, 0, hole.z0), (0, t, 0), (0, 0, height), reveal)
    b.quad((hole.s1, t, hole.z0), (0, -t, 0), (0, 0, height), reveal)
    b.quad((hole.s0, t, hole.z1), (width, 0, 0), (0, -t, 0), reveal)
    b.quad((hole.s0, 0, hole.z0), (width, 0, 0), (0, t, 0), finish.trim)
    glazed = hole.kind == "glass"
    view = Material(f"garden_{int(rng.integers(2))}", emission=2.2, glass=glazed)
    b.quad((hole.s0, t - 0.02, hole.z0), (width, 0, 0), (0, 0, height), view, fit=True, edge_m=0.5)
    origin = np.array([hole.s0, t - 0.06, hole.z0])
    b.window(origin, np.array([width, 0, 0]), np.array([0, 0, height]), 3.0 * DAYLIGHT)
    bar, middle = 0.05, (hole.s0 + hole.s1) / 2
    columns = 2 if width < 1.7 else 3
    for k in range(columns + 1):
        s = hole.s0 + bar / 2 + k * (width - bar) / columns
        box(b, (s, t - 0.04, hole.z0), (bar, 0.05, height), finish.trim, skip=("back",))
    rows = (hole.z0, hole.z0 + 0.62 * height, hole.z1 - bar)
    for z in rows if not glazed else (hole.z0, hole.z1 - bar):
        box(b, (middle, t - 0.04, z), (width, 0.05, bar), finish.trim, skip=("back",))
    if not glazed:
        box(b, (middle, 0.0, hole.z0 - 0.03), (width + 0.10, 0.16, 0.03), finish.trim)
    rod(b, (hole.s0 - 0.3, -0.14, hole.z1 + 0.16), (hole.s1 + 0.3, -0.14, hole.z1 + 0.16), 0.012, STEEL)
    # Furniture stands under windows, so only glazed doors have curtains down to the floor.
    low = 0.03 if glazed else hole.z0 - 0.15
    for left in (hole.s0 - 0.28, hole.s1 - 0.06):
        cloth = 0.34
        folds = float(rng.uniform(4.0, 6.0))
        curtain(b, (left, -0.14, low), cloth, hole.z1 + 0.15 - low, Material("curtain"), folds=folds)
        back = b.placed(left + cloth, -0.136, 0.0, np.pi)
        curtain(back, (0, 0, low), cloth, hole.z1 + 0.15 - low, Material("curtain"), folds=folds)
