"""Fusion image by image with one correction of the whole image: the paper's ratio, an affine fit, or none."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.depth_sigma import OF_KEYFRAMES, stated_sigma_log
from beamsplat.services.fusion.input_checks import ImageCheck
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.result import FusionResult, rejected
from beamsplat.services.fusion.scaling import affine, as_depth, ratio

SingleMethod = Literal["ratio", "affine", "given"]
_GIVEN_SIGMA = 0.3  # typical relative sigma of an estimate that nothing has checked


class SingleImageFusion:
    """Fusion by the methods `ratio`, `affine` and `given`, with the interface of `Fusion`.

    `given` uses the depth estimate without correction, for robots without a lidar.
    """

    def __init__(self, camera: Pinhole, T_body_camera: np.ndarray, method: SingleMethod) -> None:
        self._camera, self._T_body_camera, self._method = camera, T_body_camera, method
        self._image_check = ImageCheck()

    def add_scan(self, points_map_m: np.ndarray) -> None:
        """Ignore the scan: these methods use only the beams of the image."""

    def fuse(self, frame: FusionInput, *, keyframe: bool) -> FusionResult:
        """Return the depth of one image; `keyframe` has no effect."""
        status = self._image_check.check(frame.image_rgb, frame.T_map_body)
        if status != "ok":
            return rejected(self._camera.shape, status)
        if frame.estimate is None:
            return rejected(self._camera.shape, "there is no depth estimate")
        if self._method == "given":
            depth = as_depth(frame.estimate, frame.estimate_kind).astype(np.float32)
            return _with_gross_errors(FusionResult(depth, np.float32(_GIVEN_SIGMA) * depth, scale=1.0))
        uv, z, _ = project_beams(frame.beams, self._camera, self._T_body_camera)
        correct = ratio if self._method == "ratio" else affine
        return _with_gross_errors(correct(frame.estimate, frame.estimate_kind, uv, z))


def _with_gross_errors(result: FusionResult) -> FusionResult:
    typical = result.sigma_m / result.depth_m
    return replace(result, sigma_m=result.depth_m * stated_sigma_log(typical, OF_KEYFRAMES))
