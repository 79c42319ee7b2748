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

from beamsplat.common.engines.protocol import SplatEngine
from beamsplat.services.mapping.keyframe import PyramidLevel, StoredKeyframe
from beamsplat.services.mapping.settings import MapperSettings


class OptimiserStep(NamedTuple):
    """One step of the optimiser on one keyframe, as the mapper has drawn it."""

    keyframe: StoredKeyframe
    size: int  # index of `StoredKeyframe.levels`
    with_ssim: bool
    refining: bool  # with the lower step size of the centres


class Engine(SplatEngine, Protocol):
    """Renders the Gaussians of `store`, and optimises them on keyframes."""

    device_budget_bytes: float | None  # of the device's own memory; None = no limit, or there is none

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

    def forget(self, id: int) -> None:
        """Free what the engine holds of a keyframe that is no longer in memory."""
        ...
