"""A localization node and a depth source of your own, used by a deployment without any change in BeamSplat.

`own_nodes.toml` names them as "module:Class". From this folder:

    beamsplat check own_nodes.toml --set replay.data=DRIVE
    beamsplat offline own_nodes.toml --data DRIVE --out out     # DRIVE: a bag with camera, lidar and wheels
"""

from __future__ import annotations

import numpy as np

from beamsplat import DepthInput, Estimate, Node, NodeConfig, Outputs
from beamsplat.common.messages import Correction, Odometry, WheelOdometry


class DeadReckoningConfig(NodeConfig):
    """Options of the node: keys of its table in the deployment."""

    scale: float = 1.0  # true distance over the distance that the wheels report


class DeadReckoning(Node):
    """Localization by wheel odometry alone."""

    name = "localization"  # the service that it stands for
    Config = DeadReckoningConfig
    inputs = ("wheel/odometry",)
    outputs = ("localization/odometry", "localization/correction")

    def configure(self) -> None:
        self._corrected = False

    def on_wheel_odometry(self, wheels: WheelOdometry) -> Outputs:
        T_odom_body = wheels.T_odom_body.copy()
        T_odom_body[:3, 3] *= self.config.scale
        covariance = np.diag([0.05**2, 0.05**2, 0.02**2])  # x, y, yaw
        yield (
            "localization/odometry",
            Odometry(stamp_ns=wheels.stamp_ns, T_odom_body=T_odom_body, covariance=covariance),
        )
        if not self._corrected:  # the odom frame is the map frame
            self._corrected = True
            yield "localization/correction", Correction(stamp_ns=wheels.stamp_ns, T_map_odom=np.eye(4))


class FloorAndWall:
    """A depth source: the floor as a plane, and one wall across at a fixed distance."""

    def __init__(self, wall_m: float = 3.0) -> None:
        """`wall_m` is an option of the source: `depth.options.wall_m` in the deployment."""
        self._wall_m = wall_m

    def estimate(self, view: DepthInput) -> Estimate:
        rays = view.camera.ray_grid() @ view.T_body_camera[:3, :3].T  # per metre of optical z, body frame
        with np.errstate(divide="ignore"):
            floor = np.where(rays[..., 2] < 0, -view.T_body_camera[2, 3] / rays[..., 2], np.inf)
        return Estimate(np.minimum(floor, self._wall_m).astype(np.float32), kind="metric")
