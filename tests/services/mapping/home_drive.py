"""Keyframes of a drive through the simulator's home with true depth and true poses, as messages: laps as long
as wanted.
"""

from functools import lru_cache

import cv2
import numpy as np
import pytest

pytest.importorskip("trimesh", reason="the simulator needs the [sim] extra")
pytest.importorskip("embreex", reason="the simulator needs the [sim] extra")

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.messages import CameraModel, Keyframe
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.tools.simulator.frames import FrameRenderer
from beamsplat.tools.simulator.recording import frame_spec
from beamsplat.tools.simulator.settings import CameraSettings, SimulationSettings
from beamsplat.tools.simulator.world import get_world

T0 = 1_000_000_000_000
SECOND = 1_000_000_000
SEED = 0


class Home:
    """The drive seen with a small camera. Textures are taken once, however often they are asked for."""

    def __init__(self, width_px, keyframes_a_lap):
        get_world(SEED, None)
        settings = SimulationSettings(
            seed=SEED, camera=CameraSettings(width_px=width_px, height_px=width_px * 3 // 4, jpeg_quality=95)
        )
        self.renderer = FrameRenderer(frame_spec(settings, []))
        self.lap_s = self.renderer.drive.lap_s
        self.keyframes_a_lap = keyframes_a_lap
        K, c = settings.camera.K, settings.camera
        self.camera = RasterCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], c.width_px, c.height_px)
        self.model = CameraModel(width_px=c.width_px, height_px=c.height_px, fx_px=K[0, 0], fy_px=K[1, 1],
                                 cx_px=K[0, 2], cy_px=K[1, 2], T_body_camera=c.T_body_camera)  # fmt: skip
        self._shots = {}

    def time_s(self, number):
        return (number % self.keyframes_a_lap) * self.lap_s / self.keyframes_a_lap

    def T_map_body(self, number):
        return self.renderer.drive.transform_at(self.time_s(number))

    def T_map_camera(self, number):
        return self.renderer.camera_pose(self.time_s(number))

    def shot(self, number):
        """(jpeg uint8 [B], depth png, sigma png) of keyframe `number` of a lap."""
        number %= self.keyframes_a_lap
        if number not in self._shots:
            jpeg, mm, _ = self.renderer.render_frame(self.time_s(number))
            depth = np.where(mm > 0, mm * np.float32(1e-3), np.nan).astype(np.float32)
            sigma = np.full_like(depth, 0.01)
            self._shots[number] = np.frombuffer(jpeg, np.uint8), pack_depth(depth), pack_sigma(sigma)
        return self._shots[number]

    def rgb(self, number):
        """uint8 [H, W, 3]"""
        return cv2.cvtColor(cv2.imdecode(self.shot(number)[0], cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    def keyframe(self, number, anchor=0, stamp_ns=None, T_map_anchor=None):
        """Keyframe `number` of the whole drive, bound to an anchor at the map's origin."""
        jpeg, depth, sigma = self.shot(number)
        T_map_anchor = np.eye(4) if T_map_anchor is None else T_map_anchor
        stamp_ns = T0 + number * SECOND if stamp_ns is None else stamp_ns
        return Keyframe(stamp_ns=stamp_ns, id=stamp_ns, encoding="jpeg", picture=jpeg, camera=self.model,
                        anchor_id=anchor, T_anchor_body=inverse(T_map_anchor) @ self.T_map_body(number),
                        T_map_anchor=T_map_anchor, depth=depth, sigma=sigma)  # fmt: skip


@lru_cache(maxsize=2)
def home(width_px=160, keyframes_a_lap=60):
    return Home(width_px, keyframes_a_lap)


def rendered(mapper, camera, T_map_camera):
    """float32 [3, H, W] of what is in the mapper's memory."""
    return np.clip(mapper.render(camera, T_map_camera)[:3], 0.0, 1.0)


def psnr_db(a, b):
    return float(-10.0 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12)))
