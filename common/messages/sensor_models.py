"""Camera and lidar models (intrinsics and mounts), parts of the `Rig` and `Keyframe` messages."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from beamsplat.common.geometry.limits import FOCAL_RATIO
from beamsplat.common.messages.schema import Finite, MessagePart, Positive, Transform

MAX_PIXELS = 2**24  # of an image (4096 x 4096): bounds the memory of everything that has one value per pixel


class CameraModel(MessagePart):
    """Pinhole camera with lens distortion, and its mount. K is valid for this image size only.

    `distortion_model` and the order of `distortion` follow ROS and OpenCV: plumb_bob (k1 k2 p1 p2 k3),
    rational_polynomial (8, with thin prism 12, with tilt 14), equidistant (fisheye, 4 coefficients), none.
    """

    width_px: Annotated[int, Field(gt=0, le=16384)]
    height_px: Annotated[int, Field(gt=0, le=16384)]
    fx_px: Positive
    fy_px: Positive
    cx_px: Finite
    cy_px: Finite
    distortion_model: Literal["none", "plumb_bob", "rational_polynomial", "equidistant"] = "none"
    distortion: Annotated[tuple[Finite, ...], Field(max_length=14)] = ()
    T_body_camera: Transform

    @model_validator(mode="after")
    def _k_fits_image(self) -> CameraModel:
        if self.width_px * self.height_px > MAX_PIXELS:
            raise ValueError(f"{self.width_px}x{self.height_px}: more than {MAX_PIXELS} pixels")
        for axis, focal in (("fx", self.fx_px), ("fy", self.fy_px)):
            ratio = focal / max(self.width_px, self.height_px)
            if not FOCAL_RATIO[0] <= ratio <= FOCAL_RATIO[1]:
                raise ValueError(
                    f"{axis} = {focal:g} px is impossible for a {self.width_px}x{self.height_px} image"
                )
        for axis, centre, size in (("cx", self.cx_px, self.width_px), ("cy", self.cy_px, self.height_px)):
            if not 0.0 < centre < size:
                raise ValueError(
                    f"{axis} = {centre:g} px is outside the {self.width_px}x{self.height_px} image: "
                    "K belongs to another image size"
                )
        counts = {
            "none": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,),
        }  # fmt: skip
        if len(self.distortion) not in counts[self.distortion_model]:
            raise ValueError(
                f"distortion model {self.distortion_model} takes {counts[self.distortion_model]} "
                f"coefficients, got {len(self.distortion)}"
            )
        return self

    @property
    def K(self) -> np.ndarray:
        """Camera matrix, float64 [3, 3]."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])


class LidarModel(MessagePart):
    """Mount of the planar lidar on the body."""

    T_body_lidar: Transform
