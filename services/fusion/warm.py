"""Compilation of all fusion kernels ahead of time."""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.services.fusion.free_space import FreeSpaceGrid
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.learned_inputs import (
    CANDIDATES,
    LABELS,
    MULTIPLE,
    OUTPUTS,
    AggregatorInputs,
)
from beamsplat.services.fusion.learned_kernels import decode_depth, quantised_cost, quantised_energy


def warm() -> None:
    """Run every kernel once on noise images in front of a wall, so that all are compiled in advance."""
    camera = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)
    fusion = Fusion(camera, camera_mount(0.1, 0.0, 0.45), floor_known=True, planar=True, completes=True)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (480, 640, 3)).astype(np.uint8)
    y = np.linspace(-2.0, 2.0, 200)
    for i in range(4):
        T_map_body = se2_to_se3(np.array([0.15 * i, 0.0, 0.0]))
        points = np.stack([np.full(200, 3.0 - 0.15 * i), y, np.full(200, 0.18)], axis=1)
        fusion.add_scan(points + T_map_body[:3, 3])
        beams = Beams(points, np.arange(200), np.full(200, 0.01))
        estimate = np.full((480, 640), 3.0, np.float32) + rng.uniform(0.0, 0.1, (480, 640)).astype(np.float32)
        shown = np.roll(image, i, axis=1)
        shown.setflags(write=i < 2)  # raw images without distortion are views of received bytes
        frame = FusionInput(i, shown, T_map_body, beams, estimate, "relative")
        fusion.fuse(frame, keyframe=i % 2 == 0)
    FreeSpaceGrid().add(np.zeros(2), points)
    _warm_learned()


def _warm_learned() -> None:
    """Run the kernels of the learned aggregation on a few pixels."""
    h, w = 3, 4
    volume = np.ones((h, w, LABELS), np.float32)
    map16 = np.zeros((h, w), np.float16)
    inputs = AggregatorInputs(
        quantised_cost(volume), quantised_energy(volume, 4.0), np.zeros((len(CANDIDATES), h, w), np.float16),
        np.zeros((h, w, 3), np.uint8), map16, np.zeros((h, w), np.uint8), map16, map16, 1, 0.0,
    )  # fmt: skip
    log_z = np.linspace(-1.0, 2.0, LABELS)
    inputs.features(log_z)
    depth = np.empty((h, w), np.float32)
    output = np.zeros((OUTPUTS, MULTIPLE, MULTIPLE), np.float32)
    decode_depth(
        output, inputs.cost, inputs.energy, inputs.place(log_z), float(log_z[0]),
        float(log_z[1] - log_z[0]), depth, np.empty_like(depth),
    )  # fmt: skip
