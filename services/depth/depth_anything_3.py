"""Depth Anything 3 (Lin et al., arXiv 2511.10647), exported to ONNX: relative depth, and the metric variant.

Preprocessing as in versions 1 and 2: RGB / 255, sides multiples of 14, normalised by the ImageNet mean and
standard deviation. An input of fixed size is padded, as in the reference implementation, because the network
was not trained on distorted images. The input is a set of views [1, N, 3, H, W], of which there is one here;
some exports of one view have [1, 3, H, W]. Exports differ in the names of their outputs: `predicted_depth`
(onnx-community) or `depth`, `confidence` or `conf`, and `sky` (metric variant only). Predicted extrinsics and
intrinsics are not used: the calibration is known.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.onnx_model import OnnxModel
from beamsplat.services.depth.depth_anything import PATCH, network_input_size, normalize_image
from beamsplat.services.depth.model_files import find_model
from beamsplat.services.depth.source import DepthInput, Estimate, Kind, check_depth_map
from beamsplat.services.depth.unidepth import crop_and_resize, letterbox, letterbox_layout

_DEPTH, _CONFIDENCE, _SKY = ("predicted_depth", "depth"), ("confidence", "conf", "depth_conf"), ("sky",)
_CANONICAL_FOCAL_PX = 300.0  # metric variant: metres = output * focal / 300
_MAX_SKY = 0.3  # as in the reference implementation: a pixel with a higher value has no depth


class DepthAnything3:
    """Depth source with depth up to a factor (DA3-SMALL and larger any-view models).

    Raises:
        UserError: the model is missing or has other inputs or outputs, or `input_px` is below one patch.
    """

    kind: Kind = "relative"

    def __init__(
        self, model: str | Path = "depth_anything_v3_small", input_px: int = 252, threads: int = 1
    ) -> None:
        """Load the network. `input_px`: short side of its input, if the file does not fix the size."""
        if input_px < PATCH:
            raise UserError(f"depth_anything_3: input_px = {input_px} is below one patch of {PATCH} px")
        self._onnx = OnnxModel(find_model(model), threads=threads)
        self._onnx.check_inputs(1)
        port = self._onnx.inputs[0]
        if len(port.shape) not in (4, 5) or port.shape[-3] not in (3, None):
            raise UserError(
                f"{self._onnx.path}: input {port.name!r} has shape {list(port.shape)}; expected "
                "1 x N x 3 x H x W or 1 x 3 x H x W"
            )
        self._views = len(port.shape) == 5
        self._input_px = input_px
        self._fixed = port.shape[-2:]
        for side in self._fixed:
            if side and side % PATCH:
                raise UserError(
                    f"{self._onnx.path}: a side of {side} px is not a multiple of {PATCH}, as the network "
                    "needs"
                )
        names = [spec.name for spec in self._onnx.outputs]
        depth = next((name for name in _DEPTH if name in names), None)
        if depth is None:
            raise UserError(
                f"{self._onnx.path}: has no output {' or '.join(map(repr, _DEPTH))}; it has "
                f"{', '.join(names)}: the file holds another network"
            )
        self._outputs = [depth]
        self._confidence = next((name for name in _CONFIDENCE if name in names), None)
        self._sky = next((name for name in _SKY if name in names), None)
        self._outputs += [name for name in (self._confidence, self._sky) if name is not None]

    def estimate(self, view: DepthInput) -> Estimate:
        """Return depth at the image size (bilinear), with a confidence comparable within this image only."""
        h, w = view.camera.shape
        preferred = network_input_size(h, w, self._input_px)
        side = (self._fixed[0] or preferred[0], self._fixed[1] or preferred[1])
        fit = letterbox_layout(h, w, side)
        image = normalize_image(letterbox(view.image_rgb, fit, side), side)
        arrays = self._onnx.run(image[None] if self._views else image, outputs=tuple(self._outputs))
        maps = {
            name: crop_and_resize(self._map(name, array, side), fit, h, w)
            for name, array in zip(self._outputs, arrays)
        }
        raw = maps[self._outputs[0]]
        status = check_depth_map(raw)
        with np.errstate(invalid="ignore"):
            known = raw > 0.0
            if self._sky is not None:
                known &= ~(maps[self._sky] > _MAX_SKY)
        # The focal length at the size of the network input; the image's pixels need not be square.
        focal_px = float(np.sqrt(view.camera.fx_px * view.camera.fy_px)) * fit.factor
        confidence = None
        if self._confidence is not None:  # 1 + exp(.): it has no upper limit, and larger is better
            confidence = (1.0 - 1.0 / (1.0 + np.maximum(maps[self._confidence], 1.0))).astype(np.float32)
        depth = np.where(known, self._depth(raw, focal_px), np.nan).astype(np.float32)
        return Estimate(depth, self.kind, status, confidence)

    def _map(self, name: str, array: np.ndarray, side: tuple[int, int]) -> np.ndarray:
        """Return an output of shape [1, 1, h, w], [1, h, w] or [h, w] as [h, w] of the size `side`."""
        if array.size != side[0] * side[1] or array.shape[-2:] != side:
            raise UserError(
                f"{self._onnx.path}: {name} has shape {list(array.shape)}; expected one map of "
                f"{side[0]} x {side[1]}"
            )
        return array.reshape(side)

    def _depth(self, raw: np.ndarray, focal_px: float) -> np.ndarray:
        return raw


class DepthAnything3Metric(DepthAnything3):
    """Depth source with depth in metres: the variant DA3METRIC-LARGE, which needs the focal length."""

    kind: Kind = "metric"

    def __init__(
        self, model: str | Path = "depth_anything_v3_metric_large", input_px: int = 252, threads: int = 1
    ) -> None:
        super().__init__(model, input_px, threads)

    def _depth(self, raw: np.ndarray, focal_px: float) -> np.ndarray:
        return raw * np.float32(focal_px / _CANONICAL_FOCAL_PX)
