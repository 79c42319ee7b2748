"""Compiles the rasterizer's kernels into their cache."""

from __future__ import annotations

import numpy as np

from common.raster.camera import RasterCamera
from common.raster.layout import PARAMS
from common.raster.rasterizer import Rasterizer


def warm() -> None:
    """Renders and differentiates a picture of one Gaussian, with the types used in production."""
    params = np.zeros((PARAMS, 16), np.float32)
    params[2], params[6] = 2.0, 1.0
    rasterizer = Rasterizer()
    render = rasterizer.render(params, 1, RasterCamera(20.0, 20.0, 8.0, 8.0, 17, 17), np.eye(4))
    rasterizer.backward(render, np.ones_like(render.image))
    rasterizer.release(render)
    rasterizer.close()
