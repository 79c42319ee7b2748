"""Compiles the rasterizer's kernels into their cache."""

from __future__ import annotations

import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import PARAMS
from beamsplat.common.raster.optimiser import GaussianArrays, rate_rows
from beamsplat.common.raster.rasterizer import Rasterizer


def warm() -> None:
    """Renders, differentiates and improves a picture of one Gaussian, with the types used in production."""
    gaussian = np.zeros((PARAMS, 1), np.float32)
    gaussian[2], gaussian[6] = 2.0, 1.0
    store = GaussianArrays(16)
    store.append(gaussian)
    rasterizer = Rasterizer()
    render = rasterizer.render(
        store.params, store.count, RasterCamera(20.0, 20.0, 8.0, 8.0, 17, 17), np.eye(4)
    )
    gradients = rasterizer.backward(render, np.ones_like(render.image))
    store.step(rasterizer.team, gradients, rate_rows(1e-3, 1e-3, 1e-3, 1e-3, 1e-3))
    rasterizer.release(render)
    rasterizer.close()
