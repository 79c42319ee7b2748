"""An analytic textured box room: images and depth from any pose inside, for tests of camera tracking."""

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import inverse, make_transform, so3_exp

CAMERA = Pinhole(140.0, 140.0, 79.5, 59.5, 160, 120)
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.035)
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.5])
_WAVES = np.random.default_rng(5).uniform(1.5, 9.0, (14, 3)) * np.random.default_rng(6).choice(
    [-1, 1], (14, 3)
)
_PHASES = np.random.default_rng(7).uniform(0.0, 6.3, (3, 14))


def body(x_m, y_m, yaw_rad):
    """Return T_map_body of a pose on the floor."""
    return make_transform(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x_m, y_m, 0.0]))


def view(T_map_camera, camera=CAMERA):
    """Return the image uint8 [H, W, 3] and its optical z float32 [H, W]."""
    rays = camera.ray_grid() @ T_map_camera[:3, :3].T
    origin = T_map_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(rays > 0.0, (HIGH - origin) / rays, (LOW - origin) / rays)
    z = np.min(np.where(np.abs(rays) < 1e-12, np.inf, t), axis=-1)
    points = origin + rays * z[..., None]
    waves = points @ _WAVES.T
    colour = np.stack([np.sin(waves + phase).sum(axis=-1) for phase in _PHASES], axis=-1)
    return np.clip(128.0 + 24.0 * colour, 0.0, 255.0).astype(np.uint8), z.astype(np.float32)


def drive(frames, step_m=0.03, turn_rad=0.01):
    """Return T_map_body along an arc that starts at the map's origin."""
    T, out = body(0.0, 0.0, 0.0), []
    for _ in range(frames):
        out.append(T)
        T = T @ body(step_m, 0.0, turn_rad)
    return out


def render_view(T_map_body):
    """Return image and depth of the body's camera."""
    return view(T_map_body @ T_BODY_CAMERA)


def pose_error(T_a, T_b):
    """Return the distance in metres and the angle in radians between two poses."""
    T = inverse(T_a) @ T_b
    angle = np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return float(np.linalg.norm(T[:3, 3])), float(angle)
