"""The mapper's engine of NVIDIA GPUs: the Gaussians, the optimiser and the losses are in device memory.

A step is one CUDA graph; the host waits once per plan. Insertion is computed on the host, from one render
per keyframe.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from beamsplat.common.engines.cuda import CudaSplatEngine
from beamsplat.common.engines.protocol import MemoryUse
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.cuda.keyframe_states import FIELDS
from beamsplat.common.raster.cuda.source import Kernels
from beamsplat.common.raster.cuda.target_cache import TargetCache
from beamsplat.common.raster.cuda.targets import pack_targets
from beamsplat.common.raster.cuda.training import StepSettings
from beamsplat.services.mapping.engines.cpu import rate_rows
from beamsplat.services.mapping.engines.protocol import OptimiserStep
from beamsplat.services.mapping.keyframe import PyramidLevel, StoredKeyframe
from beamsplat.services.mapping.settings import LearningRates, MapperSettings

_BATCH = 4096  # steps between two waits for the device, at most
_TARGETS_BYTES = 512 << 20  # of keyframes in device memory: about 200 of 640x480 px
_TARGETS_SHARE = 0.25  # of a budget of device memory, at most, for keyframes


class CudaEngine(CudaSplatEngine):
    """Implements `Engine`.

    Args:
        kernels: compiled for the device.
        budget_bytes: device memory that may be used, which the pager of the session keeps; None = all.
        degree: of the spherical harmonics of colours; 0 = none.
    """

    def __init__(self, kernels: Kernels, budget_bytes: float | None = None, degree: int = 0) -> None:
        super().__init__(kernels, keyframes=_BATCH, degree=degree)
        self.device_budget_bytes = budget_bytes
        most = _TARGETS_BYTES if budget_bytes is None else min(_TARGETS_BYTES, _TARGETS_SHARE * budget_bytes)
        self._targets = TargetCache(kernels, int(most))  # by keyframe and size
        # Whose targets they are: a keyframe that is read from disk again has new levels.
        self._levels: dict[tuple[int, int], weakref.ref[PyramidLevel]] = {}
        self._rates: dict[tuple[int, int], tuple[LearningRates, bool]] = {}  # set in the views, by image size

    @property
    def device_memory(self) -> MemoryUse:
        """See `SplatEngine.device_memory`. What keyframes may take is fixed, also while they take less."""
        splats = super().device_memory
        return MemoryUse(
            splats.fixed_bytes + self._targets.budget_bytes, splats.bytes_each,
            splats.used_bytes + self._targets.held_bytes,
        )  # fmt: skip

    def optimise(
        self,
        steps: Sequence[OptimiserStep],
        T_map_anchor: Mapping[int, np.ndarray],
        settings: MapperSettings,
        must_stop: Callable[[], bool],
    ) -> list[float]:
        """See `Engine.optimise`."""
        self._use(settings)
        losses: list[float] = []
        for first in range(0, len(steps), _BATCH):
            batch = steps[first : first + _BATCH]
            done = self._batch(batch, T_map_anchor, settings, must_stop)
            losses += done
            if len(done) < len(batch):
                break
        return losses

    def vote_carving(self, level: PyramidLevel, T_map_camera: np.ndarray, settings: MapperSettings) -> None:
        """See `Engine.vote_carving`."""
        camera, targets = level.camera, torch.from_numpy(_packed(level)).to(self._kernels.device)
        self._map.gaussians.vote_carving(
            targets, camera.packed(inverse(T_map_camera)), (camera.width_px, camera.height_px),
            int(255.0 * settings.carve_weight), settings.carve_margin,
        )  # fmt: skip
        self.store.changed()

    def forget(self, id: int) -> None:
        """See `Engine.forget`."""
        for key in [key for key in self._levels if key[0] == id]:
            del self._levels[key]
            self._targets.forget(key)

    def close(self) -> None:
        """See `SplatEngine.close`."""
        for id in {key[0] for key in self._levels}:
            self.forget(id)

    def _use(self, settings: MapperSettings) -> None:
        r = settings.rates
        step = StepSettings(
            ssim_weight=settings.ssim_weight, depth_weight=settings.depth_weight,
            lidar_weight=settings.lidar_weight, isotropy_weight=settings.isotropy_weight,
            isotropy_ratio=settings.isotropy_ratio, refine_pose=settings.refine_pose,
            refine_exposure=settings.refine_exposure, pose_m=r.pose_m, pose_rad=r.pose_rad,
            max_pose_m=settings.max_pose_m, max_pose_rad=settings.max_pose_rad, exposure=r.exposure,
        )  # fmt: skip
        if step != self._map.settings:
            self._map.use(step)
            self._rates.clear()

    def _batch(
        self,
        steps: Sequence[OptimiserStep],
        T_map_anchor: Mapping[int, np.ndarray],
        settings: MapperSettings,
        must_stop: Callable[[], bool],
    ) -> list[float]:
        keyframes = {step.keyframe.id: step.keyframe for step in steps}
        rows = {id: row for row, id in enumerate(keyframes)}
        self._map.states.write(list(rows.values()), [_state(keyframe) for keyframe in keyframes.values()])
        targets = self._targets_of(steps[0])
        for number, step in enumerate(steps):
            if must_stop():
                break
            self._launch(step, targets, T_map_anchor, settings, rows[step.keyframe.id])
            if number + 1 < len(steps):  # copied to the device while this step runs
                targets = self._targets_of(steps[number + 1])
        losses = self._map.losses.read()  # waits
        for keyframe, state in zip(keyframes.values(), self._map.states.read(list(rows.values()))):
            _set_state(keyframe, state)
        self._map.grow()
        self.store.changed()
        return losses.astype(float).tolist()

    def _launch(
        self,
        step: OptimiserStep,
        targets: torch.Tensor,
        T_map_anchor: Mapping[int, np.ndarray],
        settings: MapperSettings,
        row: int,
    ) -> None:
        keyframe, level = step.keyframe, step.keyframe.levels[step.size]
        size = level.camera.width_px, level.camera.height_px
        view = self._map.training_view(*size)
        if self._rates.get(size) != (settings.rates, step.refining):
            view.set_learning_rates(rate_rows(settings.rates, step.refining), settings.rates.harmonics)
            self._rates[size] = settings.rates, step.refining
        view.load(targets)
        view.begin(level.camera, T_map_anchor[keyframe.anchor] @ keyframe.T_anchor_camera, row)
        view.run(step.with_ssim)

    def _targets_of(self, step: OptimiserStep) -> torch.Tensor:
        level, key = step.keyframe.levels[step.size], (step.keyframe.id, step.size)
        known = self._levels.get(key)
        if known is None or known() is not level:
            self._targets.forget(key)
            self._levels[key] = weakref.ref(level)
        return self._targets.get(key, lambda: _packed(level))


def _packed(level: PyramidLevel) -> np.ndarray:
    return pack_targets(
        level.rgb, level.depth_mm, level.depth_weight, level.hidden, level.beam_pixels, level.beam_z_m
    )


def _state(keyframe: StoredKeyframe) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(keyframe, name), np.float64) for name in FIELDS}


def _set_state(keyframe: StoredKeyframe, state: dict[str, np.ndarray]) -> None:
    for name, value in state.items():
        old = getattr(keyframe, name)
        setattr(keyframe, name, int(value) if isinstance(old, int) else value.astype(old.dtype))
