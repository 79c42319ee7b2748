"""Depth Anything V1 and V2: affine-invariant disparity, and the metric variants of V2.

Preprocessing as in the reference implementation (util/transform.py, dpt.py): RGB / 255; short side resized
(bicubic) to the input size at constant aspect ratio, both sides multiples of 14; normalised by the ImageNet
mean and standard deviation. Exported models have different tensor names, so the first input and the first
output are used.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.onnx_model import OnnxModel, to_hw
from beamsplat.services.depth.model_files import find_model
from beamsplat.services.depth.source import DepthInput, Estimate, Kind, check_depth_map

PATCH = 14  # px, side of a vision transformer patch
_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
_STD = np.array([0.229, 0.224, 0.225], dtype=np.float32)


class DepthAnything:
    """Depth source with disparity d >= 0, nearer = larger; fusion fits 1/z = a d + b.

    Raises:
        UserError: the model is missing or has other inputs, or `input_px` is below one patch.
    """

    kind: Kind = "disparity"

    def __init__(
        self, model: str | Path = "depth_anything_v2_small", input_px: int = 252, threads: int = 1
    ) -> None:
        if input_px < PATCH:
            raise UserError(f"depth_anything: input_px = {input_px} is below one patch of {PATCH} px")
        self._onnx = OnnxModel(find_model(model), threads=threads)
        self._onnx.check_inputs(1)
        self._image_input = self._onnx.image_input()
        self._input_px = input_px
        if self._image_input.shape[2] and self._image_input.shape[3]:
            self._onnx.input_size(self._image_input, PATCH, PATCH, PATCH)
        self._warm: tuple[int, int] | None = None

    def estimate(self, view: DepthInput) -> Estimate:
        """Return the disparity at the image size (bilinear, corners aligned as in the reference)."""
        h, w = view.camera.shape
        preferred = network_input_size(h, w, self._input_px)
        side = self._onnx.input_size(self._image_input, *preferred, PATCH)
        if self._warm != side:
            self._onnx.warm_up((1, 3, *side))
            self._warm = side
        raw = to_hw(self._onnx.run(normalize_image(view.image_rgb, side))[0], str(self._onnx.path))
        status = check_depth_map(raw)
        return Estimate(self._values(resize_align_corners(raw, h, w)), self.kind, status)

    def _values(self, raw: np.ndarray) -> np.ndarray:
        return raw


class DepthAnythingMetric(DepthAnything):
    """Depth source with depth in metres: the metric variants (Hypersim indoors, VKITTI outdoors).

    The network does not know the focal length. Its scale is wrong by 10 to 20 %, which fusion corrects.
    """

    kind: Kind = "metric"

    def __init__(
        self, model: str | Path = "depth_anything_v2_metric_hypersim_small", input_px: int = 252,
        max_depth_m: float = 20.0, threads: int = 1,
    ) -> None:  # fmt: skip
        super().__init__(model, input_px, threads)
        self._max_depth_m = max_depth_m

    def _values(self, raw: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.where((raw > 0.0) & (raw < 0.999 * self._max_depth_m), raw, np.nan).astype(np.float32)


def network_input_size(height: int, width: int, input_px: int) -> tuple[int, int]:
    """Return (height, width) of the network input at the image's aspect ratio, in multiples of 14.

    The short side is at least `input_px`.
    """
    scale = max(input_px / height, input_px / width)

    def rounded(side: float) -> int:
        nearest = int(np.round(side / PATCH)) * PATCH
        return nearest if nearest >= input_px else int(np.ceil(side / PATCH)) * PATCH

    return rounded(scale * height), rounded(scale * width)


def normalize_image(image_rgb: np.ndarray, side: tuple[int, int]) -> np.ndarray:
    """Return the network input float32 [1, 3, h, w] for an RGB image uint8 [H, W, 3].

    The image is resized (bicubic) to `side` (h, w) and normalised by the ImageNet mean and standard
    deviation.
    """
    small = cv2.resize(image_rgb.astype(np.float32) / 255.0, side[::-1], interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(((small - _MEAN) / _STD).transpose(2, 0, 1)[None], dtype=np.float32)


def resize_align_corners(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return float32 [height, width], resized bilinearly so that corner pixels map to corner pixels."""
    h, w = values.shape
    x = np.linspace(0.0, w - 1.0, width, dtype=np.float32)
    y = np.linspace(0.0, h - 1.0, height, dtype=np.float32)
    map_x, map_y = np.meshgrid(x, y)
    return cv2.remap(values, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
