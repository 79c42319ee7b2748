"""A long gallery: a painting every three metres, each observed from two metres by exactly one keyframe."""

from functools import lru_cache

import cv2
import numpy as np

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.common.messages import CameraModel, Keyframe
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.common.raster.camera import RasterCamera
from tests.services.mapping.session.maps import SECOND

T0 = 1_000_000_000_000
WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
CAMERA = RasterCamera(FOCAL, FOCAL, 47.5, 35.5, WIDTH, HEIGHT)
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.4)
MODEL = CameraModel(width_px=WIDTH, height_px=HEIGHT, fx_px=FOCAL, fy_px=FOCAL, cx_px=47.5, cy_px=35.5,
                    T_body_camera=T_BODY_CAMERA)  # fmt: skip
PLACES_AN_ANCHOR = 4


def T_map_body(place):
    return make_transform(np.eye(3), np.array([0.0, 3.0 * place, 0.0]))


def T_map_camera(place):
    return T_map_body(place) @ T_BODY_CAMERA


@lru_cache(maxsize=128)
def painting(place):
    """uint8 [H, W, 3]"""
    blots = np.random.default_rng(place).uniform(20, 235, (9, 12, 3)).astype(np.float32)
    return cv2.resize(blots, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def message(number, places=40):
    """Return keyframe `number`, in front of painting `number % places`."""
    place = number % places
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    anchor = place // PLACES_AN_ANCHOR
    T_map_anchor = T_map_body(anchor * PLACES_AN_ANCHOR)
    png = cv2.imencode(".png", cv2.cvtColor(painting(place), cv2.COLOR_RGB2BGR))[1].ravel()
    stamp_ns = T0 + number * SECOND
    return Keyframe(stamp_ns=stamp_ns, id=stamp_ns, encoding="png", picture=png, camera=MODEL, anchor_id=anchor,
                    T_anchor_body=inverse(T_map_anchor) @ T_map_body(place), T_map_anchor=T_map_anchor,
                    depth=pack_depth(depth), sigma=pack_sigma(np.full_like(depth, 0.01)))  # fmt: skip
