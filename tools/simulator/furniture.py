"""Living room furniture and shared parts.

Conventions: lengths are metres, angles radians. A piece stands on z = 0, with the centre of its footprint at
the origin and its front towards -y. Functions draw into the mesh builder `b`, in its local frame. Random
details are drawn from the seeded generator `rng`, so that pieces differ between homes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.shapes import box, cushion, lathe, rod

Draw = Callable[[MeshBuilder, np.random.Generator], None]

OAK, WALNUT, BIRCH = Material("oak"), Material("walnut"), Material("birch")
LACQUER, FRONT, STEEL, BLACK = Material("lacquer"), Material("front"), Material("steel"), Material("black")
SHADE = Material("lampshade", emission=3.0)
WARM = np.array([1.0, 0.86, 0.66])
BULB = Material("plain", tint=(1.0, 0.93, 0.8), emission=6.0)


@dataclass(frozen=True)
class FurniturePiece:
    """A piece of furniture: width along x, depth along y, height, and the function that draws the piece."""

    name: str
    width_m: float
    depth_m: float
    height_m: float
    draw: Draw


def wood(rng: np.random.Generator) -> Material:
    """Return a random wood material."""
    return (OAK, WALNUT, BIRCH, LACQUER)[int(rng.choice(4, p=[0.4, 0.25, 0.2, 0.15]))]


def legs(
    b: MeshBuilder, width: float, depth: float, height: float, material: Material, thick: float = 0.045
) -> None:
    """Draw four square legs from z = 0 to `height` under the corners of a table top of `width` x `depth`."""
    for x in (-1, 1):
        for y in (-1, 1):
            at = (x * (width - thick) / 2, y * (depth - thick) / 2, 0.0)
            box(b, at, (thick, thick, height), material, skip=("bottom",), turn=True)


def sofa(width: float) -> FurniturePiece:
    """Return an upholstered sofa on short feet with seat and back cushions and two pillows."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        cloth = Material("sofa")
        legs(b.placed(0, 0), width - 0.1, 0.75, 0.10, WALNUT, 0.05)
        cushion(b, (0, 0.02, 0.09), (width, 0.86, 0.24), cloth, power=0.15, squash=0.3, detail=26)
        cushion(b, (0, 0.34, 0.20), (width - 0.1, 0.24, 0.62), cloth, power=0.2, squash=0.3, detail=26)
        for side in (-1, 1):
            at = (side * (width / 2 - 0.10), 0.0, 0.12)
            cushion(b, at, (0.2, 0.88, 0.48), cloth, power=0.2, squash=0.35)
        seats = max(2, round((width - 0.4) / 0.62))
        pitch = (width - 0.42) / seats
        for k in range(seats):
            x = (k - (seats - 1) / 2) * pitch
            cushion(b, (x, -0.09, 0.30), (pitch - 0.01, 0.66, 0.17), cloth, power=0.22, squash=0.4)
            tilted = b.placed(x, 0.20, 0.44).tilted("x", -0.2)
            cushion(tilted, (0, 0, 0), (pitch - 0.02, 0.17, 0.42), cloth, power=0.3, squash=0.45)
        for k, side in enumerate((-1, 1)):
            material = Material(("cushion_a", "cushion_b")[k])
            pillow = b.placed(side * (width / 2 - 0.42), -0.02, 0.50, side * 0.25).tilted("x", -0.35)
            cushion(pillow, (0, 0, 0), (0.42, 0.16, 0.40), material, power=0.4, squash=0.6)

    return FurniturePiece("sofa", width, 0.90, 0.85, draw)


def armchair() -> FurniturePiece:
    """Return a round-backed armchair."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        cloth = Material("armchair")
        for x in (-0.27, 0.27):
            for y in (-0.27, 0.27):
                rod(b, (x, y, 0.0), (x * 0.85, y * 0.85, 0.2), 0.02, WALNUT)
        cushion(b, (0, 0, 0.17), (0.74, 0.74, 0.26), cloth, power=0.3, squash=0.4)
        cushion(
            b.placed(0, 0.27, 0.3).tilted("x", -0.2),
            (0, 0, 0),
            (0.7, 0.2, 0.58),
            cloth,
            power=0.4,
            squash=0.45,
        )
        for side in (-1, 1):
            cushion(b, (side * 0.33, 0.0, 0.25), (0.14, 0.68, 0.34), cloth, power=0.3, squash=0.45)

    return FurniturePiece("armchair", 0.82, 0.80, 0.85, draw)


def coffee_table() -> FurniturePiece:
    """Return a low table with a shelf, magazines and a bowl."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        top = wood(rng)
        box(b, (0, 0, 0.38), (1.05, 0.58, 0.035), top)
        box(b, (0, 0, 0.14), (0.95, 0.5, 0.02), top)
        legs(b, 1.0, 0.54, 0.38, top)
        stack(b.placed(-0.25, 0.05, 0.415, 0.3), rng, 3)
        lathe(
            b,
            (0.22, 0.0, 0.415),
            [(0.05, 0.0), (0.12, 0.05), (0.14, 0.08), (0.13, 0.08)],
            Material("ceramic"),
        )
        for k in range(3):
            cushion(
                b,
                (0.22 + 0.05 * np.cos(k * 2.1), 0.05 * np.sin(k * 2.1), 0.44),
                (0.08, 0.08, 0.08),
                Material("plain", tint=((0.7, 0.1, 0.05), (0.75, 0.5, 0.05), (0.3, 0.5, 0.06))[k]),
                power=1.0,
                squash=1.0,
                detail=8,
            )

    return FurniturePiece("coffee_table", 1.05, 0.60, 0.45, draw)


def stack(b: MeshBuilder, rng: np.random.Generator, count: int) -> None:
    """Draw a stack of `count` lying books."""
    z = 0.0
    for _ in range(count):
        thick, k = float(rng.uniform(0.015, 0.035)), int(rng.integers(64))
        colour = tuple(rng.uniform(0.05, 0.6, 3).tolist())
        turned = b.placed(0, 0, z, float(rng.normal(0, 0.15)))
        book(turned, k, 0.22, 0.16, thick, colour)
        z += thick


def book(
    b: MeshBuilder, k: int, width: float, depth: float, height: float, colour: tuple[float, ...]
) -> None:
    """Draw a book: a box in the linear RGB `colour` whose front shows spine `k` of the texture `books`."""
    cover = Material("plain", tint=(colour[0], colour[1], colour[2]))
    box(b, (0, 0, 0), (width, depth, height), cover, skip=("front",))
    spine(b, k, (-width / 2, -depth / 2, 0), (width, 0, 0), (0, 0, height))


def spine(
    b: MeshBuilder, k: int, origin: tuple[float, ...], right: tuple[float, ...], up: tuple[float, ...]
) -> None:
    """Draw the rectangle of one book spine, with number `k` modulo 64 of the spines in the texture `books`.

    `origin` is the lower left corner, `right` and `up` are the edges from this corner.
    """
    vertices = np.array(
        [origin, np.add(origin, right), np.add(np.add(origin, right), up), np.add(origin, up)]
    )
    normal = np.cross(right, up) / np.linalg.norm(np.cross(right, up))
    u0, u1 = (k % 64 + 0.02) / 64, (k % 64 + 0.98) / 64
    # Standing books are taller than wide; on lying ones the spine is rotated by 90 degrees.
    upright = np.linalg.norm(up) > np.linalg.norm(right)
    uvs = [(u0, 0), (u1, 0), (u1, 1), (u0, 1)] if upright else [(u0, 1), (u0, 0), (u1, 0), (u1, 1)]
    b.add(
        vertices,
        np.broadcast_to(normal, (4, 3)),
        np.array(uvs, dtype=float),
        np.array([[0, 1, 2], [0, 2, 3]]),
        Material("books"),
        vertices + 0.01 * normal,
    )


def bookshelf(width: float, height: float) -> FurniturePiece:
    """Return a bookshelf with rows of standing books, gaps and ornaments."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber, depth, board = wood(rng), 0.30, 0.022
        for side in (-1, 1):
            box(b, (side * (width - board) / 2, 0, 0), (board, depth, height), timber, turn=True)
        box(b, (0, depth / 2 - 0.008, 0.05), (width - board, 0.012, height - 0.06), timber, turn=True)
        shelves = max(2, round(height / 0.36))
        pitch = (height - 0.08 - board) / shelves
        for k in range(shelves + 1):
            box(b, (0, 0, 0.06 + k * pitch), (width - 2 * board, depth, board), timber)
        box(b, (0, -depth / 2 + 0.03, 0), (width - 2 * board, 0.02, 0.06), timber)
        for k in range(shelves):
            row = b.placed(0, 0, 0.06 + k * pitch + board)
            _books(row, rng, width - 2 * board - 0.02, pitch - board - 0.03, depth)

    return FurniturePiece("bookshelf", width, 0.32, height, draw)


def _books(b: MeshBuilder, rng: np.random.Generator, width: float, height: float, depth: float) -> None:
    x = -width / 2
    while x < width / 2 - 0.06:
        run = float(rng.uniform(0.15, 0.5))
        kind = rng.random()
        if kind < 0.74:
            end = min(x + run, width / 2 - 0.03)
            while x < end:
                thick = float(rng.uniform(0.018, 0.05))
                tall = float(height * rng.uniform(0.72, 0.98))
                deep = float(depth * rng.uniform(0.6, 0.8))
                colour = tuple(rng.uniform(0.03, 0.4, 3).tolist())
                y = -depth / 2 + 0.03 + deep / 2 + float(rng.uniform(0, 0.02))
                book(b.placed(x + thick / 2, y), int(rng.integers(64)), thick * 0.96, deep, tall, colour)
                x += thick
        elif kind < 0.86:
            stack(b.placed(min(x + 0.13, width / 2 - 0.13), -0.02), rng, int(rng.integers(2, 5)))
            x += 0.28
        else:
            vase(b.placed(min(x + 0.08, width / 2 - 0.08), -0.03), rng, height * 0.8)
            x += 0.2
        x += float(rng.uniform(0.0, 0.08))


def vase(b: MeshBuilder, rng: np.random.Generator, height: float) -> None:
    """Draw a vase of random shape and colour, `height` metres tall."""
    r = height * rng.uniform(0.16, 0.26)
    profile = [(0.55, 0.0), (0.9, 0.2), (1.0, 0.42), (0.75, 0.68), (0.38, 0.85), (0.45, 1.0)]
    tint = tuple(rng.uniform(0.15, 0.9, 3).tolist())
    lathe(b, (0, 0, 0), [(a * r, z * height) for a, z in profile], Material("ceramic", tint=tint), sides=14)


def sideboard(width: float, *, television: bool = False) -> FurniturePiece:
    """Return a low cabinet with doors; a television or ornaments stand on it."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber, height, depth = wood(rng), 0.52, 0.40
        legs(b, width - 0.1, depth - 0.06, 0.12, BLACK, 0.03)
        box(b, (0, 0, 0.12), (width, depth, height - 0.12), timber)
        fronts(b, width, height - 0.12, -depth / 2, 0.12, max(2, round(width / 0.45)), 1, timber)
        if television:
            box(b, (0, 0.03, height), (0.4, 0.2, 0.015), BLACK)
            box(b, (0, 0.05, height + 0.01), (0.06, 0.03, 0.08), BLACK)
            dark = Material("screen", tint=(0.55, 0.55, 0.6), emission=0.5)
            box(b, (0, 0.04, height + 0.07), (1.12, 0.045, 0.65), BLACK)
            b.quad((-0.535, 0.0165, height + 0.09), (1.07, 0, 0), (0, 0, 0.61), dark, fit=True)
        else:
            vase(b.placed(-width * 0.3, 0, height), rng, 0.32)
            stack(b.placed(width * 0.28, 0, height, 0.2), rng, 4)
            frame(b.placed(0.02, 0.05, height).tilted("x", -0.15), rng, 0.22, 0.28)

    return FurniturePiece("sideboard", width, 0.42, 1.25 if television else 0.85, draw)


def fronts(
    b: MeshBuilder,
    width: float,
    height: float,
    y: float,
    z: float,
    columns: int,
    rows: int,
    material: Material,
) -> None:
    """Draw a grid of `columns` x `rows` cabinet doors or drawers: raised panels with handles.

    The grid is `width` x `height`, centred at x = 0, in the vertical plane at `y`; its lower edge is at `z`.
    """
    gap, w, h = 0.006, width / columns, height / rows
    for i in range(columns):
        for j in range(rows):
            x = -width / 2 + (i + 0.5) * w
            at = (x, y - 0.008, z + j * h + gap / 2)
            box(b, at, (w - gap, 0.018, h - gap), material, skip=("back",), turn=h > w)
            inner = (x, y - 0.019, z + j * h + 0.05)
            if w > 0.25 and h > 0.25:
                box(b, inner, (w - 0.1, 0.006, h - 0.1), material, skip=("back",), turn=h > w)
            handle_z = z + j * h + h * (0.5 if h < 0.3 else 0.85)
            rod(b, (x - 0.05, y - 0.035, handle_z), (x + 0.05, y - 0.035, handle_z), 0.006, STEEL, sides=6)


def frame(
    b: MeshBuilder, rng: np.random.Generator, width: float, height: float, number: int | None = None
) -> None:
    """Draw a framed painting in the local xz plane with its back at y = 0; `number` selects the painting."""
    from beamsplat.tools.simulator.palette import PAINTINGS

    k = int(rng.integers(PAINTINGS)) if number is None else number
    rim, bar = (OAK, WALNUT, BLACK, LACQUER)[int(rng.integers(4))], 0.028
    for z in (0.0, height - bar):
        box(b, (0, -0.012, z), (width, 0.024, bar), rim)
    for side in (-1, 1):
        box(b, (side * (width - bar) / 2, -0.012, bar), (bar, 0.024, height - 2 * bar), rim, turn=True)
    mat = min(0.05, width * 0.09)
    w, h = width - 2 * bar, height - 2 * bar
    b.quad((-w / 2, -0.008, bar), (w, 0, 0), (0, 0, h), Material("plain", tint=(0.86, 0.84, 0.8)))
    at = (-w / 2 + mat, -0.0095, bar + mat)
    b.quad(at, (w - 2 * mat, 0, 0), (0, 0, h - 2 * mat), Material(f"painting_{k}"), fit=True)
