"""Decoding of keyframe messages: the mapper's weights are those of the standard deviation without gross errors."""

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Undistorter
from beamsplat.common.geometry.depth_sigma import OF_KEYFRAMES, stated_sigma_log
from beamsplat.common.messages import CameraModel, Keyframe
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.services.mapping.keyframe import compress
from beamsplat.services.mapping.messages import decode_keyframe


def test_gross_errors_do_not_lower_the_weight_of_depth():
    typical = np.tile(np.linspace(0.005, 0.29, 48), (36, 1)).astype(np.float32)
    depth = np.full((36, 48), 2.0, np.float32)
    camera = CameraModel(
        fx_px=40.0, fy_px=40.0, cx_px=23.5, cy_px=17.5, width_px=48, height_px=36, T_body_camera=np.eye(4)
    )
    message = Keyframe(
        stamp_ns=1, id=1, encoding="png", picture=cv2.imencode(".png", np.zeros((36, 48, 3), np.uint8))[1].ravel(),
        camera=camera, anchor_id=0, T_anchor_body=np.eye(4), T_map_anchor=np.eye(4),
        depth=pack_depth(depth),
        sigma=pack_sigma(depth * stated_sigma_log(typical, OF_KEYFRAMES)), why="moved",
    )  # fmt: skip
    decoded = decode_keyframe(message, Undistorter)
    weight = compress(decoded, sigma_unit=0.03).levels[0].depth_weight / 255.0
    # The code rounds sigma by 2.2 %.
    np.testing.assert_allclose(weight, 1.0 / (1.0 + (typical / 0.03) ** 2), atol=0.03)
