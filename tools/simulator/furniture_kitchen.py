"""Kitchen pieces; conventions as in `furniture`."""

from __future__ import annotations

import numpy as np

from beamsplat.tools.simulator.furniture import BLACK, FRONT, OAK, STEEL, FurniturePiece, fronts, vase
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.shapes import box, cylinder, lathe, rod


def kitchen_run(width: float) -> FurniturePiece:
    """Return base cabinets with worktop, sink, hob and oven, hanging cupboards, hood and tiles."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        top = Material("granite") if rng.random() < 0.5 else OAK
        depth, units = 0.58, max(3, round(width / 0.6))
        w = width / units
        box(b, (0, 0.03, 0.0), (width, depth - 0.08, 0.10), BLACK, skip=("bottom", "top"))
        box(b, (0, 0, 0.10), (width, depth, 0.76), FRONT, skip=("bottom", "top"))
        oven = int(rng.integers(1, units - 1))
        for k in range(units):
            at = b.placed(-width / 2 + (k + 0.5) * w, 0)
            if k == oven:
                _oven(at, w, depth)
            else:
                fronts(at, w, 0.74, -depth / 2, 0.11, 1, int(rng.choice([1, 1, 3])), FRONT)
        box(b, (0, -0.01, 0.86), (width + 0.02, depth + 0.04, 0.04), top)
        b.quad((-width / 2, depth / 2 - 0.002, 0.9), (width, 0, 0), (0, 0, 0.55), Material("splash"))
        hob = b.placed(-width / 2 + (oven + 0.5) * w, 0, 0.90)
        box(hob, (0, 0, 0), (w - 0.04, 0.48, 0.008), BLACK)
        lathe(hob, (-0.13, 0.08, 0.008), [(0.1, 0), (0.11, 0.13), (0.104, 0.13), (0.09, 0.02)], STEEL)
        box(b.placed(-width / 2 + (oven + 0.5) * w, 0), (0, 0.08, 1.55), (w, 0.42, 0.06), STEEL)
        box(b.placed(-width / 2 + (oven + 0.5) * w, 0), (0, 0.16, 1.6), (0.24, 0.24, 0.9), STEEL)
        sink = (oven + 2) % units
        basin = b.placed(-width / 2 + (sink + 0.5) * w, 0, 0.901)
        box(basin, (0, -0.02, 0), (w - 0.08, 0.4, 0.004), STEEL)
        rod(basin, (0, 0.2, 0), (0, 0.2, 0.28), 0.014, STEEL)
        rod(basin, (0, 0.2, 0.28), (0, 0.02, 0.25), 0.012, STEEL)
        for k in range(units):
            if k not in (oven, sink):
                cupboard = b.placed(-width / 2 + (k + 0.5) * w, 0.12, 1.45)
                box(cupboard, (0, 0, 0), (w, 0.33, 0.65), FRONT)
                fronts(cupboard, w, 0.65, -0.165, 0.0, 1, 1, FRONT)
            if k not in (oven, sink) and rng.random() < 0.8:
                _clutter(b.placed(-width / 2 + (k + 0.5) * w, 0.1, 0.9), rng)

    return FurniturePiece("kitchen_run", width, 0.64, 2.1, draw)


def _oven(b: MeshBuilder, width: float, depth: float) -> None:
    box(b, (0, -depth / 2 - 0.008, 0.11), (width - 0.01, 0.02, 0.74), STEEL, skip=("back",))
    box(b, (0, -depth / 2 - 0.02, 0.22), (width - 0.12, 0.006, 0.36), BLACK, skip=("back",))
    rod(b, (-width * 0.36, -depth / 2 - 0.045, 0.63), (width * 0.36, -depth / 2 - 0.045, 0.63), 0.009, STEEL)
    for k in range(4):
        x = (k - 1.5) * width * 0.2
        rod(b, (x, -depth / 2 - 0.018, 0.75), (x, -depth / 2 - 0.045, 0.75), 0.02, BLACK, sides=12)


def _clutter(b: MeshBuilder, rng: np.random.Generator) -> None:
    kind = rng.integers(4)
    if kind == 0:
        box(b, (0, 0.0, 0), (0.26, 0.18, 0.2), Material("steel", tint=(0.9, 0.3, 0.25)))
    elif kind == 1:
        for k in range(3):
            tint = tuple(rng.uniform(0.2, 0.9, 3).tolist())
            cylinder(b, (-0.14 + 0.13 * k, 0.02, 0), 0.05, 0.12 + 0.03 * k, Material("ceramic", tint=tint))
    elif kind == 2:
        box(b.tilted("x", -0.12), (0, 0.14, 0), (0.28, 0.02, 0.36), OAK)
        vase(b.placed(0.1, -0.02), rng, 0.22)
    else:
        b.placed(0, 0)
        lathe(b, (0, 0, 0), [(0.06, 0), (0.09, 0.08), (0.07, 0.18), (0.03, 0.2)], STEEL)


def fridge() -> FurniturePiece:
    """Return a fridge with two doors, handles and notes on the front."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        box(b, (0, 0.02, 0.04), (0.66, 0.62, 1.82), STEEL, turn=True)
        for z, h in ((0.06, 0.62), (0.70, 1.14)):
            box(b, (0, -0.30, z), (0.65, 0.03, h), STEEL, turn=True, skip=("back",))
            rod(b, (-0.26, -0.34, z + h * 0.25), (-0.26, -0.34, z + h * 0.75), 0.012, BLACK)
        for k in range(4):
            x, z = float(rng.uniform(-0.12, 0.2)), float(rng.uniform(0.9, 1.5))
            note = Material(f"painting_{int(rng.integers(14))}")
            b.quad((x, -0.317 - 0.001 * k, z), (0.13, 0, 0.01), (-0.01, 0, 0.16), note, fit=True)

    return FurniturePiece("fridge", 0.68, 0.68, 1.88, draw)
