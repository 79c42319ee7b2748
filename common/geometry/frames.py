"""The frames of the robot, by name, and the one rotation everybody gets wrong once.

map     world-fixed; `T_map_odom` may jump when a loop closes
odom    world-fixed and smooth; drifts
body    x forward, y left, z up, origin on the floor between the wheels
lidar   like body, at the sensor
camera  x right, y down, z forward (optical)
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.transforms import make_transform, so3_exp

# Columns are the camera's x, y, z axes in a body-like frame (right, down, forward).
R_body_camera_level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_mount(
    x_m: float, y_m: float, z_m: float, *, pitch_down_rad: float = 0.0, yaw_left_rad: float = 0.0
) -> np.ndarray:
    """`T_body_camera` [4, 4] of a camera on the body, as one measures it with a tape.

    `pitch_down_rad` tilts the view towards the floor, `yaw_left_rad` turns it to the left.
    """
    R_body = so3_exp([0.0, 0.0, yaw_left_rad]) @ so3_exp([0.0, pitch_down_rad, 0.0])
    return make_transform(R_body @ R_body_camera_level, np.array([x_m, y_m, z_m]))


def lidar_mount(x_m: float, y_m: float, z_m: float, *, yaw_left_rad: float = 0.0) -> np.ndarray:
    """`T_body_lidar` [4, 4] of an upright planar lidar."""
    return make_transform(so3_exp([0.0, 0.0, yaw_left_rad]), np.array([x_m, y_m, z_m]))
