"""The interface between the mapper and the device that computes for it.

The mapper decides: which keyframes, how many steps, what to refuse, where anchors are, random numbers,
sessions. An engine computes: it holds the Gaussians with their optimiser state, renders, and optimises. Only
numpy arrays cross the border, and the mapper plans many steps at once, so that a device is waited for once
per plan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.keyframe import PyramidLevel, StoredKeyframe
from beamsplat.services.mapping.settings import MapperSettings


class OptimiserStep(NamedTuple):
    """One step of the optimiser on one keyframe, as the mapper has drawn it."""

    keyframe: StoredKeyframe
    size: int  # index of `StoredKeyframe.levels`
    with_ssim: bool
    refining: bool  # with the lower step size of the centres


class Engine(Protocol):
    """Renders and optimises the Gaussians of `store`."""

    @property
    def description(self) -> str:
        """Return the device, for the status; the bits of the map depend on it."""
        ...

    @property
    def store(self) -> GaussianStore:
        """Return the Gaussians."""
        ...

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> np.ndarray:
        """Return the map as float32 [5, H, W]: red, green, blue, accumulated depth (m), alpha."""
        ...

    def optimise(
        self,
        steps: Sequence[OptimiserStep],
        T_map_anchor: Mapping[int, np.ndarray],  # float64 [4, 4]
        settings: MapperSettings,
        must_stop: Callable[[], bool],
    ) -> list[float]:
        """Do the steps in order and return their losses.

        Poses and exposures of the keyframes are refined on the way if the settings say so; they are up to
        date in the keyframes when this returns.

        Args:
            must_stop: asked once before each step; True ends them early, and the list of losses is shorter.
        """
        ...

    def vote_carving(self, level: PyramidLevel, T_map_camera: np.ndarray, settings: MapperSettings) -> None:
        """Add 1 to the carving votes of each Gaussian in front of a trusted surface of the image."""
        ...

    @property
    def workspace_bytes(self) -> int:
        """Return the size of the buffers for rendering and losses in host memory, in bytes."""
        ...

    def forget(self, id: int) -> None:
        """Free what the engine holds of a keyframe that is no longer in memory."""
        ...

    def close(self) -> None:
        """Free threads and device memory."""
        ...
