"""Source `none`: no depth estimate; fusion uses beams and past images only (the MonoGS configuration)."""

from __future__ import annotations

import numpy as np

from beamsplat.services.depth.source import DepthInput, Estimate


class NoDepth:
    """Depth source without an estimate (null object)."""

    def estimate(self, view: DepthInput) -> Estimate:
        """Return a depth map of NaN [H, W], so that fusion uses lidar and past images only."""
        return Estimate(np.full(view.camera.shape, np.nan, dtype=np.float32), "none")
