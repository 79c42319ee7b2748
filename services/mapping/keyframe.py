"""Keyframes in two forms: decoded from a message, and compressed in the map of the mapper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import is_rigid, se3_exp, se3_log
from beamsplat.common.raster.camera import RasterCamera

MAX_DEPTH_M = 60.0  # larger depths are unknown; fits uint16 millimetres
_MIN_DEPTH_M = 0.05
_UNKNOWN_REACH_M = 20.0  # assumed visible range where the depth is unknown
REACH_TILES = (6, 8)  # rows and columns of the image tiles that have a visible range each
# Largest distance of a keyframe from its anchor. Submaps are a few dozen metres at most.
MAX_ANCHOR_DISTANCE_M = 200.0


@dataclass(frozen=True)
class RgbdKeyframe:
    """An undistorted image with depth, and the camera pose relative to an anchor.

    Keyframes may arrive in any order. `anchor` is the id of the lidar submap that `T_anchor_camera` refers
    to.
    """

    id: int
    rgb: np.ndarray  # uint8 [H, W, 3]
    camera: RasterCamera
    T_anchor_camera: np.ndarray
    depth_m: np.ndarray  # float32 [H, W] optical z, NaN unknown
    sigma_m: np.ndarray  # float32 [H, W] standard deviation without gross errors, see `typical_sigma_m`
    anchor: int = 0
    # Lidar returns [N, 3]: px, px, optical z in m.
    beams_uvz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    mask: np.ndarray | None = None  # bool [H, W], False = dynamic object, not used

    def fault(self) -> str | None:
        """Return the reason why the keyframe is invalid, as one sentence; None if it is valid."""
        shape = (self.camera.height_px, self.camera.width_px)
        if self.rgb.shape != (*shape, 3) or self.rgb.dtype != np.uint8:
            got = f"{self.rgb.dtype} {list(self.rgb.shape)}"
            return f"the image must be uint8 [{shape[0]}, {shape[1]}, 3], got {got}"
        if self.depth_m.shape != shape or self.sigma_m.shape != shape:
            got = f"{list(self.depth_m.shape)} and {list(self.sigma_m.shape)}"
            return f"depth and sigma must be {list(shape)}, got {got}"
        if not is_rigid(self.T_anchor_camera):
            return "T_anchor_camera is not a rigid transform"
        distance_m = float(np.abs(self.T_anchor_camera[:3, 3]).max())
        if distance_m > MAX_ANCHOR_DISTANCE_M:
            return f"the camera is {distance_m:.0f} m from its anchor, more than {MAX_ANCHOR_DISTANCE_M:g} m"
        if self.mask is not None and (self.mask.shape != shape or not self.mask.any()):
            return "the mask leaves no pixel to use"
        if not np.any(np.isfinite(self.depth_m)):
            return "no pixel has a depth"
        return None


@dataclass
class PyramidLevel:
    """The optimisation targets of a keyframe at one image size, quantised to save memory."""

    camera: RasterCamera
    rgb: np.ndarray  # uint8 [3, H, W]
    depth_mm: np.ndarray  # uint16 [H, W], 0 unknown
    depth_weight: np.ndarray  # uint8 [H, W], 255 = weight 1
    beam_pixels: np.ndarray  # int32 [N], flat pixel indices of lidar returns
    beam_z_m: np.ndarray  # float32 [N], optical z of lidar returns
    hidden: np.ndarray | None = None  # bool [H, W], True = on a dynamic object: ignored by all losses


class DeferredLevels(Sequence[PyramidLevel]):
    """The pyramid levels of a keyframe that are decoded when one of them is used for the first time."""

    def __init__(self, decode: Callable[[], list[PyramidLevel]]) -> None:
        self._decode: Callable[[], list[PyramidLevel]] | None = decode
        self._levels: list[PyramidLevel] = []

    @property
    def decoded(self) -> bool:
        """Return whether the levels have been used."""
        return self._decode is None

    def _all(self) -> list[PyramidLevel]:
        if self._decode is not None:
            self._levels = self._decode()
            self._decode = None
        return self._levels

    def __len__(self) -> int:
        return len(self._all())

    def __getitem__(self, index: Any) -> Any:
        return self._all()[index]


@dataclass
class StoredKeyframe:
    """A keyframe in the map. `levels[0]` has full size, `levels[1]` half size.

    Field names other than `camera` and `levels` are array names in saved sessions (`keyframe_<name>`).
    """

    id: int
    anchor: int
    T_anchor_camera: np.ndarray  # as estimated by SLAM
    camera: RasterCamera  # of the full size
    levels: Sequence[PyramidLevel]
    delta: np.ndarray = field(default_factory=lambda: np.eye(4))  # the mapper's correction, right-multiplied
    pose_first: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Adam's moments of the pose
    pose_second: np.ndarray = field(default_factory=lambda: np.zeros(6))
    pose_steps: int = 0
    exposure: np.ndarray = field(default_factory=lambda: np.zeros(6, np.float32))  # log gains, offsets
    exposure_first: np.ndarray = field(default_factory=lambda: np.zeros(6))
    exposure_second: np.ndarray = field(default_factory=lambda: np.zeros(6))
    exposure_steps: int = 0
    # float32 [6, 8]: visible range (optical z) of each image tile, the far plane of its part of the frustum
    reach_m: np.ndarray = field(default_factory=lambda: np.full(REACH_TILES, MAX_DEPTH_M, np.float32))

    def T_anchor_refined(self) -> np.ndarray:
        """Return T_anchor_camera (SLAM) @ delta (mapper)."""
        return self.T_anchor_camera @ self.delta


def compress(frame: RgbdKeyframe, sigma_unit: float) -> StoredKeyframe:
    """Compress a valid keyframe to two pyramid levels with quantised depth and weights.

    The weight of a depth is 1 / (1 + (r / sigma_unit)^2), where r is the standard deviation divided by the
    depth: a relative error, so that distant walls have the same weight as near walls.
    """
    with np.errstate(invalid="ignore"):
        known = np.isfinite(frame.depth_m) & (frame.depth_m > _MIN_DEPTH_M) & (frame.depth_m < MAX_DEPTH_M)
        if frame.mask is not None:
            known &= frame.mask
        relative = frame.sigma_m / np.maximum(frame.depth_m, _MIN_DEPTH_M)
        weight = np.where(known, 1.0 / (1.0 + (relative / sigma_unit) ** 2), 0.0)
    # Rounded: messages have whole millimetres, of which none must be lost.
    depth_mm = np.where(known, frame.depth_m * 1e3 + 0.5, 0.0).astype(np.uint16)
    weight_8 = np.clip(np.nan_to_num(weight) * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    levels: list[PyramidLevel] = []
    camera, rgb = frame.camera, frame.rgb
    for halvings in range(2):
        step = 1 << halvings
        w, h = frame.camera.width_px // step, frame.camera.height_px // step
        if halvings:
            camera, rgb = (
                frame.camera.resized(w, h),
                cv2.resize(frame.rgb, (w, h), interpolation=cv2.INTER_AREA),
            )
        pixels, z = _beams_at(frame.beams_uvz, frame.camera, camera)
        sampled = np.s_[: h * step : step, : w * step : step]
        planes, d, wt = rgb.transpose(2, 0, 1), depth_mm[sampled], weight_8[sampled]
        hidden = None if frame.mask is None or frame.mask.all() else ~frame.mask[sampled]
        rgb_planes, d, wt = (np.ascontiguousarray(array) for array in (planes, d, wt))
        levels.append(PyramidLevel(camera, rgb_planes, d, wt, pixels, z, hidden))
    T_anchor_camera = np.array(frame.T_anchor_camera, dtype=np.float64)
    return StoredKeyframe(
        frame.id, frame.anchor, T_anchor_camera, frame.camera, levels, reach_m=visible_range_m(frame)
    )


def unobserved_levels(camera: RasterCamera) -> list[PyramidLevel]:
    """Return the levels of a keyframe without image and depth: all pixels are hidden."""
    out = []
    for halvings in range(2):
        w, h = camera.width_px >> halvings, camera.height_px >> halvings
        black, unknown = np.zeros((3, h, w), np.uint8), np.zeros((h, w), np.uint16)
        no_beams = _beams_at(np.zeros((0, 3)), camera, camera)
        size = camera.resized(w, h) if halvings else camera
        weight, hidden = np.zeros((h, w), np.uint8), np.ones((h, w), bool)
        out.append(PyramidLevel(size, black, unknown, weight, *no_beams, hidden))
    return out


def visible_range_m(frame: RgbdKeyframe) -> np.ndarray:
    """Return the optical z (m) beyond which the keyframe observes nothing, float32 [6, 8] by image tile.

    It is the largest depth of the tile with a margin, and at least `_UNKNOWN_REACH_M` if more than 5 % of the
    tile has no depth: these pixels may show the space behind a door or a window.
    """
    with np.errstate(invalid="ignore"):
        known = (frame.depth_m > _MIN_DEPTH_M) & (frame.depth_m < MAX_DEPTH_M)
    out = np.empty(REACH_TILES, np.float32)
    rows, columns = (np.linspace(0, size, n + 1).astype(int) for size, n in zip(known.shape, REACH_TILES))
    for i, j in np.ndindex(REACH_TILES):
        tile = np.s_[rows[i] : rows[i + 1], columns[j] : columns[j + 1]]
        seen = known[tile]
        unknown = ~seen if frame.mask is None else ~seen & frame.mask[tile]
        farthest_m = 1.1 * float(frame.depth_m[tile][seen].max()) + 0.5 if seen.any() else MAX_DEPTH_M
        out[i, j] = farthest_m if unknown.mean() < 0.05 else max(farthest_m, _UNKNOWN_REACH_M)
    return out


def with_hidden(level: PyramidLevel, image: np.ndarray, exposure: np.ndarray) -> PyramidLevel:
    """Return the level with the colour of hidden pixels replaced by the render: they add no error to SSIM.

    Args:
        image: float32 [5, H, W], the render: red, green, blue, accumulated depth, alpha.
        exposure: float32 [6], log gains of red, green, blue, then offsets of red, green, blue (not log).
    """
    if level.hidden is None:
        return level
    gain, offset = np.exp(exposure[:3])[:, None, None], exposure[3:, None, None]
    shown = np.clip((image[:3] * gain + offset) * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    return replace(level, rgb=np.where(level.hidden, shown, level.rgb))


def refine_pose(
    keyframe: StoredKeyframe,
    gradient: np.ndarray,
    rates: tuple[float, float],
    limits: tuple[float, float],
) -> None:
    """Update the pose correction by one step of Adam: T_map_camera <- T_map_camera @ exp(-step).

    Args:
        gradient: float [6], derivative of the loss with respect to a left perturbation (rho, phi) of
            T_camera_map.
        rates: step sizes of position (m) and rotation (rad).
        limits: largest total correction per axis, in m and rad.
    """
    # T_camera_map <- exp(xi) T_camera_map moves T_map_camera on the right by exp(-xi).
    keyframe.pose_steps += 1
    move = _adam_step(gradient, keyframe.pose_first, keyframe.pose_second, keyframe.pose_steps)
    move = move * np.repeat(rates, 3)
    tangent = se3_log(keyframe.delta @ se3_exp(move))
    bounds = np.repeat(limits, 3)
    keyframe.delta = se3_exp(np.clip(tangent, -bounds, bounds))


def refine_exposure(keyframe: StoredKeyframe, gradient: np.ndarray, rate: float) -> None:
    """Update the log gains and the offsets of the exposure by one step of Adam.

    Args:
        gradient: float64 [6], derivative of the loss with respect to the exposure.
        rate: step size.
    """
    keyframe.exposure_steps += 1
    gradient = gradient + 1e-3 * keyframe.exposure  # weak prior: no change of exposure
    move = _adam_step(gradient, keyframe.exposure_first, keyframe.exposure_second, keyframe.exposure_steps)
    keyframe.exposure = (keyframe.exposure - rate * move).astype(np.float32)


def _adam_step(gradient: np.ndarray, first: np.ndarray, second: np.ndarray, t: int) -> np.ndarray:
    """Return Adam's normalised step (Kingma & Ba 2015) at step count `t`; updates the moments in place."""
    first += 0.1 * (gradient - first)
    second += 0.01 * (gradient**2 - second)
    return first / (1 - 0.9**t) / (np.sqrt(second / (1 - 0.99**t)) + 1e-12)


def _beams_at(uvz: np.ndarray, full: RasterCamera, camera: RasterCamera) -> tuple[np.ndarray, np.ndarray]:
    """Project lidar beams float [N, 3] (px, px, m) of the full image into a resized image.

    Returns:
        Flat pixel indices int32 and optical z float32 (m) of the beams inside the image.
    """
    if len(uvz) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.float32)
    u = np.round((uvz[:, 0] + 0.5) * camera.width_px / full.width_px - 0.5).astype(int)
    v = np.round((uvz[:, 1] + 0.5) * camera.height_px / full.height_px - 0.5).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < camera.width_px) & (v < camera.height_px)
    return (v * camera.width_px + u)[inside].astype(np.int32), uvz[inside, 2].astype(np.float32)
