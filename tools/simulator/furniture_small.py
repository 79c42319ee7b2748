"""Lamps and plants; conventions as in `furniture`."""

from __future__ import annotations

import numpy as np

from beamsplat.tools.simulator.furniture import BLACK, SHADE, STEEL, WARM, FurniturePiece
from beamsplat.tools.simulator.mesh import Material, MeshBuilder
from beamsplat.tools.simulator.shapes import cylinder, lathe, rod


def floor_lamp() -> FurniturePiece:
    """Return a lit lampshade on a pole."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        cylinder(b, (0, 0, 0), 0.15, 0.025, BLACK, sides=20)
        rod(b, (0, 0, 0.02), (0, 0, 1.45), 0.012, STEEL)
        lathe(b, (0, 0, 1.35), [(0.22, 0.0), (0.16, 0.3)], SHADE, sides=24)
        b.lamp((0, 0, 1.5), 0.30, 0.9, WARM)

    return FurniturePiece("floor_lamp", 0.42, 0.42, 1.65, draw)


def plant(height: float) -> FurniturePiece:
    """Return a potted plant with leaves on stems."""

    def draw(b: MeshBuilder, rng: np.random.Generator) -> None:
        pot = Material("terracotta") if rng.random() < 0.5 else Material("ceramic")
        r = 0.16
        lathe(b, (0, 0, 0), [(0.0, 0.0), (r * 0.75, 0.0), (r, 0.30), (r * 1.06, 0.31), (r * 0.95, 0.30)], pot)
        lathe(b, (0, 0, 0.27), [(r * 0.95, 0.0), (0.0, 0.01)], Material("soil"))
        for k in range(16):
            yaw = k * 2.39996 + float(rng.normal(0, 0.2))
            lean, rise = float(rng.uniform(0.15, 0.34)), float(rng.uniform(0.45, 1.0)) * (height - 0.45)
            tip = np.array([lean * np.cos(yaw), lean * np.sin(yaw), 0.28 + rise])
            base = (0.04 * np.cos(yaw), 0.04 * np.sin(yaw), 0.27)
            rod(b, base, tuple(tip), 0.006, Material("leaf", tint=(0.7, 0.7, 0.5)), sides=5)
            leaf(b, tip, yaw, float(rng.uniform(0.2, 0.34)), float(rng.uniform(-0.3, 0.5)))

    return FurniturePiece("plant", 0.55, 0.55, height, draw)


def leaf(b: MeshBuilder, tip: np.ndarray, yaw: float, length: float, pitch: float) -> None:
    """Draw a pointed, drooping, two-sided leaf.

    The leaf starts at `tip` [3], the tip of its stem, and leaves it in direction `yaw`, raised by `pitch`.
    """
    s = np.linspace(0.0, 1.0, 7)
    half = 0.30 * length * np.sin(np.pi * np.clip(s, 0.03, 1.0) ** 0.8)
    along = length * s
    drop = length * (np.sin(pitch) * s - 0.45 * s**2)
    forward, side = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
    centre = tip + along[:, None] * forward + drop[:, None] * np.array([0, 0, 1.0])
    vertices = np.concatenate([centre - half[:, None] * side, centre + half[:, None] * side])
    uvs = np.concatenate([np.stack([s, np.zeros(7)], 1), np.stack([s, np.ones(7)], 1)])
    up = np.broadcast_to([0.0, 0.0, 1.0], (14, 3))
    i = np.arange(6)
    tri = np.concatenate([np.stack([i, i + 1, i + 8], 1), np.stack([i, i + 8, i + 7], 1)])
    b.add(vertices, up, uvs, tri, Material("leaf"))
    b.add(vertices, -up, uvs, tri[:, ::-1], Material("leaf", tint=(0.8, 0.9, 0.7)))
