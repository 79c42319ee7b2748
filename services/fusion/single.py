"""One correction for the whole picture, without memory: the paper's ratio, an affine fit, or none at all."""

from __future__ import annotations

from typing import Literal

import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.fusion.frame import Frame
from beamsplat.services.fusion.health import PictureHealth
from beamsplat.services.fusion.result import Fused, refusal
from beamsplat.services.fusion.scaling import affine, as_depth, ratio

SingleMethod = Literal["ratio", "affine", "given"]
_GIVEN_SIGMA = 0.3  # relative: nobody has looked whether the guess is right


class SingleCorrection:
    """In the place of `Fusion` where a deployment asks for the paper's way; `given` takes the guess's word
    for it, for robots without a lidar."""

    def __init__(self, camera: Pinhole, T_body_camera: np.ndarray, method: SingleMethod) -> None:
        self._camera, self._T_body_camera, self._method = camera, T_body_camera, method
        self._health = PictureHealth()

    def add_scan(self, points_map_m: np.ndarray) -> None:
        """Scans are of no use beyond their moment."""

    def fuse(self, frame: Frame, *, keyframe: bool) -> Fused:
        """Depth of one picture; keyframes are no different."""
        status = self._health.judge(frame.image_rgb, frame.T_map_body)
        if status != "ok":
            return refusal(self._camera.shape, status)
        if frame.guess is None:
            return refusal(self._camera.shape, "there is no depth guess to correct")
        if self._method == "given":
            depth = as_depth(frame.guess, frame.guess_kind).astype(np.float32)
            return Fused(depth, np.float32(_GIVEN_SIGMA) * depth, scale=1.0)
        uv, z, _ = project_beams(frame.beams, self._camera, self._T_body_camera)
        correct = ratio if self._method == "ratio" else affine
        return correct(frame.guess, frame.guess_kind, uv, z)
