"""The engine of NVIDIA GPUs: Gaussians and optimiser are in device memory.

The same calls give the same bits on the same model of GPU, with the same torch and NVRTC; they differ from
those of the CPU engine in the last digits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from beamsplat.common.engines.device_store import DeviceStore
from beamsplat.common.engines.protocol import EngineIdentity, ImageLoss, MemoryUse, SplatView
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.device_map import DeviceMap
from beamsplat.common.raster.cuda.source import Kernels


class CudaSplatEngine:
    """Implements `SplatEngine`.

    Args:
        kernels: compiled for the device.
        keyframes: number of keyframes whose corrections have room on the device.
        degree: of the spherical harmonics of colours; 0 = none.
    """

    def __init__(self, kernels: Kernels, keyframes: int = 1, degree: int = 0) -> None:
        self._kernels = kernels
        self._map = DeviceMap(kernels, keyframes=keyframes, degree=degree)
        self.store = DeviceStore(self._map.gaussians)

    @property
    def description(self) -> str:
        """Return the device and the memory that is used there."""
        return f"{self._kernels.description}, {self.device_memory.used_bytes / 1e6:.0f} MB"

    @property
    def identity(self) -> EngineIdentity:
        """See `SplatEngine.identity`."""
        version = f"torch {torch.__version__}, kernels {self._kernels.source.revision}"
        return EngineIdentity("cuda", self._kernels.description, version)

    @property
    def workspace_bytes(self) -> int:
        """Nothing is kept in host memory."""
        return 0

    @property
    def device_memory(self) -> MemoryUse:
        """See `SplatEngine.device_memory`. Memory of the driver and of torch's own kernels is not known."""
        m = self._map
        used = m.gaussians.bytes_each * m.gaussians.capacity + m.workspace_bytes
        return MemoryUse(m.fixed_bytes, m.bytes_each, used)

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> np.ndarray:
        """See `SplatEngine.render`."""
        return self._map.picture(camera, T_camera_map)

    def view(self, camera: RasterCamera, T_camera_map: np.ndarray) -> SplatView:
        """See `SplatEngine.view`."""
        image = self._map.picture(camera, T_camera_map)
        return SplatView(image, self._map.visible())

    def render_with(
        self, camera: RasterCamera, T_camera_map: np.ndarray, more: Sequence[np.ndarray]
    ) -> np.ndarray:
        """See `SplatEngine.render_with`."""
        return self._map.picture_with(camera, T_camera_map, more)

    def fit(
        self,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        loss: ImageLoss,
        rates: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray]:
        """See `SplatEngine.fit`. The loss is computed on the host: the image is copied there and back."""
        out = self._map.fit(camera, T_camera_map, loss, rates)
        if rates is not None:
            self.store.changed()
        return out

    def close(self) -> None:
        """See `SplatEngine.close`."""
