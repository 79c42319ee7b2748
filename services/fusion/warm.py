"""Compiles the kernels of fusion once, into the cache beside their sources."""

from __future__ import annotations

import numpy as np

from common.beams import Beams
from common.camera import Pinhole
from common.frames import camera_mount
from common.geometry import make_transform
from services.fusion.field import Frame
from services.fusion.fuse import Fusion
from services.fusion.movers import FreeSpace


def warm() -> None:
    """Fuses three pictures of noise, so that every kernel has met the types it is used with."""
    camera = Pinhole(265.0, 265.0, 159.5, 119.5, 320, 240)
    fusion = Fusion(camera, camera_mount(0.1, 0.0, 0.45), floor_known=True, planar=True)
    rng = np.random.default_rng(0)
    angle = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    points = np.stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), np.full(360, 0.18)], axis=1)
    beams = Beams(points, np.arange(360), np.full(360, 0.01))
    picture = rng.integers(0, 255, (240, 320, 3)).astype(np.uint8)
    for number in range(3):
        T_map_body = make_transform(np.eye(3), np.array([0.1 * number, 0.0, 0.0]))
        fusion.add_scan(points + T_map_body[:3, 3])
        shifted = np.roll(picture, 3 * number, axis=1)
        fusion.fuse(Frame(number, shifted, T_map_body, beams), keyframe=number != 1)
    FreeSpace(side_m=8.0).add(np.zeros(2), points)
