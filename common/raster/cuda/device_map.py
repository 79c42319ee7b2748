"""The map in device memory: Gaussians, working memory, corrections and one view per image size."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.buffers import RasterBuffers
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.cuda.keyframe_states import KeyframeStates
from beamsplat.common.raster.cuda.source import Kernels
from beamsplat.common.raster.cuda.training import LossLog, StepSettings, TrainingView
from beamsplat.common.raster.cuda.view import RasterView

_MAX_VIEWS = 4  # image sizes other than those of training whose buffers are kept


class DeviceMap:
    """What an engine on a GPU consists of, without policy: which keyframe, how often, and what is inserted.

    Args:
        kernels: compiled for the device (`driver.CudaKernels`; in tests the CPU build).
        settings: weights and rates of the steps.
        keyframes: number of keyframes whose corrections have room in `states`.
        capacity, pairs: room for Gaussians and pairs at the start; both grow.
        degree: of the spherical harmonics of colours; 0 = none.
    """

    def __init__(
        self, kernels: Kernels, settings: StepSettings | None = None, *, keyframes: int = 800,
        capacity: int = 4096, pairs: int = 1 << 16, degree: int = 0,
    ) -> None:  # fmt: skip
        self.kernels = kernels
        self.settings = settings or StepSettings()
        self.gaussians = DeviceGaussians(kernels, capacity, degree)
        self.buffers = RasterBuffers(kernels, pairs)
        self.states = KeyframeStates(kernels, keyframes)
        self.losses = LossLog(kernels)
        self._training: dict[tuple[int, int], TrainingView] = {}
        self._views: dict[tuple[int, int], RasterView] = {}

    def use(self, settings: StepSettings) -> None:
        """Use other weights and rates from the next step on; graphs are recorded anew."""
        self.settings = settings
        self._training.clear()

    def training_view(self, width_px: int, height_px: int) -> TrainingView:
        """Return the view for steps at an image size, created at the first call."""
        size = (width_px, height_px)
        if size not in self._training:
            self._training[size] = TrainingView(
                self.kernels, self.gaussians, self.buffers, self.states, self.losses, self.settings, *size
            )
        return self._training[size]

    def picture(
        self, camera: RasterCamera, T_camera_map: np.ndarray, background: np.ndarray | None = None
    ) -> np.ndarray:
        """Render an image float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha.

        Waits for the device. If pairs are dropped, enlarges their capacity and renders the image again.
        """
        view = self._view(camera.width_px, camera.height_px)
        view.set_camera(camera, T_camera_map)
        image = view.forward()
        while self.buffers.grow():
            image = view.forward()
        out = image.cpu().numpy().copy()
        if background is not None:
            out[:3] += (1.0 - out[4]) * np.asarray(background, np.float32)[:, None, None]
        return out

    def visible(self) -> np.ndarray:
        """Return the columns of the Gaussians that overlap the image rendered last, int32 [V] ascending.

        Waits for the device.
        """
        overlapping = self.buffers.pair_count[: self.gaussians.count] > 0
        return torch.nonzero(overlapping)[:, 0].to(torch.int32).cpu().numpy()

    def picture_with(
        self, camera: RasterCamera, T_camera_map: np.ndarray, more: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Render as `picture` does, with further Gaussians float32 [14, N] each.

        Neither they nor buffers for an image of this size stay.
        """
        count, tiles, size = self.gaussians.count, self.buffers.tiles, (camera.width_px, camera.height_px)
        known = size in self._training or size in self._views
        try:
            for part in more:
                self.gaussians.append(part)
            return self.picture(camera, T_camera_map)
        finally:
            self.gaussians.truncate(count)
            if not known:
                self._views.pop(size, None)
            self.buffers.release_tiles(tiles)

    def fit(
        self, camera: RasterCamera, T_camera_map: np.ndarray, loss: Callable[[np.ndarray, np.ndarray], float],
        rates: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray]:  # fmt: skip
        """Go back from a loss that the host computes; with `rates` [14], take a step of Adam.

        Args:
            loss: receives the image float32 [5, H, W] and fills an array of its shape with dL/d(image).

        Returns:
            The loss, and dL/d(rho, phi) float64 [6], left perturbation of T_camera_map.
        """
        image = self.picture(camera, T_camera_map)
        gradient = np.empty_like(image)
        value = loss(image, gradient)
        view = self._view(camera.width_px, camera.height_px)
        view.gradient.copy_(torch.from_numpy(gradient))
        if rates is not None:
            view.set_rates(rates)
        view.backward(learn=rates is not None)
        return value, view.pose_gradient().cpu().numpy()

    def _view(self, width_px: int, height_px: int) -> RasterView:
        size = (width_px, height_px)
        if size in self._training:
            return self._training[size]
        view = self._views.pop(size, None) or RasterView(self.kernels, self.gaussians, self.buffers, *size)
        self._views[size] = view  # the last one is the one used last
        if len(self._views) > _MAX_VIEWS:
            del self._views[next(iter(self._views))]
        return view

    def grow(self) -> bool:
        """Enlarge the capacity of pairs if a step since the last call needed more; return whether it did.

        Waits for the device: call it once per keyframe.
        """
        return self.buffers.grow()

    @property
    def bytes_each(self) -> int:
        """Memory of one Gaussian in all tensors and buffers, and in a tensor's copy while it grows, bytes."""
        g = self.gaussians
        largest = max(getattr(g, name).nbytes for name in g.arrays)
        return g.bytes_each + self.buffers.bytes_each + largest // g.capacity

    @property
    def fixed_bytes(self) -> int:
        """Memory that does not depend on the number of Gaussians, as far as it is allocated now, bytes."""
        return self.workspace_bytes - self.buffers.bytes_each * self.buffers.gaussians

    @property
    def workspace_bytes(self) -> int:
        """Memory of everything but the Gaussians, bytes."""
        views = sum(view.allocated_bytes for view in (*self._training.values(), *self._views.values()))
        return self.buffers.allocated_bytes + self.states.values.nbytes + self.losses.values.nbytes + views

    def synchronize(self) -> None:
        """Wait until the device has done all that was launched."""
        if self.kernels.device.type == "cuda":
            torch.cuda.synchronize(self.kernels.device)
