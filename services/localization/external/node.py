"""Localization by somebody else: passes on `T_map_body` from a motion capture, a recorded trajectory
or another SLAM."""

from __future__ import annotations

import numpy as np

from beamsplat.common.messages import Correction, ExternalPose, Odometry
from beamsplat.common.runtime.node import Node, Outputs


class ExternalLocalization(Node):
    """Outside poses as they are: the smooth frame is the map, nothing is ever corrected."""

    name = "localization"
    inputs = ("external/pose",)
    outputs = ("localization/odometry", "localization/correction")

    def configure(self) -> None:
        self._introduced = False

    def on_external_pose(self, pose: ExternalPose) -> Outputs:
        """Says once that odom and map are one, then repeats each pose. Its accuracy is not known: NaN."""
        if not self._introduced:
            self._introduced = True
            yield "localization/correction", Correction(stamp_ns=pose.stamp_ns, T_map_odom=np.eye(4))
        covariance = np.full((3, 3), np.nan)
        yield (
            "localization/odometry",
            Odometry(stamp_ns=pose.stamp_ns, T_odom_body=pose.T_map_body, covariance=covariance),
        )
