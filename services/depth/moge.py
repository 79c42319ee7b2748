"""MoGe-2 (Wang et al., arXiv 2507.02546), as exported by its authors to ONNX: a point map, solved to depth.

Inputs: `image` [1, 3, H, W], RGB in [0, 1] (the graph normalises it), and in exports with a dynamic size
`num_tokens`, an int64 scalar: how many patches of 14 px the encoder sees. Outputs: `points` [1, H, W, 3] up
to a shift along z and a factor, `mask` [1, H, W] (probability of a valid pixel), `metric_scale` [1] (metres
per unit), and in some exports `normal` [1, H, W, 3], which is not used.

The authors' post-processing, which is not in the graph, finds focal length and shift from the point map. Here
the focal length is known from the calibration, so only the shift is unknown. Beams measure it too, and they
measure the factor: both are solved together.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.onnx_model import OnnxModel
from beamsplat.services.depth.model_files import find_model
from beamsplat.services.depth.source import DepthInput, Estimate, check_depth_map

_PATCH = 14  # px, side of a patch of the encoder
_VALID = 0.5  # probability above which the mask says that a pixel has a depth
_SAMPLES = 64  # rows and columns of the point map from which the shift is solved
# Standard deviations of the residuals: of a projected point (fraction of the focal length) and of the log
# depth at a beam; a network errs by several per cent at any single beam. Not fitted to recordings.
_RAY_SIGMA, _BEAM_SIGMA = 0.02, 0.10
_SCALE_SIGMA = 0.2  # of the log of `metric_scale`: networks know the scale to 10 to 20 %
_LEAST_BEAMS = 12  # fewer beams are not used
_STEPS = 30  # of the solver, most
_CAUCHY = 3.0  # residual in standard deviations at which its weight is halved


@dataclass(frozen=True)
class CentredCrop:
    """The part of an image about its principal point that the network sees, and the size it sees it at."""

    left_px: int
    top_px: int
    right_px: int  # excluded
    bottom_px: int  # excluded
    width_px: int  # of the network input, with square pixels
    height_px: int
    focal_px: float  # at the size of the network input


class MoGe:
    """Depth source MoGe-2 on ONNX Runtime: metric depth.

    Raises:
        UserError: the model is missing or has other inputs or outputs, or `tokens` is below 100.
    """

    def __init__(
        self, model: str | Path = "moge_2_vits_normal", tokens: int = 1200, threads: int = 1
    ) -> None:
        """Load the network. `tokens`: patches that it sees; trained with 1200 to 3600, fewer are faster."""
        if tokens < 100:
            raise UserError(f"moge: tokens = {tokens} is below 100")
        self._onnx = OnnxModel(find_model(model), threads=threads)
        spec = self._onnx.image_input(name="image")
        names = [port.name for port in self._onnx.inputs]
        if sorted(names) not in (["image"], ["image", "num_tokens"]):
            raise UserError(
                f"{self._onnx.path}: the inputs are {', '.join(names)}; MoGe-2 has 'image' and 'num_tokens'"
            )
        for name in ("points", "mask", "metric_scale"):
            self._onnx.output(name)
        self._takes_tokens = len(names) == 2
        self._image_first = names[0] == "image"
        fixed = spec.shape[2], spec.shape[3]
        self._fixed = (fixed[0], fixed[1]) if fixed[0] and fixed[1] else None
        if self._fixed is None and not self._takes_tokens:
            raise UserError(f"{self._onnx.path}: H and W are dynamic, but there is no input 'num_tokens'")
        self._tokens = tokens
        if self._fixed is not None:
            self._run(np.full((1, 3, *self._fixed), 0.5, np.float32))  # allocates all buffers

    def estimate(self, view: DepthInput) -> Estimate:
        """Return metric depth at the image size, NaN outside the crop and where the mask is below 0.5."""
        crop = centred_crop(view.camera, self._tokens * _PATCH**2, self._fixed)
        inside = np.s_[crop.top_px : crop.bottom_px, crop.left_px : crop.right_px]
        patch = cv2.resize(
            view.image_rgb[inside], (crop.width_px, crop.height_px), interpolation=cv2.INTER_AREA
        )
        points, mask, scale = self._run((patch.astype(np.float32) / 255.0).transpose(2, 0, 1)[None])
        depth = np.full(view.camera.shape, np.nan, np.float32)
        valid = mask > _VALID
        if not np.isfinite(points[valid]).all() or not (np.isfinite(scale) and scale > 0.0):
            return Estimate(depth, "metric", "the network returned numbers that are not finite")
        if valid.mean() < 0.05:
            return Estimate(depth, "metric", f"the network's mask leaves {valid.mean():.0%} of the image")
        uv, z, _ = project_beams(view.beams, view.camera, view.T_body_camera)
        shift, factor = solve_shift(points, valid, crop, scale, uv, z)
        metric = np.where(valid, factor * (points[..., 2] + shift), np.nan).astype(np.float32)
        metric[~(metric > 0.0)] = np.nan
        size = crop.right_px - crop.left_px, crop.bottom_px - crop.top_px
        depth[inside] = cv2.resize(metric, size, interpolation=cv2.INTER_LINEAR)
        return Estimate(depth, "metric", check_depth_map(metric, min_known_share=0.05))

    def _run(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return points float32 [h, w, 3], mask float32 [h, w] and metric scale for an image [1, 3, h, w]."""
        arrays = [image]
        if self._takes_tokens:
            port = self._onnx.inputs[1 if self._image_first else 0]
            shape = tuple(size or 1 for size in port.shape)
            arrays.insert(1 if self._image_first else 0, np.full(shape, self._tokens))
        points, mask, scale = self._onnx.run(*arrays, outputs=("points", "mask", "metric_scale"))
        h, w = image.shape[2:]
        if points.size != h * w * 3 or points.shape[-1] != 3 or mask.size != h * w or scale.size != 1:
            raise UserError(
                f"{self._onnx.path}: points {list(points.shape)}, mask {list(mask.shape)}, metric_scale "
                f"{list(scale.shape)}; expected 1 x {h} x {w} x 3, 1 x {h} x {w} and 1"
            )
        return points.reshape(h, w, 3), mask.reshape(h, w), float(scale.reshape(-1)[0])


def centred_crop(camera: Pinhole, pixels: int, fixed: tuple[int, int] | None = None) -> CentredCrop:
    """Return the largest crop about the principal point, and its size with square pixels.

    MoGe assumes that the principal point is the centre of the image and that pixels are square. A crop and a
    change of the aspect ratio make both true.

    Args:
        camera: pinhole of the undistorted image.
        pixels: number of pixels of the network input, approximately.
        fixed: (height, width) of a network input of fixed size, which the crop's aspect ratio then has.
    """
    half_w = min(camera.cx_px + 0.5, camera.width_px - 0.5 - camera.cx_px)
    half_h = min(camera.cy_px + 0.5, camera.height_px - 0.5 - camera.cy_px)
    tan_w, tan_h = half_w / camera.fx_px, half_h / camera.fy_px  # with square pixels: width, height / focal
    if fixed is not None:
        aspect = fixed[1] / fixed[0]
        tan_w, tan_h = min(tan_w, tan_h * aspect), min(tan_h, tan_w / aspect)
    left = max(round(camera.cx_px + 0.5 - tan_w * camera.fx_px), 0)
    right = min(round(camera.cx_px + 0.5 + tan_w * camera.fx_px), camera.width_px)
    top = max(round(camera.cy_px + 0.5 - tan_h * camera.fy_px), 0)
    bottom = min(round(camera.cy_px + 0.5 + tan_h * camera.fy_px), camera.height_px)
    if right - left < _PATCH or bottom - top < _PATCH:
        raise UserError(
            f"moge: the principal point ({camera.cx_px}, {camera.cy_px}) is at the image's border"
        )
    if fixed is not None:
        height, width = fixed
    else:
        width = max(round(np.sqrt(pixels * tan_w / tan_h)), _PATCH)
        height = max(round(width * tan_h / tan_w), _PATCH)
    return CentredCrop(left, top, right, bottom, width, height, camera.fx_px * width / (right - left))


def solve_shift(
    points: np.ndarray,  # float32 [h, w, 3], up to a shift along z and a factor
    valid: np.ndarray,  # bool [h, w]
    crop: CentredCrop,
    scale: float,
    beam_uv_px: np.ndarray,  # float64 [N, 2], pixels of the whole image
    beam_z_m: np.ndarray,  # float64 [N]
) -> tuple[float, float]:
    """Return (shift, metres per unit): depth in metres is factor * (z + shift).

    Minimises the error of the points' projection with the known focal length, as MoGe's `recover_focal_shift`
    does, plus the error of log depth at the beams and of the factor against `scale`. Gross errors lose weight
    (Cauchy). Without beams the factor is `scale`.
    """
    h, w = valid.shape
    rows = np.unique(np.linspace(0, h - 1, _SAMPLES).astype(int))
    columns = np.unique(np.linspace(0, w - 1, _SAMPLES).astype(int))
    grid = np.ix_(rows, columns)
    ok = valid[grid]
    xyz = points[grid][ok].astype(np.float64)
    at = np.stack(np.meshgrid(columns + 0.5 - w / 2, rows + 0.5 - h / 2), axis=-1)[ok] / crop.focal_px
    z_beams, l_beams = _at_beams(points[..., 2], valid, crop, beam_uv_px, beam_z_m)
    # Start where all points are in front of the camera; the projection error is convex near its minimum.
    nearest = float(min(xyz[:, 2].min(), z_beams.min() if len(z_beams) else np.inf))
    depth_range = float(np.median(xyz[:, 2]) - nearest) + 1e-6
    shift, log_factor = max(0.0, 0.05 * depth_range - nearest), float(np.log(scale))
    for _ in range(_STEPS):
        J, r = _residuals(xyz, at, z_beams, l_beams, shift, log_factor, float(np.log(scale)))
        weight = 1.0 / (1.0 + (r / _CAUCHY) ** 2)
        normal = J.T @ (weight[:, None] * J) + 1e-9 * np.eye(2)
        step = -np.linalg.solve(normal, J.T @ (weight * r))
        moved = shift + step[0]
        if moved <= -nearest:  # a point would be behind the camera: go half of the way
            moved = 0.5 * (shift - nearest) + 1e-9
        done = abs(moved - shift) < 1e-6 * depth_range and abs(step[1]) < 1e-6
        shift, log_factor = moved, log_factor + float(np.clip(step[1], -0.5, 0.5))
        if done:
            break
    return float(shift), float(np.exp(log_factor))


def _at_beams(
    z: np.ndarray, valid: np.ndarray, crop: CentredCrop, uv_px: np.ndarray, z_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the network's z and the beams' z (m) at the beams inside the crop, both empty with too few."""
    h, w = valid.shape
    u = np.floor((uv_px[:, 0] + 0.5 - crop.left_px) * w / (crop.right_px - crop.left_px)).astype(int)
    v = np.floor((uv_px[:, 1] + 0.5 - crop.top_px) * h / (crop.bottom_px - crop.top_px)).astype(int)
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h) & (z_m > 0.0)
    inside[inside] = valid[v[inside], u[inside]]
    if np.count_nonzero(inside) < _LEAST_BEAMS:
        return np.zeros(0), np.zeros(0)
    return z[v[inside], u[inside]].astype(np.float64), z_m[inside]


def _residuals(
    xyz: np.ndarray, at: np.ndarray, z_beams: np.ndarray, l_beams: np.ndarray,
    shift: float, log_factor: float, log_scale: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the Jacobian [M, 2] by (shift, log factor) and the residuals [M], in standard deviations.

    The projections count as many independent ones as there are rows of samples: their errors are alike.
    """
    z = xyz[:, 2] + shift
    projected = xyz[:, :2] / z[:, None]
    alike = np.sqrt(max(len(xyz) / _SAMPLES, 1.0))
    r_rays = ((projected - at) / (_RAY_SIGMA * alike)).ravel()
    J_rays = (-projected / z[:, None] / (_RAY_SIGMA * alike)).ravel()
    depth = z_beams + shift
    beam_sigma = _BEAM_SIGMA * np.sqrt(max(len(z_beams) / _LEAST_BEAMS, 1.0))
    r_beams = (np.log(depth) + log_factor - np.log(l_beams)) / beam_sigma
    J = np.zeros((len(r_rays) + len(r_beams) + 1, 2))
    J[: len(r_rays), 0] = J_rays
    J[len(r_rays) : -1, 0] = 1.0 / depth / beam_sigma
    J[len(r_rays) : -1, 1] = 1.0 / beam_sigma
    J[-1, 1] = 1.0 / _SCALE_SIGMA
    return J, np.concatenate([r_rays, r_beams, [(log_factor - log_scale) / _SCALE_SIGMA]])
