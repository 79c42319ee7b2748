"""Compile the kernels of the mapper and of the rasterizer into their on-disk caches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.warm import warm as warm_rasterizer
from beamsplat.services.mapping.engines.cpu import CpuEngine
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.mapper import FULL, HALF, Mapper
from beamsplat.services.mapping.settings import MapperSettings


def warm() -> None:
    """Run every kernel once: map two small keyframes with all options and the service's array types."""
    warm_rasterizer()
    settings = MapperSettings(ssim_every=1, refine_pose=True, refine_exposure=True, carve_votes=1)
    mapper = Mapper(settings, engine=CpuEngine(degree=1))
    wall = RgbdKeyframe(
        id=0, rgb=np.full((48, 64, 3), 128, np.uint8), camera=RasterCamera(50.0, 50.0, 31.5, 23.5, 64, 48),
        T_anchor_camera=np.eye(4), depth_m=np.full((48, 64), 2.0, np.float32),
        sigma_m=np.full((48, 64), 0.01, np.float32), beams_uvz=np.array([[30.0, 20.0, 2.0]]),
    )  # fmt: skip
    for frame in (wall, replace(wall, id=1)):
        mapper.add(frame, np.eye(4))
        mapper.step(mapper.keyframes[0], FULL)
        mapper.step(mapper.keyframes[0], HALF)
