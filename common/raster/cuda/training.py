"""One step of the mapper on the device: forward, losses, backward, Adam, corrections of pose and exposure.

    view.load(targets)                                # as pack_targets arranges them
    view.begin(camera, T_map_camera, row)             # row of the keyframe in `states`
    view.run(with_ssim=True)                          # nothing waits for the device
    ...                                               # more steps, with other keyframes
    values = losses.read()                            # waits

With CUDA, `run` replays a graph; it is recorded at the first step, and again after tensors have grown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.buffers import RasterBuffers
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.cuda.keyframe_states import KeyframeStates
from beamsplat.common.raster.cuda.source import BLOCK, Kernels, filled
from beamsplat.common.raster.cuda.targets import pixel_bytes
from beamsplat.common.raster.cuda.view import RasterView
from beamsplat.common.raster.ssim import TAPS

_BEAM_BLOCKS = 4  # of 256 pixels with beams each; more pixels are processed by the same threads
_SSIM_BLOCK = 16  # px, side of a block of the SSIM kernels
_BEAM_BYTES = 1 << 16  # room for the beams of a keyframe at the start; grows


@dataclass(frozen=True)
class StepSettings:
    """Weights and rates of a step; names and meanings are those of `services.mapping.settings`."""

    ssim_weight: float = 0.2
    depth_weight: float = 0.15
    lidar_weight: float = 1e-3
    isotropy_weight: float = 0.05
    isotropy_ratio: float = 12.0
    refine_pose: bool = False
    refine_exposure: bool = False
    pose_m: float = 2e-4
    pose_rad: float = 2e-4
    max_pose_m: float = 0.10
    max_pose_rad: float = 0.05
    exposure: float = 1e-3


class LossLog:
    """The losses of the steps since the last `read`, in device memory; only the first `room` are recorded."""

    def __init__(self, kernels: Kernels, room: int = 4096) -> None:
        self.values = torch.zeros(room, dtype=torch.float32, device=kernels.device)
        self.count = torch.zeros(1, dtype=torch.int32, device=kernels.device)

    def read(self) -> np.ndarray:
        """Return the losses float32 [steps] and forget them. Waits for the device."""
        count = min(int(self.count), len(self.values))
        self.count.zero_()
        return self.values[:count].cpu().numpy().copy()


class TrainingView(RasterView):
    """The steps at one image size.

    Args:
        kernels, gaussians, buffers, width_px, height_px: see `RasterView`.
        states: corrections of the keyframes.
        losses: receives the loss of each step.
        settings: weights and rates.

    Attributes:
        tone: float32 [10], exposure of the step: gains and offsets, luma weights after gain, and luma offset.
        pose, exposure: float64 [6], gradients of the last step; zero if they are not refined.
    """

    def __init__(
        self, kernels: Kernels, gaussians: DeviceGaussians, buffers: RasterBuffers, states: KeyframeStates,
        losses: LossLog, settings: StepSettings, width_px: int, height_px: int, with_rows: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(kernels, gaussians, buffers, width_px, height_px, with_rows)
        self.settings = settings
        self.states, self.losses = states, losses
        self.tone = self._zeros(10)
        self.pose, self.exposure = (self._zeros(6, dtype=torch.float64) for _ in range(2))
        self._keyframe = self._zeros(1, dtype=torch.int32)
        self._pixel_blocks = -(-width_px * height_px // BLOCK)
        self._ssim_blocks = -(-width_px // _SSIM_BLOCK) * -(-height_px // _SSIM_BLOCK)
        self._pixel_parts, self._beam_parts = self._zeros(self._pixel_blocks, 2), self._zeros(_BEAM_BLOCKS)
        self._ssim_parts, self._exposure_parts = (
            self._zeros(self._ssim_blocks),
            self._zeros(self._pixel_blocks, 6),
        )
        self._partials = self._zeros(3, height_px, width_px)
        self._taps = torch.from_numpy(TAPS).to(kernels.device)
        self._targets = self._zeros(pixel_bytes(width_px, height_px) + _BEAM_BYTES, dtype=torch.uint8)
        self._graphs: dict[bool, tuple[Any, Any]] = {}

    def set_learning_rates(self, rates: np.ndarray, harmonics: float = 0.0) -> None:
        """Set the learning rate of each parameter row, float32 [14] (see `optimiser.learning_rates`).

        `harmonics` is that of spherical harmonics.
        """
        s = self.settings
        isotropy = s.isotropy_weight / (self.width_px * self.height_px)
        self.set_rates(rates, isotropy, math.log(s.isotropy_ratio), harmonics)

    def load(self, targets: torch.Tensor) -> None:
        """Set the targets of the next steps, uint8 [bytes] as `pack_targets` arranges them, on any device.

        A tensor on the host must be in pinned memory to be copied without waiting, and must not change until
        the copy has been done.
        """
        if len(targets) > len(self._targets):
            self._targets = self._zeros(2 * len(targets), dtype=torch.uint8)
            self._graphs.clear()
        self._targets[: len(targets)].copy_(targets, non_blocking=True)

    def begin(
        self, camera: RasterCamera, T_map_camera: np.ndarray, row: int | None = None,
        exposure: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Set camera and exposure of the next step.

        Args:
            camera: intrinsics at this image size.
            T_map_camera: pose as SLAM estimated it; the correction in `states` is applied to it.
            row: the keyframe's row in `states`; None = no correction, and none is refined.
            exposure: float32 [6], log gains and offsets, used if `row` is None; default: none.
        """
        if (camera.width_px, camera.height_px) != (self.width_px, self.height_px):
            raise ValueError(f"the camera is not of {self.width_px}x{self.height_px} px: {camera}")
        arguments = filled(
            self._kernels.source.structures["BeginArguments"], states=self.states.values, camera=self.camera,
            tone=self.tone, keyframe=self._keyframe, T_map_camera=T_map_camera,
            intrinsics=camera.packed(np.eye(4))[12:], row=-1 if row is None else row,
            exposure=np.zeros(6) if exposure is None else exposure,
        )  # fmt: skip
        self._kernels.launch("begin_step", 1, arguments)

    def run(self, with_ssim: bool = False) -> None:
        """Do one step with the targets, camera and exposure that were set; see `step`."""
        if self._kernels.device.type != "cuda":
            self.step(with_ssim)
            return
        generations = self.prepare()
        recorded = self._graphs.get(with_ssim)
        if recorded is None or recorded[0] != generations:
            recorded = self._graphs[with_ssim] = (generations, self._record(with_ssim))
        recorded[1].replay()

    def _record(self, with_ssim: bool) -> Any:
        device = self._kernels.device
        with torch.cuda.device(device):
            stream = torch.cuda.Stream(device)
            stream.wait_stream(torch.cuda.current_stream(device))
            with torch.cuda.stream(stream):
                self.forward()  # torch loads its kernels at their first call, which a capture does not allow
            torch.cuda.current_stream(device).wait_stream(stream)
            graph = torch.cuda.CUDAGraph()
            pool = self._buffers.graph_pool
            with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
                self.step(with_ssim)
        return graph

    def step(self, with_ssim: bool = False, learn: bool = True) -> None:
        """Launch the kernels of one step: loss and its gradient, Adam, corrections of pose and exposure.

        Args:
            with_ssim: the loss contains the SSIM term.
            learn: change the Gaussians.
        """
        self.forward()
        self.compute_losses(with_ssim)
        self.backward(learn)
        self._finish(with_ssim)

    def compute_losses(self, with_ssim: bool = False) -> None:
        """Write dL/d(image) of the last image to `gradient`, and the sums of the losses."""
        launch, s = self._kernels.launch, self.settings
        pixels = self.width_px * self.height_px
        arguments = filled(
            self._kernels.source.structures["LossArguments"], image=self.image, targets=self._targets,
            tone=self.tone, taps=self._taps, gradient=self.gradient, partials=self._partials,
            pixel_parts=self._pixel_parts, beam_parts=self._beam_parts, ssim_parts=self._ssim_parts,
            exposure_parts=self._exposure_parts, width=self.width_px, height=self.height_px,
            colour_scale=self._colour_scale(with_ssim), depth_scale=s.depth_weight / pixels,
            lidar_weight=s.lidar_weight, ssim_scale=-0.5 * s.ssim_weight / pixels,
        )  # fmt: skip
        launch("pixel_losses", self._pixel_blocks, arguments)
        launch("beam_losses", _BEAM_BLOCKS, arguments)
        if with_ssim:
            launch("ssim_partials", self._ssim_blocks, arguments)
            launch("ssim_gradient", self._ssim_blocks, arguments)
        if s.refine_exposure:
            launch("exposure_sums", self._pixel_blocks, arguments)

    def _colour_scale(self, with_ssim: bool) -> float:
        return (1.0 - self.settings.ssim_weight * with_ssim) / (3 * self.width_px * self.height_px)

    def _finish(self, with_ssim: bool) -> None:
        s, b = self.settings, self._buffers
        arguments = filled(
            self._kernels.source.structures["FinishArguments"], pixel_parts=self._pixel_parts,
            beam_parts=self._beam_parts, ssim_parts=self._ssim_parts, exposure_parts=self._exposure_parts,
            pose_parts=b.pose_parts, pose_gradient=self.pose, exposure_gradient=self.exposure,
            losses=self.losses.values, loss_count=self.losses.count, states=self.states.values,
            keyframe=self._keyframe, pose_rates=(s.pose_m, s.pose_rad), exposure_rate=s.exposure,
            pose_limits=(s.max_pose_m, s.max_pose_rad), colour_scale=self._colour_scale(with_ssim),
            ssim_weight=s.ssim_weight, pixel_blocks=self._pixel_blocks, beam_blocks=_BEAM_BLOCKS,
            ssim_blocks=self._ssim_blocks if with_ssim else 0, pose_blocks=len(b.pose_parts),
            pixels=self.width_px * self.height_px, loss_room=len(self.losses.values),
            with_pose=s.refine_pose, with_exposure=s.refine_exposure,
        )  # fmt: skip
        self._kernels.launch("finish_step", 1, arguments)
