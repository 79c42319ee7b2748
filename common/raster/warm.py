"""Warm-up: compiles the rasterizer's kernels into the on-disk cache."""

from __future__ import annotations

import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import PARAMS
from beamsplat.common.raster.optimiser import GaussianArrays, learning_rates
from beamsplat.common.raster.rasterizer import Rasterizer


def warm() -> None:
    """Compile all kernels: run forward pass, backward pass and one optimiser step on one Gaussian.

    The arrays have the types used in operation, so that later calls use the compiled code.
    """
    gaussian = np.zeros((PARAMS, 1), np.float32)
    gaussian[2], gaussian[6] = 2.0, 1.0
    store = GaussianArrays(16)
    store.append(gaussian)
    rasterizer = Rasterizer()
    render = rasterizer.render(
        store.params, store.count, RasterCamera(20.0, 20.0, 8.0, 8.0, 17, 17), np.eye(4)
    )
    gradients = rasterizer.backward(render, np.ones_like(render.image))
    store.step(rasterizer.team, gradients, learning_rates(1e-3, 1e-3, 1e-3, 1e-3, 1e-3))
    rasterizer.release(render)
    rasterizer.close()
