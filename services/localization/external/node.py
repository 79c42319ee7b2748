"""Localization from an external source: republishes `T_map_body` of a motion capture system, a recorded
trajectory or another SLAM."""

from __future__ import annotations

import numpy as np

from beamsplat.common.messages import Correction, ExternalPose, Odometry
from beamsplat.common.runtime.node import Node, Outputs


class ExternalLocalization(Node):
    """Localization service that republishes external poses; the map and odom frames are identical."""

    name = "localization"
    inputs = ("external/pose",)
    outputs = ("localization/odometry", "localization/correction")

    def configure(self) -> None:
        self._correction_published = False

    def on_external_pose(self, pose: ExternalPose) -> Outputs:
        """Publish the pose as T_odom_body with covariance NaN (unknown), and once T_map_odom = identity."""
        if not self._correction_published:
            self._correction_published = True
            yield "localization/correction", Correction(stamp_ns=pose.stamp_ns, T_map_odom=np.eye(4))
        covariance = np.full((3, 3), np.nan)
        yield (
            "localization/odometry",
            Odometry(stamp_ns=pose.stamp_ns, T_odom_body=pose.T_map_body, covariance=covariance),
        )
