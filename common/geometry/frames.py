"""The robot's coordinate frames, and the transforms of sensors mounted on the body.

map     world-fixed; `T_map_odom` jumps at a loop closure
odom    world-fixed; the body moves smoothly in it, with drift
body    x forward, y left, z up, origin on the floor between the wheels
lidar   like body, at the sensor
camera  x right, y down, z forward (optical)
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.geometry.transforms import make_transform, so3_exp

# Rotation of the optical frame of a level, forward-looking camera. The columns are the camera's x (right),
# y (down) and z (forward) axes in the body frame.
R_body_camera_level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_mount(
    x_m: float, y_m: float, z_m: float, *, pitch_down_rad: float = 0.0, yaw_left_rad: float = 0.0
) -> np.ndarray:
    """Return `T_body_camera` [4, 4] from the camera's measured position and viewing direction.

    Args:
        x_m: position of the camera centre in the body frame, forward.
        y_m: to the left.
        z_m: above the floor.
        pitch_down_rad: rotates the view towards the floor.
        yaw_left_rad: rotates the view to the left.
    """
    R_body = so3_exp([0.0, 0.0, yaw_left_rad]) @ so3_exp([0.0, pitch_down_rad, 0.0])
    return make_transform(R_body @ R_body_camera_level, np.array([x_m, y_m, z_m]))


def lidar_mount(x_m: float, y_m: float, z_m: float, *, yaw_left_rad: float = 0.0) -> np.ndarray:
    """Return `T_body_lidar` [4, 4] of an upright planar lidar from its measured position and yaw."""
    return make_transform(so3_exp([0.0, 0.0, yaw_left_rad]), np.array([x_m, y_m, z_m]))
