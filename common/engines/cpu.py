"""The engine of the CPU: compiled Numba kernels on numpy arrays."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Sequence
from pathlib import Path

import numba
import numpy as np

from beamsplat.common import raster
from beamsplat.common.engines.protocol import EngineIdentity, ImageLoss, SplatView
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer, Render


class CpuSplatEngine:
    """Implements `SplatEngine`. The same calls give the same bits, with any number of threads."""

    def __init__(self, threads: int = 1) -> None:
        self.description = f"CPU, {threads} thread{'s' * (threads > 1)}"
        self.store = GaussianStore()
        self.rasterizer = Rasterizer(threads)
        self._gradients: dict[tuple[int, ...], np.ndarray] = {}  # by shape of the image

    @property
    def identity(self) -> EngineIdentity:
        """See `SplatEngine.identity`."""
        return EngineIdentity("cpu", platform.machine(), _revision())

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> np.ndarray:
        """See `SplatEngine.render`."""
        return self.view(camera, T_camera_map).image

    def view(self, camera: RasterCamera, T_camera_map: np.ndarray) -> SplatView:
        """See `SplatEngine.view`."""
        render = self._render(camera, T_camera_map)
        out = SplatView(render.image.copy(), render.index.copy())
        self.rasterizer.release(render)
        return out

    def render_with(
        self, camera: RasterCamera, T_camera_map: np.ndarray, more: Sequence[np.ndarray]
    ) -> np.ndarray:
        """See `SplatEngine.render_with`."""
        params, count = self.store.params, self.store.count
        if more:
            whole = np.concatenate([params[:, :count], *more], axis=1)
            count = whole.shape[1]
            params = np.pad(whole, ((0, 0), (0, -count % 16)))
        # A rasterizer of its own: that of the engine would keep buffers for the largest image ever asked for.
        return Rasterizer(1).render(params, count, camera, T_camera_map).image

    def fit(
        self,
        camera: RasterCamera,
        T_camera_map: np.ndarray,
        loss: ImageLoss,
        rates: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray]:
        """See `SplatEngine.fit`."""
        render = self._render(camera, T_camera_map)
        shape = render.image.shape
        if shape not in self._gradients:
            self._gradients[shape] = np.empty(shape, np.float32)
        gradient = self._gradients[shape]
        value = loss(render.image, gradient)
        gradients = self.rasterizer.backward(render, gradient)
        if rates is not None:
            self.store.step(self.rasterizer.team, gradients, rates)
        pose = gradients.pose.copy()
        self.rasterizer.release(render)
        return value, pose

    @property
    def workspace_bytes(self) -> int:
        """See `SplatEngine.workspace_bytes`."""
        return self.rasterizer.allocated_bytes + sum(array.nbytes for array in self._gradients.values())

    @property
    def device_memory(self) -> None:
        """All is in host memory."""
        return None

    def close(self) -> None:
        """See `SplatEngine.close`."""
        self.rasterizer.close()

    def _render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> Render:
        return self.rasterizer.render(self.store.params, self.store.count, camera, T_camera_map)


@functools.cache
def _revision() -> str:
    """Return what the bits of the rasterizer depend on: the version of Numba, a digest of its sources."""
    sources = sorted(Path(raster.__file__).parent.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    return f"numba {numba.__version__}, kernels {digest[:12]}"
