"""Image formation of a moving camera: rolling shutter, motion blur, exposure, white balance, JPEG."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.tools.simulator.camera import ImageSensor
from beamsplat.tools.simulator.render import ActorSnapshot, RayTable, SceneRenderer

PoseAt = Callable[[float], np.ndarray]  # time in s -> T_world_camera float64 [4, 4]

_STRIPS = 8  # parts of an image that a rolling shutter exposes one after another
_BLUR_SAMPLES = 5  # instants of the exposure that are averaged
_LEAST_BLUR_PX = 0.3  # less motion during the exposure is not visible


@dataclass(frozen=True)
class Shutter:
    """Exposure time of each row, and time from the first to the last row (0 = global shutter)."""

    exposure_s: float
    readout_s: float


def render_exposed(
    renderer: SceneRenderer, table: RayTable, pose_at: PoseAt, time_s: float, shutter: Shutter,
    actors: ActorSnapshot | None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Render a view with motion blur and rolling shutter, before the image sensor.

    `time_s` is the time of the middle row. The actors do not move during the exposure.

    Returns:
        Linear radiance float32 [H, W, 3], and depth float32 [H, W] (m) along the optical axis of each row's
        own pose, NaN = no surface.
    """
    height = table.rays.shape[0]
    strips = _STRIPS if shutter.readout_s > 0.0 else 1
    rows = np.linspace(0, height, strips + 1).astype(int)
    radiance, depth = [], []
    for first, stop in pairwise(rows):
        at = time_s + shutter.readout_s * (0.5 * (first + stop) / height - 0.5)
        part = RayTable(table.rays[first:stop], table.rays_x[first:stop], table.rays_y[first:stop])
        view = renderer.render(pose_at(at), part, actors)
        radiance.append(view.radiance)
        depth.append(view.depth_z_m)
    image, z = np.concatenate(radiance), np.concatenate(depth)
    return _blurred(image, z, table.rays, pose_at, time_s, shutter.exposure_s), z


def _blurred(
    radiance: np.ndarray, depth_m: np.ndarray, rays: np.ndarray, pose_at: PoseAt, time_s: float,
    exposure_s: float,
) -> np.ndarray:  # fmt: skip
    """Return the average of the view over the exposure time, float32 [H, W, 3].

    Views at other instants are resampled from this one along the image motion of each pixel's own depth. This
    is exact but for what an edge uncovers.
    """
    h, w = depth_m.shape
    fx, fy = 1.0 / (rays[0, 1, 0] - rays[0, 0, 0]), 1.0 / (rays[1, 0, 1] - rays[0, 0, 1])
    points = rays * np.nan_to_num(depth_m, nan=20.0)[..., None]
    T_world_now = pose_at(time_s)
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    total = np.zeros_like(radiance)
    for offset in np.linspace(-0.5, 0.5, _BLUR_SAMPLES):
        T = (inverse(pose_at(time_s + offset * exposure_s)) @ T_world_now).astype(np.float32)
        moved = points @ T[:3, :3].T + T[:3, 3]
        z = np.maximum(moved[..., 2], 0.05)
        du = fx * (moved[..., 0] / z - rays[..., 0])
        dv = fy * (moved[..., 1] / z - rays[..., 1])
        if offset == -0.5 and max(np.abs(du).max(), np.abs(dv).max()) < _LEAST_BLUR_PX:
            return radiance
        total += cv2.remap(radiance, u - du, v - dv, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / _BLUR_SAMPLES


def develop(
    sensor: ImageSensor, radiance: np.ndarray, gain: float, white_balance: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Return the RGB image uint8 [H, W, 3] of a radiance, as decoded from the sensor's JPEG.

    `white_balance` float [3] are the factors on red, green and blue.
    """
    bgr = sensor.develop((radiance * white_balance).astype(np.float32), gain, rng)
    decoded = cv2.imdecode(np.frombuffer(sensor.jpeg(bgr), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None  # compressed above
    return cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
