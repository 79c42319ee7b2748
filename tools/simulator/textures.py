"""Procedural textures: wood, tiles, brick, plaster, wallpaper, cloth, stone. All of them tile seamlessly.

Textures and colour arguments are sRGB float32 [H, W, 3] and [3], 0..1, row 0 on top; `rng` is a seeded
generator.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from scipy import fft


def rgb(hex_colour: str) -> np.ndarray:
    """Return the sRGB colour float32 [3], 0..1, of a hexadecimal code such as 'a0b1c2'."""
    return np.array([int(hex_colour[i : i + 2], 16) for i in (0, 2, 4)], dtype=np.float32) / 255.0


def fractal(
    rng: np.random.Generator,
    height: int,
    width: int,
    beta: float = 1.6,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Return periodic noise [H, W] of zero mean and unit variance, with an amplitude of frequency^-beta.

    `stretch` contains the factors in x and y by which the grain of the noise is elongated. One noise field
    per set of arguments is computed and cached, then shifted and mirrored at random: one Fourier transform
    per texture would take longer than all other parts of a home.
    """
    noise = _noise(height, width, beta, stretch)
    rolled = np.roll(noise, tuple(rng.integers(0, (height, width)).tolist()), axis=(0, 1))
    return rolled[:, :: int(rng.choice([-1, 1]))] * np.float32(rng.choice([-1.0, 1.0]))


@lru_cache(maxsize=64)
def _noise(height: int, width: int, beta: float, stretch: tuple[float, float]) -> np.ndarray:
    fy = np.fft.fftfreq(height)[:, None] * height * stretch[1]
    fx = np.fft.rfftfreq(width)[None, :] * width * stretch[0]
    radius = np.hypot(fx, fy)
    radius[0, 0] = np.inf
    seed = [height, width, round(1000 * beta), round(1000 * stretch[0]), round(1000 * stretch[1])]
    white = np.random.default_rng(seed).standard_normal((height, width), dtype=np.float32)
    spectrum = fft.rfft2(white) * (radius**-beta).astype(np.float32)
    noise = fft.irfft2(spectrum, s=(height, width))
    return (noise / noise.std()).astype(np.float32)


def finish(texture: np.ndarray) -> np.ndarray:
    """Return the texture as float32, clipped to 0..1."""
    return np.clip(texture, 0.0, 1.0).astype(np.float32)


def planks(
    rng: np.random.Generator,
    base: np.ndarray,
    *,
    size_px: int = 1024,
    boards: int = 14,
    contrast: float = 1.0,
    gap: float = 0.5,
) -> np.ndarray:
    """Return floor boards along x, each with its own tone and part of the grain, knots and joints."""
    grain = fractal(rng, size_px, size_px, 1.1, (14.0, 1.0))
    fine = fractal(rng, size_px, size_px, 0.6, (24.0, 1.0))
    wave = fractal(rng, size_px, size_px, 2.2, (5.0, 1.0))
    out = np.empty((size_px, size_px, 3), np.float32)
    edges = np.linspace(0, size_px, boards + 1).astype(int)
    warm = np.array([1.06, 1.0, 0.9], np.float32)
    for top, bottom in pairwise(edges):
        start = int(rng.integers(size_px))
        joints = np.sort((start + np.array([0.0, rng.uniform(0.4, 0.6)]) * size_px).astype(int) % size_px)
        spans = [(joints[0], joints[1]), (joints[1], joints[0] + size_px)]
        for left, right in spans:
            columns = np.arange(left, right) % size_px
            shift_y, shift_x = rng.integers(size_px, size=2)
            rows = (np.arange(top, bottom) + shift_y) % size_px
            source = np.ix_(rows, (columns + shift_x) % size_px)
            rings = np.sin(3.0 * wave[source] * 2.0 + 0.35 * np.linspace(-3, 3, bottom - top)[:, None] ** 2)
            tone = 0.055 * grain[source] + 0.03 * fine[source] + 0.04 * rings
            tone = contrast * tone + rng.normal(0.0, 0.06) * contrast
            board = base * (1.0 + tone[..., None]) * warm ** rng.normal(0.0, 0.35)
            if rng.random() < 0.45:
                board = _knot(rng, board, base)
            out[top:bottom, columns] = board
            out[top:bottom, columns[:2]] *= 1.0 - 0.8 * gap
        out[top : top + 2] *= 1.0 - gap
        out[bottom - 1 : bottom] *= 1.0 - 0.5 * gap
        out[top + 2 : top + 3] *= 1.06
    return finish(out)


def _knot(rng: np.random.Generator, board: np.ndarray, base: np.ndarray) -> np.ndarray:
    height, width = board.shape[:2]
    if width < 80 or height < 20:
        return board
    y, x = np.mgrid[:height, :width].astype(np.float32)
    cy, cx = rng.uniform(0.3, 0.7) * height, rng.uniform(40, width - 40)
    size = rng.uniform(4.0, 9.0)
    d = np.hypot((x - cx) / 2.2, y - cy) / size
    dark = np.exp(-(d**2)) * 0.55 + 0.10 * np.exp(-d / 2.5) * np.cos(5.0 * d)
    return board * (1.0 - np.clip(dark, -0.1, 0.8)[..., None] * (1.3 - base * 0.5))


def herringbone(
    rng: np.random.Generator, base: np.ndarray, size_px: int = 1024, blocks: int = 8
) -> np.ndarray:
    """Return parquet: square blocks of four parallel boards, in alternating directions."""
    cell = size_px // blocks
    staves = 4
    strip = planks(rng, base, size_px=size_px, boards=blocks * staves, contrast=1.1, gap=0.35)
    out = np.empty_like(strip)
    for i in range(blocks):
        for j in range(blocks):
            x = int(rng.integers(size_px - cell))
            patch = strip[i * cell : (i + 1) * cell, x : x + cell].copy()
            patch[:, :2] *= 0.6
            if (i + j) % 2:
                patch = patch.transpose(1, 0, 2)
            out[i * cell : (i + 1) * cell, j * cell : (j + 1) * cell] = patch * rng.normal(1.0, 0.035)
    return finish(out)


def tiles(
    rng: np.random.Generator,
    colours: list[np.ndarray],
    grout: np.ndarray,
    *,
    size_px: int = 512,
    count: int = 4,
    grout_px: int = 4,
    pattern: str = "grid",
    mottle: float = 0.03,
    rows: int | None = None,
) -> np.ndarray:
    """Return `rows` x `count` glazed tiles; the pattern is `grid`, `checker` or `brick` (half offset)."""
    rows = count if rows is None else rows
    clouds = fractal(rng, size_px, size_px, 1.4)
    speck = fractal(rng, size_px, size_px, 0.3)
    y, x = np.mgrid[:size_px, :size_px]
    row = y * rows // size_px
    shifted = x + (row % 2) * (size_px // count // 2 if pattern == "brick" else 0)
    column = (shifted % size_px) * count // size_px
    local_x = (shifted % size_px) - column * size_px / count
    local_y = y - row * size_px / rows
    if pattern == "checker":
        choice = (row + column) % len(colours)
    else:
        choice = rng.integers(len(colours), size=(rows, count))[row, column]
    tone = rng.normal(1.0, mottle, size=(rows, count))[row, column]
    out = np.stack(colours)[choice] * (tone + mottle * clouds + 0.006 * speck)[..., None].astype(np.float32)
    rim = np.minimum(
        np.minimum(local_x, size_px / count - local_x), np.minimum(local_y, size_px / rows - local_y)
    )
    bevel = np.clip((rim - grout_px) / 3.0, 0.0, 1.0)[..., None]
    mortar = grout * (1.0 + 0.06 * speck[..., None])
    return finish(np.where(rim[..., None] < grout_px, mortar, out * (0.9 + 0.1 * bevel)))


def brick(rng: np.random.Generator, base: np.ndarray, mortar: np.ndarray, size_px: int = 1024) -> np.ndarray:
    """Return rough bricks of uneven firing in running bond, 16 courses of 5 bricks (1.2 m square)."""
    rows, count = 16, 5
    warp_x, warp_y = 2.2 * fractal(rng, size_px, size_px, 1.5), 1.8 * fractal(rng, size_px, size_px, 1.5)
    y, x = np.mgrid[:size_px, :size_px].astype(np.float32)
    y, x = (y + warp_y) % size_px, x + warp_x
    row = np.minimum((y * rows / size_px).astype(int), rows - 1)
    x = (x + (row % 2) * size_px / count / 2) % size_px
    column = np.minimum((x * count / size_px).astype(int), count - 1)
    dx = np.abs(x - (column + 0.5) * size_px / count) - (size_px / count / 2 - 5)
    dy = np.abs(y - (row + 0.5) * size_px / rows) - (size_px / rows / 2 - 5)
    inside = np.clip(-np.maximum(dx, dy) / 2.5, 0.0, 1.0)[..., None]
    tone = rng.normal(1.0, 0.13, size=(rows, count))[row, column]
    hue = rng.normal(0.0, 0.05, size=(rows, count))[row, column]
    rough = 0.07 * fractal(rng, size_px, size_px, 0.8) + 0.04 * fractal(rng, size_px, size_px, 1.6)
    body = base * (tone + rough)[..., None] + hue[..., None] * np.array([0.6, -0.1, -0.3])
    joint = mortar * (1.0 + 0.10 * fractal(rng, size_px, size_px, 0.7)[..., None]) * 0.92
    return finish(inside * body + (1.0 - inside) * joint)


def plaster(rng: np.random.Generator, base: np.ndarray, size_px: int = 512, depth: float = 1.0) -> np.ndarray:
    """Return rolled paint on plaster: fine relief lit from above, broad uneven patches."""
    relief = fractal(rng, size_px, size_px, 0.9)
    slope = np.roll(relief, 1, axis=0) - relief
    clouds = fractal(rng, size_px, size_px, 1.9)
    return finish(base * (1.0 + depth * (0.028 * slope + 0.022 * clouds))[..., None])


def stripes(
    rng: np.random.Generator, first: np.ndarray, second: np.ndarray, size_px: int = 512
) -> np.ndarray:
    """Return wallpaper with stripes of random widths and a woven ground."""
    x = np.arange(size_px)
    widths = rng.integers(14, 46, size=6)
    edges = np.concatenate([[0], np.cumsum(widths)]) * size_px / widths.sum()
    choice = (np.searchsorted(edges, x, side="right") - 1) % 2
    line = np.min(np.abs(x[:, None] - edges[None]), axis=1) < 2.0
    row = np.where(choice[:, None], first, second) * np.where(line[:, None], 0.82, 1.0)
    ground = 1.0 + 0.03 * fractal(rng, size_px, size_px, 0.7) + 0.012 * fractal(rng, size_px, size_px, 1.8)
    return finish(row[None] * ground[..., None])


def damask(rng: np.random.Generator, ground: np.ndarray, motif: np.ndarray, size_px: int = 512) -> np.ndarray:
    """Return wallpaper with a mirrored leaf ornament in half-drop repeat."""
    cell = np.zeros((size_px // 2, size_px // 2), np.float32)
    half = size_px // 4
    for _ in range(7):
        centre = (int(rng.uniform(0.05, 0.9) * half), int(rng.uniform(0.1, 0.9) * size_px / 2))
        axes = (int(rng.uniform(0.06, 0.3) * half), int(rng.uniform(0.04, 0.16) * size_px / 2))
        angle = rng.uniform(0, 180)
        cv2.ellipse(cell, centre, axes, angle, 0, 360, float(rng.random() < 0.75), -1, cv2.LINE_AA)
        cv2.ellipse(cell, centre, (axes[0] + 4, axes[1] + 4), angle, 20, 300, 1.0, 2, cv2.LINE_AA)
    cell[:, half:] = cell[:, :half][:, ::-1]
    mask = np.block([[cell, np.roll(cell, size_px // 4, axis=0)]] * 2)
    mask = cv2.GaussianBlur(mask, (0, 0), 0.8)[..., None]
    weave = 1.0 + 0.02 * fractal(rng, size_px, size_px, 0.6)[..., None]
    return finish((ground * (1 - mask) + motif * mask) * weave)


def weave(
    rng: np.random.Generator,
    base: np.ndarray,
    size_px: int = 256,
    strength: float = 0.16,
    melange: float = 0.05,
) -> np.ndarray:
    """Return plain woven cloth: over-and-under threads, uneven yarn."""
    y, x = np.mgrid[:size_px, :size_px].astype(np.float32)
    period = 8.0
    over = ((x // period + y // period) % 2).astype(np.float32)
    across = np.where(over > 0, np.sin(np.pi * (x % period) / period), np.sin(np.pi * (y % period) / period))
    yarn = melange * fractal(rng, size_px, size_px, 0.4) + 0.03 * fractal(rng, size_px, size_px, 1.7)
    return finish(base * (1.0 - strength * 0.5 + strength * across + yarn)[..., None])


def plaid(rng: np.random.Generator, colours: list[np.ndarray], size_px: int = 256) -> np.ndarray:
    """Return tartan cloth: the same sequence of coloured bands in both directions of the threads."""
    edges = np.sort(rng.integers(0, size_px, size=9))
    band = np.searchsorted(edges, np.arange(size_px)) % len(colours)
    line = np.stack(colours)[band]
    twill = ((np.add.outer(np.arange(size_px), np.arange(size_px)) // 2) % 2)[..., None]
    cloth = np.where(twill > 0, line[None], line[:, None])
    cloth = cv2.GaussianBlur(cloth.astype(np.float32), (0, 0), 0.7)
    return finish(cloth * (1.0 + 0.05 * fractal(rng, size_px, size_px, 0.6))[..., None])


def shag(rng: np.random.Generator, base: np.ndarray, size_px: int = 512) -> np.ndarray:
    """Return a deep pile carpet."""
    pile = 0.16 * fractal(rng, size_px, size_px, 0.5) + 0.08 * fractal(rng, size_px, size_px, 1.3)
    return finish(base * (1.0 + pile)[..., None])


def veneer(
    rng: np.random.Generator, base: np.ndarray, size_px: int = 512, contrast: float = 1.0
) -> np.ndarray:
    """Return furniture wood with the grain along u: cathedral rings, pores, slow change of tone."""
    wave = fractal(rng, size_px, size_px, 2.3, (4.0, 1.0))
    rings = np.sin(9.0 * wave) * 0.5 + np.sin(23.0 * wave) * 0.2
    pores = fractal(rng, size_px, size_px, 0.5, (30.0, 1.0))
    slow = fractal(rng, size_px, size_px, 1.8, (8.0, 1.0))
    tone = contrast * (0.07 * rings + 0.035 * pores + 0.06 * slow)
    return finish(base * (1.0 + tone[..., None] * np.array([0.9, 1.0, 1.15], np.float32)))


def stone(rng: np.random.Generator, base: np.ndarray, vein: np.ndarray, size_px: int = 512) -> np.ndarray:
    """Return marble: veins along the zero lines of warped noise."""
    first, second = fractal(rng, size_px, size_px, 1.7), fractal(rng, size_px, size_px, 1.6)
    fine = fractal(rng, size_px, size_px, 0.8)
    veins = np.exp(-np.abs(first) * 9.0) * 0.7 + np.exp(-np.abs(second + 0.6) * 16.0) * 0.4
    mix = np.clip(veins * (0.7 + 0.3 * fine), 0.0, 1.0)[..., None]
    clouds = 1.0 + 0.03 * fractal(rng, size_px, size_px, 2.0)[..., None]
    return finish((base * (1 - mix) + vein * mix) * clouds)


def terrazzo(
    rng: np.random.Generator, base: np.ndarray, chips: list[np.ndarray], size_px: int = 512
) -> np.ndarray:
    """Return terrazzo (stone chips in cement); other colours make it look like granite."""
    out = np.broadcast_to(base, (size_px, size_px, 3)).astype(np.float32).copy()
    for _ in range(2200):
        centre = rng.integers(0, size_px, size=2)
        axes = (int(rng.integers(1, 6)), int(rng.integers(1, 4)))
        colour = chips[int(rng.integers(len(chips)))] * rng.uniform(0.85, 1.1)
        for dx in (-size_px, 0, size_px):  # chips at the border continue on the other side
            at = (int(centre[0]) + dx, int(centre[1]))
            if -8 < at[0] < size_px + 8:
                cv2.ellipse(
                    out, at, axes, float(rng.uniform(0, 180)), 0, 360, colour.tolist(), -1, cv2.LINE_AA
                )
    return finish(out * (1.0 + 0.02 * fractal(rng, size_px, size_px, 0.5)[..., None]))


def flat(rng: np.random.Generator, base: np.ndarray, size_px: int = 128, depth: float = 0.015) -> np.ndarray:
    """Return an almost uniform surface: paint, plastic or metal."""
    return finish(base * (1.0 + depth * fractal(rng, size_px, size_px, 1.0))[..., None])


def brushed(rng: np.random.Generator, base: np.ndarray, size_px: int = 256) -> np.ndarray:
    """Return brushed steel with lines along u."""
    lines = fractal(rng, size_px, size_px, 0.5, (40.0, 1.0))
    return finish(base * (1.0 + 0.05 * lines + 0.03 * fractal(rng, size_px, size_px, 2.0))[..., None])


def dots(rng: np.random.Generator, ground: np.ndarray, spot: np.ndarray, size_px: int = 256) -> np.ndarray:
    """Return cloth or paper with spots in half-drop repeat."""
    y, x = np.mgrid[:size_px, :size_px].astype(np.float32)
    pitch = size_px / 4
    column = (x // pitch) % 2
    d = np.hypot(x % pitch - pitch / 2, (y + column * pitch / 2) % pitch - pitch / 2)
    mask = np.clip((pitch * 0.26 - d) / 1.5, 0, 1)[..., None]
    return finish(
        (ground * (1 - mask) + spot * mask) * (1 + 0.03 * fractal(rng, size_px, size_px, 0.6)[..., None])
    )
