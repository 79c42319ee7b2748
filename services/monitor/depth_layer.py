"""Drawing of fused depth and coloured point clouds in rerun.

Entities:
    depth                       the newest fused depth as an image
    map/odom/cloud/<number>     points of a keyframe in the odom frame, so that a loop closure moves them
"""

from __future__ import annotations

import numpy as np
import rerun as rr

from beamsplat.common.geometry.tracks import RateLimit
from beamsplat.services.monitor.rerun_writer import RerunWriter

DEPTH = "depth"
CLOUD = "map/odom/cloud"
_SHRINK = 2  # every second row and column is drawn: a quarter of the data
_RANGE_M = (0.3, 8.0)  # of the colour scale: indoor distances


class DepthLayer:
    """Draws the newest depth image and the point clouds of the newest `clouds` keyframes."""

    def __init__(self, writer: RerunWriter, limits: RateLimit, clouds: int) -> None:
        self._writer = writer
        self._limits = limits
        self._clouds = clouds
        self._drawn = 0

    def depth_is_due(self, stamp_ns: int) -> bool:
        """Return whether the rate limit permits to draw a depth map of this time: only then decode it."""
        return self._limits.due("depth", stamp_ns)

    def depth(self, stamp_ns: int, depth_m: np.ndarray) -> None:
        """Draw a depth map float32 [H, W] (optical z, m); NaN (unknown) is not drawn."""
        small = np.nan_to_num(depth_m[::_SHRINK, ::_SHRINK], nan=0.0)
        drawing = rr.DepthImage(
            np.ascontiguousarray(small), meter=1.0, depth_range=_RANGE_M, colormap="turbo"
        )
        self._writer.log(DEPTH, drawing, stamp_ns=stamp_ns)

    def cloud(self, stamp_ns: int, points_odom_m: np.ndarray, colours: np.ndarray) -> None:
        """Draw the points float32 [N, 3] (odom frame, m) of a keyframe, with colours uint8 [N, 3] (RGB).

        They replace the points of the oldest keyframe once `clouds` keyframes are drawn.
        """
        entity = f"{CLOUD}/{self._drawn % self._clouds}"
        self._drawn += 1
        self._writer.log(entity, rr.Points3D(points_odom_m, colors=colours, radii=0.01), stamp_ns=stamp_ns)
