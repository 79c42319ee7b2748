"""All textures of a home, chosen and generated from a seed."""

from __future__ import annotations

import numpy as np

from beamsplat.tools.simulator import art
from beamsplat.tools.simulator import textures as tx
from beamsplat.tools.simulator.textures import rgb

Textures = dict[str, tuple[np.ndarray, tuple[float, float]]]  # name: sRGB [H, W, 3], metres (w, h)

PAINTINGS = 14
WALLS = ("wall_a", "wall_b", "wall_c", "wall_d")
FLOORS = ("floor_a", "floor_b", "floor_c", "floor_d")


def home_textures(rng: np.random.Generator) -> Textures:
    """Return all textures of a home, by the names that the materials of furniture and rooms refer to."""
    return {**_surfaces(rng), **_floors_and_walls(rng), **_cloths(rng), **_artworks(rng)}


def _pick(rng: np.random.Generator, colours: str) -> np.ndarray:
    return rgb(str(rng.choice(colours.split())))


def _surfaces(rng: np.random.Generator) -> Textures:
    furniture = _pick(rng, "b98a57 a9773f c79a6b 8d6238")
    dark = _pick(rng, "5a3a24 4a3226 6b4429")
    front = _pick(rng, "e9e6df dfe3e2 6f8791 8fa08a 37474f")
    return {
        "plain": (tx.flat(rng, rgb("ffffff"), depth=0.006), (0.5, 0.5)),
        "oak": (tx.veneer(rng, furniture), (0.9, 0.6)),
        "walnut": (tx.veneer(rng, dark, contrast=1.2), (0.9, 0.6)),
        "birch": (tx.veneer(rng, rgb("dcc49c"), contrast=0.6), (0.9, 0.6)),
        "lacquer": (tx.plaster(rng, rgb("efece6"), depth=0.25), (0.8, 0.8)),
        "front": (tx.plaster(rng, front, depth=0.4), (0.9, 0.9)),
        "steel": (tx.brushed(rng, rgb("b9bcc0")), (0.5, 0.5)),
        "black": (tx.flat(rng, rgb("26272a"), depth=0.05), (0.4, 0.4)),
        "ceramic": (tx.flat(rng, rgb("e8e4dc"), depth=0.02), (0.4, 0.4)),
        "terracotta": (tx.plaster(rng, rgb("b4694a"), depth=2.0), (0.4, 0.4)),
        "soil": (tx.shag(rng, rgb("3b2c20"), 128), (0.3, 0.3)),
        "leaf": (art.foliage(rng), (1.0, 1.0)),
        "marble": (tx.stone(rng, rgb("e9e7e3"), rgb("8c8d92")), (1.3, 1.3)),
        "granite": (
            tx.terrazzo(rng, rgb("55565a"), [rgb("2b2c2f"), rgb("8d8e90"), rgb("b3a9a0")]),
            (0.7, 0.7),
        ),
        "stonebrick": (tx.brick(rng, rgb("a3988a"), rgb("c9c3b6")), (1.2, 1.2)),
        "lampshade": (tx.weave(rng, rgb("f3e6c8"), strength=0.08), (0.12, 0.12)),
    }


def _floors_and_walls(rng: np.random.Generator) -> Textures:
    boards = _pick(rng, "c9a878 b48a5c d6bd97 a67c52")
    dark = _pick(rng, "8a5f3c 7a5436 9a7148")
    tile = [_pick(rng, "d9d4c8 cfd4d6 c9b9a3") * f for f in (1.0, 0.97, 1.03)]
    grout = rgb("a8a39a")
    floors = [
        (tx.planks(rng, boards), (2.4, 2.4)),
        (tx.tiles(rng, tile, grout, size_px=1024, count=4, grout_px=5, mottle=0.025), (1.8, 1.8)),
        (tx.herringbone(rng, dark), (2.4, 2.4)),
        (tx.planks(rng, _pick(rng, "d8c7ab bfa27c a98f73"), boards=18, contrast=0.8), (2.4, 2.4)),
    ]
    paint = ["e9e4d8", "dfe5e6", "e3dccb", "d5dcd2", "e8dfe0", "cfd9df"]
    tones = [rgb(c) for c in rng.choice(paint, 4, replace=False)]
    accent = _pick(rng, "7f98a3 97a58b b58d74 8d86a0")
    walls = [
        (tx.plaster(rng, tones[0]), (1.6, 1.6)),
        (tx.plaster(rng, tones[1], depth=1.4), (1.6, 1.6)),
        (tx.stripes(rng, tones[2], tones[2] * 0.9 + accent * 0.1), (1.0, 1.0)),
        (tx.plaster(rng, tones[3], depth=0.8), (1.6, 1.6)),
    ]
    return {
        **{name: floors[i] for i, name in enumerate(FLOORS)},
        **{name: walls[i] for i, name in enumerate(WALLS)},
        "damask": (tx.damask(rng, accent * 1.1, accent * 0.72 + 0.25), (0.8, 0.8)),
        "brick": (tx.brick(rng, _pick(rng, "9c5a44 a4614a 8a5a4a"), rgb("b9b0a4")), (1.2, 1.2)),
        "ceiling": (tx.plaster(rng, rgb("f1efe9"), depth=0.6), (1.5, 1.5)),
        "panelling": (tx.planks(rng, _pick(rng, "c08a4a d3a566 e2d9c8"), boards=16, gap=0.7), (1.9, 1.9)),
        "splash": (
            tx.tiles(
                rng,
                [_pick(rng, "e6ebe9 9fb8b6 d9c7a8") * f for f in (1.0, 0.95, 1.05)],
                rgb("c9c9c4"),
                count=4,
                rows=8,
                grout_px=3,
                pattern="brick",
                mottle=0.05,
            ),
            (0.8, 0.8),
        ),
        "checker": (
            tx.tiles(
                rng, [rgb("dcd9d2"), _pick(rng, "4a4f55 6b4f43 41565a")], grout, count=4, pattern="checker"
            ),
            (1.2, 1.2),
        ),
        "paving": (tx.tiles(rng, [rgb("9d978c"), rgb("a8a296")], rgb("77736a"), count=3), (1.5, 1.5)),
    }


def _cloths(rng: np.random.Generator) -> Textures:
    sofa = _pick(rng, "4f6475 7b7468 8a4f3d 5c6b4f b39a7a")
    chair = _pick(rng, "a8452f 2f4a6d c08a2e 556b4a")
    bed = [_pick(rng, "e6e2da d5dbe0"), _pick(rng, "33506b 7d4a4a 55705d")]
    return {
        "sofa": (tx.weave(rng, sofa), (0.10, 0.10)),
        "armchair": (tx.weave(rng, chair, melange=0.08), (0.10, 0.10)),
        "sheet": (tx.weave(rng, bed[0], strength=0.06), (0.10, 0.10)),
        "quilt": (tx.plaid(rng, [bed[1], bed[0], bed[1] * 0.6, rgb("c9b48c")]), (0.5, 0.5)),
        "cushion_a": (tx.dots(rng, _pick(rng, "c9a227 b5533c 3f6f73"), rgb("efe9da")), (0.22, 0.22)),
        "cushion_b": (tx.plaid(rng, [rgb("d8cfc0"), rgb("8b3a3a"), rgb("2e4057")]), (0.3, 0.3)),
        "curtain": (tx.weave(rng, _pick(rng, "cfc4b0 8fa1a8 a8997f b7a6a0"), strength=0.1), (0.08, 0.08)),
        "shag": (tx.shag(rng, _pick(rng, "b8ab98 8d8780 74808a")), (0.9, 0.9)),
        "leather": (tx.plaster(rng, _pick(rng, "3a2a22 5b3826 2b2b2e"), depth=2.0), (0.5, 0.5)),
        "towel": (tx.stripes(rng, rgb("e8e4da"), _pick(rng, "4a7a8c b5533c 6b8f5a")), (0.4, 0.4)),
    }


def _artworks(rng: np.random.Generator) -> Textures:
    out: Textures = {}
    for k in range(PAINTINGS):
        painter = art.PAINTINGS[k % len(art.PAINTINGS)]
        height, width = (384, 288) if painter in (art.portrait, art.lettering) else (288, 384)
        out[f"painting_{k}"] = (painter(rng, height, width), (1.0, 1.0))
    for k in range(2):
        out[f"rug_{k}"] = (art.persian_rug(rng), (1.0, 1.0))
        out[f"garden_{k}"] = (art.garden_view(rng), (1.0, 1.0))
    out["books"] = (art.book_spines(rng, count=64, width=2048), (1.0, 1.0))
    out["screen"] = (art.screen(rng, 256, 448), (1.0, 1.0))
    out["clock"] = (art.clock_face(), (1.0, 1.0))
    return out
