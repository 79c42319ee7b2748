"""Bedroom, study and kitchen pieces, tables and chairs; conventions as in `furniture`."""

from __future__ import annotations

import numpy as np

from beamsplat.tools.simulator.furniture import (
    BLACK,
    BULB,
    LACQUER,
    OAK,
    SHADE,
    STEEL,
    WALNUT,
    WARM,
    FurniturePiece,
    fronts,
    legs,
    stack,
    vase,
    wood,
)
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.shapes import box, cushion, cylinder, lathe, rod


def chair(b: MeshBuilder, rng: np.random.Generator, material: Material) -> None:
    """Draw a dining chair that faces -y, around the centre of its seat."""
    legs(b, 0.42, 0.42, 0.44, material, 0.035)
    box(b, (0, 0, 0.43), (0.44, 0.44, 0.025), material)
    cushion(b, (0, 0, 0.45), (0.42, 0.42, 0.05), Material("armchair"), power=0.25, squash=0.5, detail=10)
    for x in (-0.2, 0.2):
        rod(b, (x, 0.2, 0.44), (x * 0.95, 0.27, 0.92), 0.016, material)
    for z in (0.58, 0.70, 0.82):
        back = b.placed(0, 0.2 + (z - 0.44) * 0.15, z)
        box(back, (0, 0, 0), (0.38, 0.018, 0.065), material)


def dining_set(width: float) -> FurniturePiece:
    """Return a laid table with chairs around it; the footprint includes the chairs."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber, seat = wood(rng), wood(rng)
        box(b, (0, 0, 0.72), (width, 0.88, 0.035), timber)
        box(b, (0, 0, 0.64), (width - 0.2, 0.66, 0.08), timber, skip=("top", "bottom"))
        legs(b, width - 0.08, 0.80, 0.72, timber, 0.07)
        count = max(2, int(width / 0.62))
        for k in range(count):
            x = (k - (count - 1) / 2) * 0.62
            for side in (-1, 1):
                gap = 0.52 + float(rng.uniform(-0.03, 0.08))
                yaw = float(rng.normal(0, 0.12)) + (0.0 if side > 0 else np.pi)
                chair(b.placed(x, side * gap, 0, yaw), rng, seat)
        vase(b.placed(0.05, 0, 0.755), rng, 0.26)
        for _ in range(3):
            at = (float(rng.uniform(-0.4, 0.4) * width), float(rng.uniform(-0.25, 0.25)), 0.755)
            lathe(
                b,
                at,
                [(0.0, 0.0), (0.06, 0.0), (0.11, 0.015), (0.105, 0.02), (0.0, 0.008)],
                Material("ceramic"),
            )
            lathe(
                b, (at[0] + 0.15, at[1], at[2]), [(0.03, 0), (0.04, 0.09), (0.036, 0.09)], Material("ceramic")
            )

    return FurniturePiece("dining_set", width + 0.1, 1.75, 0.95, draw)


def bed(width: float) -> FurniturePiece:
    """Return a bed with head board, mattress, quilt and pillows."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber, length = wood(rng), 2.05
        box(b, (0, length / 2 - 0.03, 0.0), (width + 0.06, 0.06, 1.05), timber)
        box(b, (0, -0.02, 0.10), (width, length - 0.08, 0.20), timber)
        legs(b, width, length - 0.1, 0.10, timber, 0.07)
        cushion(
            b,
            (0, -0.02, 0.28),
            (width - 0.04, length - 0.1, 0.26),
            Material("sheet"),
            power=0.12,
            squash=0.25,
            detail=30,
        )
        cushion(
            b,
            (0, -0.30, 0.26),
            (width + 0.05, length - 0.66, 0.32),
            Material("quilt"),
            power=0.12,
            squash=0.22,
            detail=30,
        )
        for side in (-1, 1) if width > 1.2 else (0,):
            pillow = b.placed(side * width * 0.24, length / 2 - 0.33, 0.52, float(rng.normal(0, 0.08)))
            cushion(
                pillow.tilted("x", 0.25),
                (0, 0, 0),
                (0.62, 0.42, 0.17),
                Material("sheet"),
                power=0.4,
                squash=0.6,
            )
        cushion(
            b.placed(0.1, length / 2 - 0.55, 0.55).tilted("x", -0.6),
            (0, 0, 0),
            (0.4, 0.12, 0.38),
            Material("cushion_a"),
            power=0.4,
            squash=0.6,
        )

    return FurniturePiece("bed", width + 0.06, 2.08, 1.05, draw)


def nightstand() -> FurniturePiece:
    """Return a nightstand with drawers and a lamp."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber = wood(rng)
        legs(b, 0.42, 0.36, 0.12, timber, 0.035)
        box(b, (0, 0, 0.12), (0.45, 0.38, 0.38), timber)
        fronts(b, 0.45, 0.38, -0.19, 0.12, 1, 2, timber)
        table_lamp(b.placed(-0.05, 0.05, 0.5))
        stack(b.placed(0.1, -0.08, 0.5, 0.4), rng, 2)

    return FurniturePiece("nightstand", 0.46, 0.42, 0.95, draw)


def table_lamp(b: MeshBuilder) -> None:
    """Draw a small lit lampshade on a foot, and add its light."""
    lathe(
        b,
        (0, 0, 0),
        [(0.07, 0), (0.07, 0.015), (0.02, 0.05), (0.05, 0.13), (0.012, 0.22)],
        Material("ceramic"),
    )
    lathe(b, (0, 0, 0.2), [(0.13, 0.0), (0.09, 0.2)], SHADE, sides=20)
    b.lamp((0, 0, 0.3), 0.18, 0.35, WARM)


def wardrobe(width: float) -> FurniturePiece:
    """Return a tall wardrobe with panelled doors."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber = wood(rng)
        box(b, (0, 0, 0.0), (width - 0.02, 0.52, 0.08), timber)
        box(b, (0, 0, 0.08), (width, 0.56, 1.98), timber, turn=True)
        fronts(b, width, 1.96, -0.28, 0.09, max(2, round(width / 0.5)), 1, timber)

    return FurniturePiece("wardrobe", width, 0.62, 2.06, draw)


def chest(width: float) -> FurniturePiece:
    """Return a chest of drawers with a vase and a lamp on it."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber = wood(rng)
        legs(b, width - 0.06, 0.38, 0.1, timber)
        box(b, (0, 0, 0.10), (width, 0.44, 0.76), timber)
        fronts(b, width, 0.74, -0.22, 0.11, 2, 3, timber)
        vase(b.placed(-0.25, 0, 0.86), rng, 0.3)
        table_lamp(b.placed(0.25, 0.05, 0.86))

    return FurniturePiece("chest", width, 0.48, 1.25, draw)


def desk(width: float) -> FurniturePiece:
    """Return a desk with monitor, keyboard, books and lamp, and a swivel chair in front of it."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber = wood(rng)
        table = b.placed(0, 0.32)
        box(table, (0, 0, 0.715), (width, 0.68, 0.03), timber)
        legs(table, width - 0.06, 0.62, 0.715, STEEL, 0.04)
        box(table.placed(width / 2 - 0.25, 0), (0, 0, 0.12), (0.4, 0.58, 0.56), timber)
        fronts(table.placed(width / 2 - 0.25, 0), 0.4, 0.55, -0.29, 0.125, 1, 3, timber)
        box(table, (-0.1, 0.2, 0.745), (0.22, 0.18, 0.012), BLACK)
        box(table, (-0.1, 0.22, 0.75), (0.05, 0.04, 0.16), BLACK)
        box(table, (-0.1, 0.2, 0.86), (0.62, 0.035, 0.37), BLACK)
        glow = Material("screen", emission=0.9)
        table.quad((-0.40, 0.179, 0.875), (0.60, 0, 0), (0, 0, 0.34), glow, fit=True)
        box(table, (-0.1, -0.12, 0.745), (0.42, 0.14, 0.015), BLACK)
        stack(table.placed(width / 2 - 0.22, 0.1, 0.745, 0.3), rng, 4)
        table_lamp(table.placed(-width / 2 + 0.16, 0.18, 0.745))
        swivel_chair(b.placed(-0.1 + float(rng.normal(0, 0.06)), -0.36, 0, np.pi + float(rng.normal(0, 0.4))))

    return FurniturePiece("desk", width, 1.35, 1.25, draw)


def swivel_chair(b: MeshBuilder) -> None:
    """Draw a swivel chair that faces -y: five-star base, gas spring, leather seat."""
    leather = Material("leather")
    for k in range(5):
        a = k * 2 * np.pi / 5
        end = (0.28 * np.cos(a), 0.28 * np.sin(a), 0.07)
        rod(b, (0, 0, 0.11), end, 0.02, BLACK)
        cushion(b, (end[0], end[1], 0.0), (0.06, 0.06, 0.06), BLACK, power=1, squash=1, detail=6)
    rod(b, (0, 0, 0.1), (0, 0, 0.44), 0.025, STEEL)
    cushion(b, (0, 0, 0.43), (0.5, 0.5, 0.09), leather, power=0.4, squash=0.5)
    cushion(
        b.placed(0, 0.24, 0.52).tilted("x", -0.12),
        (0, 0, 0),
        (0.46, 0.09, 0.55),
        leather,
        power=0.4,
        squash=0.5,
    )
    for x in (-0.28, 0.28):
        rod(b, (x, 0.1, 0.48), (x, 0.08, 0.66), 0.014, BLACK)
        box(b, (x, 0.0, 0.66), (0.06, 0.26, 0.03), BLACK)


def bench(width: float) -> FurniturePiece:
    """Return a bench with a blanket on it and a basket under it."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber = wood(rng)
        box(b, (0, 0, 0.42), (width, 0.36, 0.04), timber)
        legs(b, width - 0.04, 0.34, 0.42, timber, 0.05)
        cushion(b, (-width * 0.2, 0, 0.45), (0.45, 0.34, 0.08), Material("cushion_b"), power=0.3, squash=0.5)
        tint = (0.75, 0.6, 0.4)
        lathe(
            b,
            (width * 0.2, 0, 0),
            [(0.0, 0.0), (0.14, 0), (0.16, 0.24), (0.15, 0.24)],
            Material("lampshade", tint),
        )

    return FurniturePiece("bench", width, 0.40, 0.55, draw)


def stool() -> FurniturePiece:
    """Return a stool with a round seat and three legs."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        timber = wood(rng)
        cylinder(b, (0, 0, 0.42), 0.17, 0.035, timber)
        for k in range(3):
            a = k * 2 * np.pi / 3
            rod(
                b,
                (0.17 * np.cos(a), 0.17 * np.sin(a), 0),
                (0.1 * np.cos(a), 0.1 * np.sin(a), 0.43),
                0.016,
                timber,
            )

    return FurniturePiece("stool", 0.40, 0.40, 0.46, draw)


def toy_box() -> FurniturePiece:
    """Return a crate with balls and blocks in it."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        for y in (-0.19, 0.19):
            box(b, (0, y, 0), (0.6, 0.015, 0.34), OAK)
        for x in (-0.3, 0.3):
            box(b, (x, 0, 0), (0.015, 0.38, 0.34), OAK)
        box(b, (0, 0, 0.01), (0.58, 0.36, 0.012), OAK)
        for _ in range(9):
            tint = tuple(rng.choice([0.05, 0.5, 0.8], 3).tolist())
            at = (
                float(rng.uniform(-0.22, 0.22)),
                float(rng.uniform(-0.12, 0.12)),
                float(rng.uniform(0.12, 0.26)),
            )
            size = float(rng.uniform(0.09, 0.16))
            power = 1.0 if rng.random() < 0.5 else 0.15
            material = Material("plain", tint=tint)
            cushion(b, at, (size, size, size), material, power=power, squash=power, detail=10)

    return FurniturePiece("toy_box", 0.62, 0.42, 0.42, draw)


def ceiling_lamp(b: MeshBuilder, drop: float) -> None:
    """Draw a lit pendant lamp that hangs from z = 0 on a cord of length `drop`, and add its light."""
    rod(b, (0, 0, 0), (0, 0, -drop), 0.006, BLACK, sides=5)
    lathe(b, (0, 0, -drop - 0.2), [(0.2, 0.0), (0.14, 0.14), (0.04, 0.2)], LACQUER, sides=24)
    lathe(b, (0, 0, -drop - 0.2), [(0.185, 0.005), (0.13, 0.135), (0.04, 0.19)][::-1], SHADE, sides=24)
    cushion(b, (0, 0, -drop - 0.15), (0.1, 0.1, 0.1), BULB, power=1, squash=1, detail=10)
    b.lamp((0, 0, -drop - 0.1), 0.23, 2.4, WARM * 0.5 + 0.5)


def fireplace() -> FurniturePiece:
    """Return a brick chimney breast with a mantel and an opening."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        stones = Material("brick") if rng.random() < 0.6 else Material("stonebrick")
        for x in (-0.55, 0.55):
            box(b, (x, 0, 0), (0.4, 0.42, 1.05), stones, skip=("bottom",))
        box(b, (0, 0, 0.72), (0.7, 0.42, 0.33), stones)
        box(b, (0, 0.17, 0), (0.7, 0.08, 0.72), BLACK)
        box(b, (0, 0, 0.0), (0.7, 0.4, 0.04), Material("granite"))
        box(b, (0, -0.02, 1.05), (1.65, 0.5, 0.07), WALNUT)
        box(b, (0, 0.06, 1.12), (1.2, 0.3, 1.3), stones)
        for k in range(5):
            y = float(rng.uniform(-0.08, 0.08))
            rod(
                b,
                (-0.2, y, 0.09 + 0.05 * (k % 3)),
                (0.2, y * -1, 0.1 + 0.05 * (k % 3)),
                0.035,
                Material("walnut"),
            )

    return FurniturePiece("fireplace", 1.66, 0.52, 2.42, draw)
