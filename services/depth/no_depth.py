"""Source `none`: no depth estimate; depth comes from beams and past images (the MonoGS configuration)."""

from __future__ import annotations

import numpy as np

from beamsplat.services.depth.source import DepthInput, Estimate


class NoDepth:
    """Depth source that estimates nothing (null object)."""

    def estimate(self, view: DepthInput) -> Estimate:
        """Return a depth map of NaN: this source estimates nothing, and fusion uses lidar and past images."""
        return Estimate(np.full(view.camera.shape, np.nan, dtype=np.float32), "none")
