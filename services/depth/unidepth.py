"""UniDepth V2, exported by its own export.py: metric points, confidence and estimated intrinsics.

Inputs: `rgbs` [B, 3, H, W], an image normalised by the ImageNet mean and standard deviation; in exports with
a camera also `rays` [B, 3, H, W], unit vectors along K^-1 [u, v, 1] at network resolution, with pixel centres
at half integers. Outputs: `pts_3d` [B, 3, H, W] in metres, `confidence` [B, 1, H, W], `intrinsics` [B, 3, 3].
H and W are fixed multiples of 14. Depth is the z coordinate of pts_3d, not its length.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.onnx_model import OnnxModel
from beamsplat.services.depth.depth_anything import PATCH, normalize_image
from beamsplat.services.depth.model_files import find_model
from beamsplat.services.depth.source import DepthInput, Estimate, check_depth_map


@dataclass(frozen=True)
class LetterboxLayout:
    """Position of an image in the network input: the image is scaled by `factor`, then padded (letterbox)."""

    factor: float
    left_px: int
    top_px: int
    width_px: int
    height_px: int


class UniDepth:
    """Depth source UniDepth V2 on ONNX Runtime.

    Raises:
        UserError: the model file is missing, or has other inputs or outputs than the export.
    """

    def __init__(self, model: str | Path = "unidepth_v2_vits", threads: int = 1) -> None:
        self._onnx = OnnxModel(find_model(model), threads=threads)
        spec = self._onnx.image_input(name="rgbs")
        if spec.name != "rgbs" or self._onnx.inputs[0].name != "rgbs":
            raise UserError(
                f"{self._onnx.path}: the first input is {self._onnx.inputs[0].name!r}, not 'rgbs'"
            )
        if not spec.shape[2] or not spec.shape[3]:
            raise UserError(f"{self._onnx.path}: H and W are dynamic; the export of UniDepth has fixed ones")
        self._takes_rays = len(self._onnx.inputs) == 2
        if self._takes_rays and self._onnx.inputs[1].name != "rays":
            raise UserError(
                f"{self._onnx.path}: the second input is {self._onnx.inputs[1].name!r}, not 'rays'"
            )
        if not self._takes_rays:
            self._onnx.check_inputs(1)
        self._has_confidence = any(p.name == "confidence" for p in self._onnx.outputs)
        self._onnx.output("pts_3d")
        self._side = self._onnx.input_size(spec, spec.shape[2], spec.shape[3], PATCH)
        shape = (1, 3, *self._side)
        self._onnx.warm_up(*([shape, shape] if self._takes_rays else [shape]))

    def estimate(self, view: DepthInput) -> Estimate:
        """Return metric depth at the image size, with a confidence comparable within this image only."""
        h, w = view.camera.shape
        fit = letterbox_layout(h, w, self._side)
        inputs = [normalize_image(letterbox(view.image_rgb, fit, self._side), self._side)]
        if self._takes_rays:
            inputs.append(network_rays(view.camera, fit, self._side))
        names = ("pts_3d", "confidence") if self._has_confidence else ("pts_3d",)
        results = self._onnx.run(*inputs, outputs=names)
        points = results[0]
        if points.ndim != 4 or points.shape[1] != 3:
            raise UserError(
                f"{self._onnx.path}: pts_3d has shape {list(points.shape)}; expected 1 x 3 x H x W"
            )
        status = check_depth_map(points[0, 2])
        z = crop_and_resize(points[0, 2], fit, h, w)
        with np.errstate(invalid="ignore"):
            z = np.where(z > 0.0, z, np.nan).astype(np.float32)
        confidence = None
        if self._has_confidence:
            # The export outputs an estimated log error: larger is worse. Only the order is used.
            error = crop_and_resize(results[1].reshape(points.shape[2:]), fit, h, w)
            confidence = (1.0 / (1.0 + np.maximum(error, 0.0))).astype(np.float32)
        return Estimate(z, "metric", status, confidence)


def letterbox_layout(height: int, width: int, side: tuple[int, int]) -> LetterboxLayout:
    """Return the layout of an image, scaled as large as fits into the network input and centred.

    `height`, `width`: size of the image; `side`: (height, width) of the network input; all in px.
    """
    factor = min(side[0] / height, side[1] / width)
    inner_h, inner_w = min(round(height * factor), side[0]), min(round(width * factor), side[1])
    return LetterboxLayout(factor, (side[1] - inner_w) // 2, (side[0] - inner_h) // 2, inner_w, inner_h)


def letterbox(image_rgb: np.ndarray, fit: LetterboxLayout, side: tuple[int, int]) -> np.ndarray:
    """Return uint8 [h, w, 3] at network size: the scaled image, padded with the ImageNet mean."""
    out = np.full((*side, 3), (124, 116, 104), dtype=np.uint8)
    inner = cv2.resize(image_rgb, (fit.width_px, fit.height_px), interpolation=cv2.INTER_LINEAR)
    out[fit.top_px : fit.top_px + fit.height_px, fit.left_px : fit.left_px + fit.width_px] = inner
    return out


def network_rays(camera: Pinhole, fit: LetterboxLayout, side: tuple[int, int]) -> np.ndarray:
    """Return unit rays float32 [1, 3, h, w] at network resolution, pixel centres at half integers."""
    fx, fy = camera.fx_px * fit.width_px / camera.width_px, camera.fy_px * fit.height_px / camera.height_px
    # Our pixel centres are integers, those of the network half integers: cx shifts by half a pixel.
    cx = (camera.cx_px + 0.5) * fit.width_px / camera.width_px + fit.left_px
    cy = (camera.cy_px + 0.5) * fit.height_px / camera.height_px + fit.top_px
    v, u = np.mgrid[: side[0], : side[1]] + 0.5
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)])
    return (rays / np.linalg.norm(rays, axis=0))[None].astype(np.float32)


def crop_and_resize(values: np.ndarray, fit: LetterboxLayout, height: int, width: int) -> np.ndarray:
    """Return the image's part of a map at network size, resized bilinearly to float32 [height, width]."""
    inner = values[fit.top_px : fit.top_px + fit.height_px, fit.left_px : fit.left_px + fit.width_px]
    return cv2.resize(np.ascontiguousarray(inner), (width, height), interpolation=cv2.INTER_LINEAR)
