"""Scenes and comparisons for the tests of the CUDA kernels on the CPU."""

import numpy as np

from beamsplat.common.raster.cuda.buffers import RasterBuffers
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.cuda.view import RasterView
from tests.common.raster.cuda.shim import kernels_under_test
from tests.common.raster.scenes import random_camera, random_gaussians, random_pose


def packed(arrays):
    """Parameters float32 [14, capacity] of the arrays of `random_gaussians`, and their number."""
    mean, log_scale, quat, logit, colour = arrays
    params = np.zeros((14, -(-len(mean) // 16) * 16), np.float32)
    params[:, : len(mean)] = np.concatenate([mean.T, log_scale.T, quat.T, logit[None], colour.T])
    return params, len(mean)


def random_scene(seed, width_px=61, height_px=47, count=400, more_opacity=0.0):
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    camera = random_camera(rng, width_px, height_px)
    mean, log_scale, quat, logit, colour = random_gaussians(rng, T, count)
    params, count = packed((mean, log_scale, quat, logit + more_opacity, colour))
    weights = rng.normal(size=(5, camera.height_px, camera.width_px)).astype(np.float32)
    return params, count, camera, T, weights


def view_of(params, count, camera, T_camera_map, *, tile=8, pairs=1 << 14, with_rows=True):
    """A view of the Gaussians with its camera set."""
    kernels = kernels_under_test(tile)
    gaussians = DeviceGaussians(kernels, count)
    gaussians.append(params[:, :count])
    view = RasterView(
        kernels, gaussians, RasterBuffers(kernels, pairs), camera.width_px, camera.height_px, with_rows
    )
    view.set_camera(camera, T_camera_map)
    return view


def relative(a, b):
    return float(np.linalg.norm(np.asarray(a) - b) / max(np.linalg.norm(b), 1e-20))
