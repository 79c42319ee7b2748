"""Furnishes each kind of room: furniture, radiators, wall decoration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator import furniture as f
from beamsplat.tools.simulator import furniture_kitchen as fk
from beamsplat.tools.simulator import furniture_rooms as fr
from beamsplat.tools.simulator import furniture_small as fs
from beamsplat.tools.simulator.furniture import FurniturePiece
from beamsplat.tools.simulator.mesh import Material, MeshBuilder, MeshPart
from beamsplat.tools.simulator.place import SIDES, YAW, FurniturePlacer, Placement, Room
from beamsplat.tools.simulator.shapes import box
from beamsplat.tools.simulator.walls import CEILING_M


@dataclass(frozen=True)
class PlacedPiece:
    """A piece of furniture in a home: its room, its placement, and its surfaces in the mesh builder."""

    room: Room
    piece: FurniturePiece
    spot: Placement
    part: MeshPart


def furnish(
    b: MeshBuilder, room: Room, route_m: np.ndarray, clearance_m: float, rng: np.random.Generator
) -> list[PlacedPiece]:
    """Draw the furniture, lamps, radiators and wall decoration of one room into `b`; return the furniture.

    A piece for which no free placement is found is not drawn. Furniture is at least `clearance_m` from the
    route [N, 2].
    """
    placer = FurniturePlacer(room, route_m, clearance_m, rng)
    {"living": _living, "kitchen": _kitchen, "bedroom": _bedroom, "study": _study}[room.name](b, placer, rng)
    for piece in (
        fs.plant(float(rng.uniform(0.9, 1.5))),
        fs.plant(float(rng.uniform(0.8, 1.2))),
        fs.floor_lamp(),
    ):
        _wall_piece(b, placer, piece, rng)
    centre = ((room.x0 + room.x1) / 2, (room.y0 + room.y1) / 2)
    fr.ceiling_lamp(b.placed(*centre, CEILING_M), 0.35)
    _radiators(b, room)
    _hang(b, room, rng)
    return [PlacedPiece(room, *drawn) for drawn in placer.drawn]


def draw_piece(
    b: MeshBuilder,
    placer: FurniturePlacer,
    piece: FurniturePiece,
    spot: Placement,
    rng: np.random.Generator,
) -> None:
    """Draw a piece at a placement that `placer` has found, and record it in `placer.drawn`."""
    before = b.part_from()
    piece.draw(b.placed(spot.x_m, spot.y_m, 0.0, spot.yaw_rad), rng)
    placer.drawn.append((piece, spot, b.part_from(before)))


def _wall_piece(
    b: MeshBuilder, placer: FurniturePlacer, piece: FurniturePiece, rng: np.random.Generator
) -> Placement | None:
    spot = placer.at_wall(piece)
    if spot is not None:
        draw_piece(b, placer, piece, spot, rng)
    return spot


def _inside_piece(
    b: MeshBuilder, placer: FurniturePlacer, piece: FurniturePiece, rng: np.random.Generator
) -> Placement | None:
    spot = placer.inside(piece)
    if spot is not None:
        draw_piece(b, placer, piece, spot, rng)
    return spot


def rug(b: MeshBuilder, name: str, x: float, y: float, yaw: float, width: float, depth: float) -> None:
    """Draw a carpet 8 mm thick with a bound rim, with the texture `name` and its centre at (x, y)."""
    at = b.placed(x, y, 0.0, yaw, edge_m=0.07)
    h = 0.008
    at.quad(
        (-width / 2, -depth / 2, h), (width, 0, 0), (0, depth, 0), Material(name), fit=name.startswith("rug")
    )
    rim = Material("cushion_b")
    box(at, (0, 0, 0.0), (width, depth, h), rim, skip=("top", "bottom"))


def _living(b: MeshBuilder, placer: FurniturePlacer, rng: np.random.Generator) -> None:
    sofa = next(
        (s for w in (2.3, 2.0, 1.7) for s in [_wall_piece(b, placer, f.sofa(w), rng)] if s is not None), None
    )
    for piece in (fr.fireplace(), f.sideboard(1.5, television=True), f.bookshelf(1.2, 2.0), f.armchair()):
        _wall_piece(b, placer, piece, rng)
    table = _inside_piece(b, placer, f.coffee_table(), rng)
    at = table or sofa
    if at is not None:
        room = placer.room
        x = float(np.clip(at.x_m, room.x0 + 1.3, room.x1 - 1.3))
        y = float(np.clip(at.y_m, room.y0 + 1.0, room.y1 - 1.0))
        rug(b, "rug_0", x, y, 0.0, 2.3, 1.6)
    for piece in (f.armchair(), fr.toy_box(), f.sideboard(1.1), f.bookshelf(0.8, 1.3), fr.stool()):
        _wall_piece(b, placer, piece, rng)


def _kitchen(b: MeshBuilder, placer: FurniturePlacer, rng: np.random.Generator) -> None:
    for width in (3.6, 3.0, 2.4, 1.8):
        if _wall_piece(b, placer, fk.kitchen_run(width), rng) is not None:
            break
    for piece in (fk.fridge(), fk.kitchen_run(1.8)):
        _wall_piece(b, placer, piece, rng)
    for width in (1.9, 1.5, 1.3):
        if _inside_piece(b, placer, fr.dining_set(width), rng) is not None:
            break
    for piece in (f.sideboard(1.2), fr.bench(1.1), f.bookshelf(0.8, 1.8), fr.stool(), fr.stool()):
        _wall_piece(b, placer, piece, rng)


def _bedroom(b: MeshBuilder, placer: FurniturePlacer, rng: np.random.Generator) -> None:
    for width in (1.6, 1.4, 0.95):
        spot = _wall_piece(b, placer, fr.bed(width), rng)
        if spot is not None:
            _beside(b, placer, spot, fr.bed(width), fr.nightstand(), rng)
            x = spot.x_m + np.sin(spot.yaw_rad) * 0.9
            y = spot.y_m - np.cos(spot.yaw_rad) * 0.9
            room = placer.room
            x, y = np.clip(x, room.x0 + 1.2, room.x1 - 1.2), np.clip(y, room.y0 + 1.2, room.y1 - 1.2)
            rug(b, "shag", float(x), float(y), spot.yaw_rad, 2.2, 1.4)
            break
    for piece in (fr.wardrobe(1.8), fr.wardrobe(1.2), fr.chest(1.0), f.armchair(), fr.bench(1.1)):
        _wall_piece(b, placer, piece, rng)
    for piece in (f.bookshelf(0.8, 1.5), fr.toy_box(), fr.stool()):
        _wall_piece(b, placer, piece, rng)


def _beside(
    b: MeshBuilder,
    placer: FurniturePlacer,
    spot: Placement,
    big: FurniturePiece,
    small: FurniturePiece,
    rng: np.random.Generator,
) -> None:
    """Draw small pieces left and right of a big one, with their backs aligned."""
    for side in (-1, 1):
        dx = side * (big.width_m / 2 + small.width_m / 2 + 0.06)
        dy = big.depth_m / 2 - small.depth_m / 2
        cos, sin = np.cos(spot.yaw_rad), np.sin(spot.yaw_rad)
        place = Placement(spot.x_m + cos * dx - sin * dy, spot.y_m + sin * dx + cos * dy, spot.yaw_rad)
        if placer.at(place, small):
            draw_piece(b, placer, small, place, rng)


def _study(b: MeshBuilder, placer: FurniturePlacer, rng: np.random.Generator) -> None:
    for width in (1.7, 1.4):
        if _wall_piece(b, placer, fr.desk(width), rng) is not None:
            break
    for piece in (f.bookshelf(1.6, 2.1), f.bookshelf(1.2, 2.1), f.sofa(1.7), f.armchair()):
        _wall_piece(b, placer, piece, rng)
    table = _inside_piece(b, placer, f.coffee_table(), rng)
    room = placer.room
    at = (table.x_m, table.y_m) if table else ((room.x0 + room.x1) / 2, (room.y0 + room.y1) / 2)
    x, y = np.clip(at[0], room.x0 + 1.3, room.x1 - 1.3), np.clip(at[1], room.y0 + 1.0, room.y1 - 1.0)
    rug(b, "rug_1", float(x), float(y), 0.0, 2.2, 1.5)
    for piece in (f.sideboard(1.3), f.bookshelf(0.9, 1.2), fr.chest(0.9), fr.toy_box(), fr.stool()):
        _wall_piece(b, placer, piece, rng)


def _radiators(b: MeshBuilder, room: Room) -> None:
    """Draw a radiator under each window that has no furniture in front of it."""
    for side in SIDES:
        for hole in room.openings[side]:
            busy = any(s1 > hole.s0 and s0 < hole.s1 for s0, s1, _ in room.spans[side])
            if hole.kind != "window" or busy:
                continue
            at = b.placed(*room.corner(side), 0.0, YAW[side])
            width = hole.s1 - hole.s0 - 0.2
            count = int(width / 0.07)
            for k in range(count):
                x = hole.s0 + 0.1 + (k + 0.5) * width / count
                box(at, (x, -0.09, 0.14), (0.05, 0.08, 0.52), f.LACQUER)
            middle = (hole.s0 + hole.s1) / 2
            box(at, (middle, -0.09, 0.2), (width, 0.03, 0.04), f.LACQUER)
            (xa, ya), (xb, yb) = room.to_house(side, hole.s0, 0.0), room.to_house(side, hole.s1, 0.13)
            room.taken.append((min(xa, xb), min(ya, yb), max(xa, xb), max(ya, yb), 0.66))


def _hang(b: MeshBuilder, room: Room, rng: np.random.Generator) -> None:
    """Hang framed paintings and a clock on the free parts of the walls."""
    clock = rng.random() < 0.7
    for side in SIDES:
        at = b.placed(*room.corner(side), 0.0, YAW[side])
        used: list[tuple[float, float]] = []
        for _ in range(7):
            portrait = rng.random() < 0.4
            width, height = float(rng.uniform(0.32, 0.9)), float(rng.uniform(0.35, 0.62))
            if portrait:
                width, height = height * 0.8, width * 0.95 + 0.15
            s = float(rng.uniform(width / 2 + 0.15, room.length(side) - width / 2 - 0.15))
            low = float(rng.uniform(0.75, 1.25))
            s0, s1 = s - width / 2, s + width / 2
            if any(s1 > a - 0.15 and s0 < c + 0.15 for a, c in used):
                continue
            if any(s1 > o.s0 - 0.42 and s0 < o.s1 + 0.42 for o in room.openings[side]):
                continue
            tall = [h for a, c, h in room.spans[side] if s1 > a - 0.05 and s0 < c + 0.05]
            low = max(low, max(tall, default=0.0) + 0.15)
            if low + height > CEILING_M - 0.15:
                continue
            used.append((s0, s1))
            spot = at.placed(s, -0.002, low)
            if clock:
                spot.quad((-0.16, -0.02, 0), (0.32, 0, 0), (0, 0, 0.32), Material("clock"), fit=True)
                box(spot, (0, -0.008, 0.0), (0.34, 0.02, 0.33), f.BLACK)
                clock = False
            else:
                kinds = [k for k in range(14) if (k % 6 in (4, 5)) == portrait]
                f.frame(spot, rng, width, height, int(rng.choice(kinds)))
