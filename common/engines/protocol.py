"""The interface to the device that holds, renders and optimises Gaussians.

Only numpy arrays cross it. The mapper needs more of an engine (services/mapping/engines); what is here is
enough for the camera tracker.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera

# Arguments: float32 [5, H, W], the render: red, green, blue, accumulated depth (m), alpha; and an array of
# that shape, which is to be filled with dL/d(image). Result: the loss L.
ImageLoss = Callable[[np.ndarray, np.ndarray], float]


class SplatView(NamedTuple):
    """A render, and what may be seen in it."""

    image: np.ndarray  # float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha
    visible: np.ndarray  # int32 [V], ascending: columns of the store; no other Gaussian contributes


@dataclass(frozen=True)
class EngineIdentity:
    """What computed a map: its bits depend on it. Saved with the map."""

    name: str  # "cpu" or "cuda"
    device: str
    version: str  # of the compiler and of the kernels

    def __str__(self) -> str:
        return f"{self.name} ({self.device}; {self.version})"


def identity_in(manifest: Mapping[str, Any]) -> EngineIdentity | None:
    """Return the engine that a session's manifest names (field "engine"); None: it is of an older program."""
    try:
        return EngineIdentity(**{name: str(value) for name, value in manifest["engine"].items()})
    except (KeyError, TypeError, AttributeError):
        return None


@dataclass(frozen=True)
class MemoryUse:
    """Memory that an engine takes on its device, in bytes."""

    fixed_bytes: int  # does not depend on the number of Gaussians
    bytes_each: int  # of one Gaussian, at most: with its share of buffers and of copies while arrays grow
    used_bytes: int  # in all, now


class SplatEngine(Protocol):
    """Renders and optimises the Gaussians of `store`."""

    @property
    def description(self) -> str:
        """Return the device and the memory that is used there, for the status."""
        ...

    @property
    def identity(self) -> EngineIdentity:
        """Return device and versions."""
        ...

    @property
    def store(self) -> GaussianStore:
        """Return the Gaussians."""
        ...

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> np.ndarray:
        """Return the map as float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha."""
        ...

    def view(self, camera: RasterCamera, T_camera_map: np.ndarray) -> SplatView:
        """Return the map as a camera sees it, with the Gaussians that may be seen."""
        ...

    def render_with(
        self, camera: RasterCamera, T_camera_map: np.ndarray, more: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Return the map with further Gaussians `more` (float32 [14, N] each), as `render` does.

        The store stays as it is, and no buffers for this image size are kept: for images of any size.
        """
        ...

    def fit(
        self,
        camera: RasterCamera,
        T_camera_map: np.ndarray,  # float64 [4, 4]
        loss: ImageLoss,
        rates: np.ndarray | None = None,  # float32 [14], see `optimiser.learning_rates`
    ) -> tuple[float, np.ndarray]:
        """Render, and go back from a loss of the image to the Gaussians; with `rates`, take a step of Adam.

        Returns:
            The loss, and dL/dxi float64 [6] for a left perturbation xi = (rho, phi) of T_camera_map.
        """
        ...

    @property
    def workspace_bytes(self) -> int:
        """Return the size of the buffers for rendering and losses in host memory, in bytes."""
        ...

    @property
    def device_memory(self) -> MemoryUse | None:
        """Return what is used of the device's own memory; None if the engine computes in host memory."""
        ...

    def close(self) -> None:
        """Free threads and device memory."""
        ...
