"""FastDepth (Wofk et al., ICRA 2019), trained on NYU-v2: small; metric depth with errors of tens of per cent.

The network was trained on one field of view: 224x224 px with normalised focal lengths fx/w = 0.889,
fy/h = 1.187. Every image is cropped to that field of view; RGB in [0, 1], without subtraction of a mean.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.onnx_model import OnnxModel, to_hw
from beamsplat.services.depth.model_files import find_model
from beamsplat.services.depth.source import DepthInput, Estimate, check_depth_map

_FX_PER_WIDTH = 0.889  # of the NYU-v2 training crops
_FY_PER_HEIGHT = 1.187
_SIDE = 224  # px, network input
_MULTIPLE = 32  # the encoder halves the size five times
_Z_RANGE_M = (0.3, 10.0)  # range of the training data


class FastDepth:
    """Depth source FastDepth on ONNX Runtime.

    Raises:
        UserError: the model file is missing, or contains another network.
    """

    def __init__(self, model: str | Path = "fastdepth_nyu_fp32", threads: int = 1) -> None:
        self._onnx = OnnxModel(find_model(model), threads=threads)
        self._onnx.check_inputs(1)
        spec = self._onnx.image_input()
        self._side = self._onnx.input_size(spec, _SIDE, _SIDE, _MULTIPLE)
        (first, *_) = self._onnx.warm_up((1, 3, *self._side))
        to_hw(first, str(self._onnx.path))

    def estimate(self, view: DepthInput) -> Estimate:
        """Return depth in metres inside the field of view of the network, NaN outside it."""
        u0, v0, u1, v1, factor = network_crop(view.camera)
        h, w = self._side
        patch = cv2.resize(view.image_rgb[v0:v1, u0:u1], (w, h), interpolation=cv2.INTER_AREA)
        tensor = (patch.astype(np.float32) / 255.0).transpose(2, 0, 1)[None]
        raw = to_hw(self._onnx.run(tensor)[0], str(self._onnx.path))
        status = check_depth_map(raw)
        z = raw * factor
        with np.errstate(invalid="ignore"):
            z[~((z >= _Z_RANGE_M[0]) & (z <= _Z_RANGE_M[1]))] = np.nan
        values = np.full(view.camera.shape, np.nan, dtype=np.float32)
        values[v0:v1, u0:u1] = resize_keeping_unknown(z, u1 - u0, v1 - v0)
        return Estimate(values, "metric", status)


def network_crop(camera: Pinhole) -> tuple[int, int, int, int, float]:
    """Return the crop (u0, v0, u1, v1) with the field of view of NYU-v2 (u1, v1 excluded) and a depth factor.

    If the camera's field of view is narrower, a smaller part of the scene fills the network input, so that
    everything appears nearer. Multiplication of the depth by the factor, the ratio of the focal lengths,
    corrects this to first order.
    """
    wanted_w, wanted_h = camera.fx_px / _FX_PER_WIDTH, camera.fy_px / _FY_PER_HEIGHT
    u0 = max(round(camera.cx_px + 0.5 - wanted_w / 2), 0)
    u1 = min(round(camera.cx_px + 0.5 + wanted_w / 2), camera.width_px)
    v0 = max(round(camera.cy_px + 0.5 - wanted_h / 2), 0)
    v1 = min(round(camera.cy_px + 0.5 + wanted_h / 2), camera.height_px)
    factor = camera.fx_px / (u1 - u0) / _FX_PER_WIDTH
    return u0, v0, u1, v1, factor if u1 - u0 < wanted_w - 1.0 else 1.0


def resize_keeping_unknown(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return float32 [height, width], resized bilinearly; an output pixel that touches NaN is NaN."""
    return cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
