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
from beamsplat.common.harmonics.kernels import shade, shade_backward
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import PARAMS
from beamsplat.common.raster.rasterizer import Gradients, Rasterizer, Render


class CpuSplatEngine:
    """Implements `SplatEngine`. The same calls give the same bits, with any number of threads."""

    def __init__(self, threads: int = 1, degree: int = 0) -> None:
        """`degree` is that of the spherical harmonics of colours; 0 = none."""
        self.description = f"CPU, {threads} thread{'s' * (threads > 1)}"
        self.store = GaussianStore(degree=degree)
        self.rasterizer = Rasterizer(threads)
        self._shown = np.zeros((PARAMS, 0), np.float32)  # parameters with colours as a camera sees them
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
        params, count = self._shown_params(T_camera_map), self.store.count
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
        self._harmonics_backward(gradients, T_camera_map, 0.0)
        if rates is not None:
            self.store.step(self.rasterizer.team, gradients, rates)
        pose = gradients.pose.copy()
        self.rasterizer.release(render)
        return value, pose

    @property
    def workspace_bytes(self) -> int:
        """See `SplatEngine.workspace_bytes`."""
        gradients = sum(array.nbytes for array in self._gradients.values())
        return self.rasterizer.allocated_bytes + self._shown.nbytes + gradients

    @property
    def device_memory(self) -> None:
        """All is in host memory."""
        return None

    def close(self) -> None:
        """See `SplatEngine.close`."""
        self.rasterizer.close()

    def _render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> Render:
        params = self._shown_params(T_camera_map)
        return self.rasterizer.render(params, self.store.count, camera, T_camera_map)

    def _shown_params(self, T_camera_map: np.ndarray) -> np.ndarray:
        """Return the parameters with the colours that a camera sees."""
        store = self.store
        if not store.degree:
            return store.params
        if self._shown.shape != store.params.shape:
            self._shown = np.empty_like(store.params)
        np.copyto(self._shown, store.params)
        shade(store.params, store.harmonics, store.count, _centre(T_camera_map), self._shown)
        return self._shown

    def _harmonics_backward(self, gradients: Gradients, T_camera_map: np.ndarray, rate: float) -> None:
        """Add what colours depend on to the gradients; with a rate above 0, optimise the harmonics."""
        store = self.store
        if not store.degree:
            return
        of_centre = np.zeros(3)
        shade_backward(
            store.params, store.harmonics, store.harmonics_first, store.harmonics_second, store.steps,
            gradients.index, gradients.by_splat, _centre(T_camera_map), rate, of_centre,
        )  # fmt: skip
        # A left perturbation (rho, phi) of T_camera_map moves the centre by -R^T rho.
        gradients.pose[:3] -= T_camera_map[:3, :3] @ of_centre


def _centre(T_camera_map: np.ndarray) -> np.ndarray:
    return -T_camera_map[:3, :3].T @ T_camera_map[:3, 3]


@functools.cache
def _revision() -> str:
    """Return what the bits of the rasterizer depend on: the version of Numba, a digest of its sources."""
    sources = sorted(Path(raster.__file__).parent.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    return f"numba {numba.__version__}, kernels {digest[:12]}"
