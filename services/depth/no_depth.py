"""`none`: no dense guess; beams alone carry the depth (the MonoGS configuration)."""

from __future__ import annotations

import numpy as np

from beamsplat.services.depth.source import DepthInput, Estimate


class NoDepth:
    """The null object among depth sources."""

    def estimate(self, view: DepthInput) -> Estimate:
        """All unknown, and that is right."""
        return Estimate(np.full(view.camera.shape, np.nan, dtype=np.float32), "none")
