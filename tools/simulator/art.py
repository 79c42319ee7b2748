"""Image-like textures: paintings and posters, book spines, rugs, window views, screens, clock faces.

Textures are sRGB float32 [H, W, 3], 0..1, row 0 on top; `rng` is a seeded generator.
"""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.tools.simulator.textures import finish, fractal, rgb

WORDS = (
    "ATLAS",
    "OCEAN",
    "NIGHT",
    "GARDEN",
    "LIGHT",
    "NORTH",
    "RIVER",
    "STONE",
    "PAPER",
    "SIGNAL",
    "WINTER",
    "HARBOUR",
    "ORBIT",
    "FOREST",
    "MAPS",
    "ISLAND",
    "COOKING",
    "POEMS",
    "ALGEBRA",
    "HISTORY",
    "OPTICS",
    "ROBOTS",
    "VOYAGE",
    "SILENCE",
    "COLOUR",
    "BIRDS",
    "DESIGN",
    "LETTERS",
    "MUSIC",
    "TREES",
)


def text_mask(
    height: int, width: int, at: tuple[int, int], text: str, scale: float, thick: int
) -> np.ndarray:
    """Return a mask float32 [H, W, 1] of printed text: 1 on the letters, 0 elsewhere.

    `at` is the lower left corner of the text in pixels. The mask is drawn in uint8, as OpenCV's putText
    requires.
    """
    mask = np.zeros((height, width), np.uint8)
    cv2.putText(mask, text, at, cv2.FONT_HERSHEY_DUPLEX, scale, 255, thick, cv2.LINE_AA)
    return (mask / np.float32(255.0))[..., None]


def landscape(rng: np.random.Generator, height: int, width: int, *, night: bool = False) -> np.ndarray:
    """Return a painting of sky, sun, ridges in aerial perspective, and a lake or meadow."""
    top, low = (rgb("1d2b52"), rgb("c26a4a")) if night else (rgb("6fa3d0"), rgb("f2dcc0"))
    t = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    out = np.broadcast_to(top * (1 - t) + low * t, (height, width, 3)).copy()
    clouds = np.clip(fractal(rng, height, width, 1.7, (1.0, 3.0)) - 0.2, 0, 1.5)[..., None]
    out += 0.16 * clouds * (1 - t)
    sun = (int(rng.uniform(0.2, 0.8) * width), int(rng.uniform(0.2, 0.45) * height))
    cv2.circle(out, sun, max(3, height // 16), (1.0, 0.95, 0.75), -1, cv2.LINE_AA)
    x = np.arange(width)
    ridges = 5
    tone = np.array([0.25, 0.42, 0.22]) if rng.random() < 0.6 else np.array([0.45, 0.33, 0.28])
    for k in range(ridges):
        base = 0.42 + 0.11 * k
        line = fractal(rng, 4, width, 1.5)[0] * 0.05 * (1.2 - k / ridges) + base
        mask = (np.arange(height)[:, None] > (line * height)[None, x])[..., None]
        near = (k + 1) / ridges
        colour = (tone * near * 0.9 + np.array([0.55, 0.63, 0.75]) * (1 - near)) * (0.55 if night else 1.0)
        shade = 1.0 + 0.10 * fractal(rng, height, width, 1.2)[..., None]
        out = np.where(mask, colour * shade, out)
    return finish(out)


def mondrian(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return a painting of fields in primary colours between black bars."""
    out = np.full((height, width, 3), 0.93, np.float32)
    xs = np.sort(rng.uniform(0.1, 0.9, 4) * width).astype(int)
    ys = np.sort(rng.uniform(0.1, 0.9, 5) * height).astype(int)
    columns, rows = [0, *xs, width], [0, *ys, height]
    palette = [rgb("c22f2a"), rgb("274f9e"), rgb("e8b923"), rgb("1b1b1b"), rgb("e9e4d6"), rgb("e9e4d6")]
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            if rng.random() < 0.5:
                colour = palette[int(rng.integers(len(palette)))]
                out[rows[i] : rows[i + 1], columns[j] : columns[j + 1]] = colour
    for x in xs:
        out[:, max(0, x - 3) : x + 3] = 0.06
    for y in ys:
        out[max(0, y - 3) : y + 3] = 0.06
    return finish(out * (1 + 0.03 * fractal(rng, height, width, 0.8))[..., None])


def abstract(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return a painting of warped colour fields with rings and strokes."""
    palette = rng.uniform(0.08, 0.95, size=(5, 3)).astype(np.float32)
    field = fractal(rng, height, width, 2.0)
    index = np.clip((field + 1.6) / 3.2 * 5, 0, 4.99)
    out = palette[index.astype(int)].astype(np.float32)
    for _ in range(9):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        colour = rng.uniform(0.05, 1.0, 3).tolist()
        if rng.random() < 0.5:
            radius = int(rng.uniform(0.05, 0.22) * width)
            cv2.circle(out, centre, radius, colour, -1 if rng.random() < 0.5 else 5, cv2.LINE_AA)
        else:
            end = (int(rng.integers(width)), int(rng.integers(height)))
            cv2.line(out, centre, end, colour, int(rng.integers(2, 12)), cv2.LINE_AA)
    return finish(out * (1 + 0.05 * fractal(rng, height, width, 0.7))[..., None])


def skyline(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return a painting of a city at dusk with lit windows."""
    t = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    out = np.broadcast_to(rgb("27345e") * (1 - t) + rgb("e89a5b") * t, (height, width, 3)).copy()
    for layer in range(3):
        x = 0
        while x < width:
            w = int(rng.integers(width // 16, width // 7))
            top = int(height * rng.uniform(0.25 + 0.15 * layer, 0.75))
            colour = np.array([0.16, 0.17, 0.27]) * (1.5 - 0.45 * layer)
            out[top:, x : x + w] = colour
            if layer:
                for wy in range(top + 5, height - 4, 9):
                    for wx in range(x + 4, min(x + w, width) - 5, 8):
                        if rng.random() < 0.4:
                            out[wy : wy + 4, wx : wx + 3] = rgb("ffd98a") * rng.uniform(0.6, 1.0)
            x += w
    return finish(out)


def portrait(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return a painting of head and shoulders in broad strokes."""
    ground = rng.uniform(0.15, 0.6, 3).astype(np.float32)
    out = (ground * (1 + 0.2 * fractal(rng, height, width, 1.6)[..., None])).astype(np.float32)
    cx, unit = width // 2, min(width, height)
    skin = rgb("d9a884") * rng.uniform(0.5, 1.1)
    coat, hair = rng.uniform(0.05, 0.6, 3), rng.uniform(0.03, 0.35) * np.array([1.0, 0.75, 0.5])
    cv2.ellipse(
        out, (cx, height), (int(unit * 0.42), int(unit * 0.34)), 0, 0, 360, coat.tolist(), -1, cv2.LINE_AA
    )
    cv2.rectangle(
        out, (cx - unit // 14, height // 2), (cx + unit // 14, int(height * 0.78)), (skin * 0.8).tolist(), -1
    )
    head = (cx, int(height * 0.43))
    cv2.ellipse(
        out, (cx, int(height * 0.39)), (unit // 5, unit // 4), 0, 0, 360, hair.tolist(), -1, cv2.LINE_AA
    )
    cv2.ellipse(out, head, (unit // 7, unit // 5), 0, 0, 360, skin.tolist(), -1, cv2.LINE_AA)
    for side in (-1, 1):
        cv2.circle(
            out, (cx + side * unit // 17, int(height * 0.41)), max(2, unit // 60), (0.1, 0.08, 0.08), -1
        )
    mouth = (cx, int(height * 0.51))
    cv2.ellipse(out, mouth, (unit // 22, unit // 70), 0, 0, 360, (0.6, 0.25, 0.22), -1, cv2.LINE_AA)
    return finish(out * (1 + 0.06 * fractal(rng, height, width, 0.8))[..., None])


def lettering(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Return a poster with concentric discs above and two large words below."""
    paper, ink = rgb("ece5d3"), rng.uniform(0.05, 0.5, 3)
    out = np.broadcast_to(paper, (height, width, 3)).astype(np.float32).copy()
    accent = rng.uniform(0.2, 0.9, 3)
    for k in range(6):
        radius = int(width * 0.36 * (1 - k / 6))
        colour = accent if k % 2 == 0 else paper
        cv2.circle(
            out, (width // 2, int(height * 0.36)), radius, np.asarray(colour).tolist(), -1, cv2.LINE_AA
        )
    for k, word in enumerate(rng.choice(WORDS, 2, replace=False)):
        scale = width * 0.8 / max(1, cv2.getTextSize(str(word), cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)[0][0])
        at = (int(width * 0.1), int(height * (0.78 + 0.14 * k)))
        mask = text_mask(height, width, at, str(word), scale, 3)
        out = out * (1 - mask) + ink.astype(np.float32) * mask
    return finish(out * (1 + 0.02 * fractal(rng, height, width, 1.0))[..., None])


PAINTINGS = (landscape, mondrian, abstract, skyline, portrait, lettering)


def book_spines(
    rng: np.random.Generator, height: int = 256, width: int = 1024, count: int = 32
) -> np.ndarray:
    """Return `count` book spines of equal width side by side; spine k is at u in [k, k + 1] / count."""
    out = np.empty((height, width, 3), np.float32)
    cell = width // count
    dyes = "7b2d26,1f3a5f,2f4b3c,e0d6c2,3b3b3d,b5762b,8c8f91,5a2a4a,d8d2c4,20504f,c7a24b"
    cloths = [rgb(c) for c in dyes.split(",")]
    for k in range(count):
        colour = cloths[int(rng.integers(len(cloths)))] * rng.uniform(0.75, 1.1)
        spine = np.broadcast_to(np.clip(colour, 0, 1), (height, cell, 3)).astype(np.float32).copy()
        ink = (0.92, 0.85, 0.6) if colour.mean() < 0.5 else (0.12, 0.1, 0.1)
        for at in (0.06, 0.12, 0.86):
            if rng.random() < 0.7:
                spine[int(at * height) : int(at * height) + int(rng.integers(2, 9))] = ink
        strip = text_mask(
            cell, int(height * 0.66), (4, int(cell * 0.72)), str(rng.choice(WORDS)), cell / 30.0, 2
        )
        mask = cv2.rotate(strip[..., 0], cv2.ROTATE_90_CLOCKWISE)[..., None]
        top = int(height * 0.17)
        area = spine[top : top + mask.shape[0]]
        spine[top : top + mask.shape[0]] = area * (1 - mask) + np.array(ink, np.float32) * mask
        x = np.abs(np.linspace(-1, 1, cell))[None, :, None]
        out[:, k * cell : (k + 1) * cell] = spine * (1.05 - 0.35 * x**3)
    return finish(out * (1 + 0.04 * fractal(rng, height, width, 0.9))[..., None])


def persian_rug(rng: np.random.Generator, height: int = 512, width: int = 768) -> np.ndarray:
    """Return a rug with stepped borders, a medallion, and motifs mirrored about both axes."""
    palettes = ("7c1f23 20345c d9c39a 3b5a4a", "23395b c8b48a 8a2c2c e6dcc3", "5b4636 c9b79c 8f6f4e 2e3a3f")
    colours = [rgb(c) for c in str(rng.choice(palettes)).split()]
    quarter_h, quarter_w = height // 2, width // 2
    q = np.broadcast_to(colours[0], (quarter_h, quarter_w, 3)).astype(np.float32).copy()
    for _ in range(46):
        at = (int(rng.integers(quarter_w)), int(rng.integers(quarter_h)))
        size = (int(rng.integers(4, 26)), int(rng.integers(3, 13)))
        colour = (colours[int(rng.integers(1, 4))] * rng.uniform(0.8, 1.1)).tolist()
        cv2.ellipse(q, at, size, float(rng.integers(4) * 45), 0, 360, colour, -1, cv2.LINE_AA)
        cv2.ellipse(q, at, (size[0] // 2, size[1] // 2), 0, 0, 360, colours[0].tolist(), -1, cv2.LINE_AA)
    for radius, k in ((0.62, 1), (0.5, 2), (0.36, 3), (0.2, 0), (0.1, 2)):
        axes = (int(quarter_w * radius * 0.8), int(quarter_h * radius))
        cv2.ellipse(q, (quarter_w, quarter_h), axes, 0, 0, 360, colours[k].tolist(), -1, cv2.LINE_AA)
    for inset, k in ((44, 1), (38, 2), (14, 3), (9, 1), (4, 2)):
        q[:inset], q[:, :inset] = colours[k], colours[k]
        if inset == 38:
            for i in range(0, max(quarter_h, quarter_w), 26):
                for at in ((i, 26), (26, i)):
                    cv2.circle(q, at, 8, colours[0].tolist(), -1, cv2.LINE_AA)
                    cv2.circle(q, at, 3, colours[1].tolist(), -1, cv2.LINE_AA)
    top = np.concatenate([q, q[:, ::-1]], axis=1)
    out = np.concatenate([top, top[::-1]], axis=0)
    knots = 1 + 0.09 * fractal(rng, height, width, 0.5) + 0.04 * fractal(rng, height, width, 1.6, (1.0, 6.0))
    return finish(out * knots[..., None])


def garden_view(rng: np.random.Generator, height: int = 512, width: int = 512) -> np.ndarray:
    """Return a view through a window: bright sky, far trees, lawn, blurred as if out of focus."""
    t = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    out = np.broadcast_to(rgb("b9d6f2") * (1 - t) + rgb("f4f6f2") * t, (height, width, 3)).copy()
    out += 0.12 * np.clip(fractal(rng, height, width, 1.8), 0, 2)[..., None] * (1 - t)
    for k in range(3):
        line = 0.52 + 0.10 * k + 0.07 * fractal(rng, 4, width, 1.2)[0] / (k + 1)
        mask = (np.arange(height)[:, None] > (line * height)[None])[..., None]
        green = np.array([0.50, 0.62, 0.40]) * (1.15 - 0.2 * k)
        out = np.where(mask, green * (1 + 0.16 * fractal(rng, height, width, 1.0)[..., None]), out)
    lawn = np.array([0.58, 0.70, 0.40]) * (1 + 0.06 * fractal(rng, height, width, 0.8)[..., None])
    out = np.where((np.arange(height) > 0.82 * height)[:, None, None], lawn, out)
    return finish(cv2.GaussianBlur(out.astype(np.float32), (0, 0), 2.0))


def foliage(rng: np.random.Generator, size_px: int = 256) -> np.ndarray:
    """Return the surface of a leaf: midrib along u, side veins, uneven green."""
    y, x = np.mgrid[:size_px, :size_px].astype(np.float32) / size_px
    rib = np.exp(-np.abs(y - 0.5) * 70)
    veins = 0.5 + 0.5 * np.cos((x * 14 + np.abs(y - 0.5) * 10) * 2 * np.pi)
    tone = 0.9 + 0.35 * rib + 0.10 * veins**6 + 0.12 * fractal(rng, size_px, size_px, 1.5)
    return finish(rgb("4f7f38") * tone[..., None])


def screen(rng: np.random.Generator, height: int = 256, width: int = 448) -> np.ndarray:
    """Return a computer screen: windows with lines of text on a wallpaper."""
    out = landscape(rng, height, width, night=True) * 0.8
    for _ in range(3):
        x, y = int(rng.uniform(0.03, 0.5) * width), int(rng.uniform(0.05, 0.4) * height)
        w, h = int(width * rng.uniform(0.3, 0.45)), int(height * rng.uniform(0.35, 0.5))
        out[y : y + h, x : x + w] = rgb("202428") if rng.random() < 0.5 else rgb("f0f0ee")
        out[y : y + 10, x : x + w] = rgb("4a5058")
        for line in range(y + 16, min(y + h, height) - 6, 9):
            length = int(rng.uniform(0.2, 0.9) * w)
            out[line : line + 3, x + 6 : min(x + length, width)] = rng.uniform(0.3, 0.8, 3)
    return finish(out)


def clock_face(size_px: int = 256) -> np.ndarray:
    """Return the dial of a clock that shows ten past ten."""
    out = np.full((size_px, size_px, 3), 0.95, np.float32)
    centre = (size_px // 2, size_px // 2)
    for hour in range(12):
        a = hour * np.pi / 6
        p = [int(centre[i] + 0.43 * size_px * f) for i, f in ((0, np.sin(a)), (1, -np.cos(a)))]
        q = [int(centre[i] + 0.36 * size_px * f) for i, f in ((0, np.sin(a)), (1, -np.cos(a)))]
        cv2.line(out, tuple(p), tuple(q), (0.1, 0.1, 0.1), 5, cv2.LINE_AA)
    for angle, length, width in ((-1.0, 0.24, 8), (1.05, 0.36, 5)):
        tip = (
            int(centre[0] + np.sin(angle) * length * size_px),
            int(centre[1] - np.cos(angle) * length * size_px),
        )
        cv2.line(out, centre, tip, (0.08, 0.08, 0.1), width, cv2.LINE_AA)
    return out
