"""The mapper's engine of the CPU: losses and carving as compiled Numba kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from beamsplat.common.engines.cpu import CpuSplatEngine
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.optimiser import learning_rates
from beamsplat.common.raster.rasterizer import Render
from beamsplat.common.raster.ssim import SsimLoss
from beamsplat.services.mapping.engines.protocol import OptimiserStep
from beamsplat.services.mapping.kernels import (
    add_lidar,
    count_carving_votes,
    exposure_gradient,
    photometric_and_depth,
)
from beamsplat.services.mapping.keyframe import (
    PyramidLevel,
    StoredKeyframe,
    refine_exposure,
    refine_pose,
    with_hidden,
)
from beamsplat.services.mapping.settings import LearningRates, MapperSettings


class CpuEngine(CpuSplatEngine):
    """Implements `Engine`."""

    device_budget_bytes: float | None = None

    def __init__(self, threads: int = 1, degree: int = 0) -> None:
        super().__init__(threads, degree)
        self._ssim = SsimLoss()
        self._buffers: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def optimise(
        self,
        steps: Sequence[OptimiserStep],
        T_map_anchor: Mapping[int, np.ndarray],
        settings: MapperSettings,
        must_stop: Callable[[], bool],
    ) -> list[float]:
        """See `Engine.optimise`."""
        losses: list[float] = []
        for step in steps:
            if must_stop():
                break
            T_map_camera = T_map_anchor[step.keyframe.anchor] @ step.keyframe.T_anchor_refined()
            losses.append(self._step(step, T_map_camera, settings))
        return losses

    def vote_carving(self, level: PyramidLevel, T_map_camera: np.ndarray, settings: MapperSettings) -> None:
        """See `Engine.vote_carving`."""
        store = self.store
        count_votes(store.params, store.count, level, T_map_camera, settings, store.carving_votes)

    @property
    def workspace_bytes(self) -> int:
        """See `SplatEngine.workspace_bytes`."""
        losses = sum(array.nbytes for pair in self._buffers.values() for array in pair)
        return super().workspace_bytes + self._ssim.allocated_bytes + losses

    def forget(self, id: int) -> None:
        """Nothing is held of a keyframe."""

    def _step(self, step: OptimiserStep, T_map_camera: np.ndarray, s: MapperSettings) -> float:
        """Render, compute the losses, go back to the Gaussians, take a step of Adam; return the loss."""
        keyframe, level = step.keyframe, step.keyframe.levels[step.size]
        render = self._render(level.camera, inverse(T_map_camera))
        if level.hidden is not None:
            level = with_hidden(level, render.image, keyframe.exposure)
        loss, gradient = self._loss(render, level, keyframe, s, step.with_ssim)
        gradients = self.rasterizer.backward(render, gradient)
        self._harmonics_backward(gradients, inverse(T_map_camera), s.rates.harmonics)
        pixels = level.camera.width_px * level.camera.height_px
        self.store.step(
            self.rasterizer.team, gradients, rate_rows(s.rates, step.refining),
            s.isotropy_weight / pixels, np.log(s.isotropy_ratio),
        )  # fmt: skip
        if s.refine_pose:
            refine_pose(
                keyframe, gradients.pose, (s.rates.pose_m, s.rates.pose_rad), (s.max_pose_m, s.max_pose_rad)
            )
        if s.refine_exposure:
            rows = np.empty((level.camera.height_px, 6))
            self.rasterizer.team.run(exposure_gradient, render.image, gradient, keyframe.exposure, rows)
            refine_exposure(keyframe, rows.sum(axis=0), s.rates.exposure)
        self.rasterizer.release(render)
        return loss

    def _loss(
        self,
        render: Render,
        level: PyramidLevel,
        keyframe: StoredKeyframe,
        s: MapperSettings,
        with_ssim: bool,
    ) -> tuple[float, np.ndarray]:
        """Return the loss of a render against a level of a keyframe, and its gradient, float32 [5, H, W]."""
        h, w = level.depth_mm.shape
        if (h, w) not in self._buffers:
            self._buffers[h, w] = np.empty((5, h, w), np.float32), np.empty((h, 2))
        gradient, sums = self._buffers[h, w]
        colour_scale = np.float32((1.0 - s.ssim_weight * with_ssim) / (3 * h * w))
        self.rasterizer.team.run(
            photometric_and_depth, render.image, level.rgb, level.depth_mm, level.depth_weight,
            keyframe.exposure, colour_scale, np.float32(s.depth_weight / (h * w)), gradient, sums,
        )  # fmt: skip
        loss = float(sums[:, 0].sum() * colour_scale + sums[:, 1].sum())
        if len(level.beam_pixels):
            scale = np.float32(s.lidar_weight / len(level.beam_pixels))
            loss += add_lidar(render.image, level.beam_pixels, level.beam_z_m, scale, gradient)
        if with_ssim:
            loss += self._ssim.add(
                render.image, level.rgb, keyframe.exposure, s.ssim_weight, gradient, self.rasterizer.team
            )
        if level.hidden is not None:
            gradient[:, level.hidden] = 0.0
        return loss, gradient


def rate_rows(rates: LearningRates, refining: bool) -> np.ndarray:
    """Return the learning rate of each row of the parameters, float32 [14]."""
    mean_m = rates.refined_mean_m if refining else rates.mean_m
    return learning_rates(mean_m, rates.log_scale, rates.quat, rates.opacity_logit, rates.colour)


def count_votes(
    params: np.ndarray,
    count: int,
    level: PyramidLevel,
    T_map_camera: np.ndarray,
    settings: MapperSettings,
    votes: np.ndarray,
) -> None:
    """Add the carving votes of an image to `votes` int32 [N], for the first `count` Gaussians of `params`."""
    packed = level.camera.packed(inverse(T_map_camera))
    least = np.uint8(255.0 * settings.carve_weight)
    count_carving_votes(
        params, count, packed, level.depth_mm, level.depth_weight, least, settings.carve_margin, votes
    )
