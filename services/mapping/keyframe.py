"""A keyframe as the mapper takes it and as it keeps it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import is_rigid, se3_exp, se3_log
from beamsplat.common.raster.camera import RasterCamera

MAX_DEPTH_M = 60.0
_UNKNOWN_REACH_M = 20.0  # how far a picture may look where it knows no depth
REACH_M = 200.0  # no keyframe is further from its anchor: submaps are a few dozen metres at most


@dataclass(frozen=True)
class Keyframe:
    """One undistorted picture with depth and its place beside an anchor.

    Several may arrive in any order; `anchor` is the lidar submap that `T_anchor_camera` refers to.
    """

    id: int
    rgb: np.ndarray  # uint8 [H, W, 3]
    camera: RasterCamera
    T_anchor_camera: np.ndarray
    depth_m: np.ndarray  # float32 [H, W] optical z, NaN unknown
    sigma_m: np.ndarray  # float32 [H, W] standard deviation
    anchor: int = 0
    beams_uvz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # px, px, metres: lidar returns
    mask: np.ndarray | None = None  # bool [H, W], False = do not use (movers)

    def fault(self) -> str | None:
        """Why this cannot be mapped, in one sentence; None if it can."""
        shape = (self.camera.height_px, self.camera.width_px)
        if self.rgb.shape != (*shape, 3) or self.rgb.dtype != np.uint8:
            got = f"{self.rgb.dtype} {list(self.rgb.shape)}"
            return f"picture must be uint8 [{shape[0]}, {shape[1]}, 3], got {got}"
        if self.depth_m.shape != shape or self.sigma_m.shape != shape:
            got = f"{list(self.depth_m.shape)} and {list(self.sigma_m.shape)}"
            return f"depth and sigma must be {list(shape)}, got {got}"
        if not is_rigid(self.T_anchor_camera):
            return "T_anchor_camera is not a rigid transform"
        away_m = float(np.abs(self.T_anchor_camera[:3, 3]).max())
        if away_m > REACH_M:
            return f"the pose lies {away_m:.0f} m from its anchor, more than {REACH_M:g} m"
        if self.mask is not None and (self.mask.shape != shape or not self.mask.any()):
            return "the mask leaves no pixel to use"
        if not np.any(np.isfinite(self.depth_m)):
            return "no pixel has a depth"
        return None


@dataclass
class Level:
    """A keyframe's targets at one size, in few bytes."""

    camera: RasterCamera
    rgb: np.ndarray  # uint8 [3, H, W]
    depth_mm: np.ndarray  # uint16 [H, W], 0 unknown
    depth_weight: np.ndarray  # uint8 [H, W], 255 = 1
    beam_pixels: np.ndarray  # int32 [N], flat
    beam_z_m: np.ndarray  # float32 [N]
    hidden: np.ndarray | None = None  # bool [H, W], True = on something that moves: not looked at


@dataclass
class Held:
    """A keyframe in the map. `levels[0]` is the full size, `levels[1]` half."""

    id: int
    anchor: int
    T_anchor_camera: np.ndarray  # as given (SLAM)
    levels: list[Level]
    delta: np.ndarray = field(default_factory=lambda: np.eye(4))  # the mapper's own correction, on the right
    pose_first: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Adam's moments of the pose
    pose_second: np.ndarray = field(default_factory=lambda: np.zeros(6))
    pose_steps: int = 0
    exposure: np.ndarray = field(default_factory=lambda: np.zeros(6, np.float32))  # log gains, offsets
    exposure_first: np.ndarray = field(default_factory=lambda: np.zeros(6))
    exposure_second: np.ndarray = field(default_factory=lambda: np.zeros(6))
    reach_m: float = MAX_DEPTH_M  # optical z beyond which it sees nothing: walls end the view

    def T_anchor_refined(self) -> np.ndarray:
        """T_anchor_camera (SLAM) @ delta (mapper)."""
        return self.T_anchor_camera @ self.delta


def hold(frame: Keyframe, sigma_unit: float) -> Held:
    """The compact form of a keyframe that has no fault. Weights fall with sigma as a share of the depth:
    far walls are as good as near ones to whoever stands before them later."""
    with np.errstate(invalid="ignore"):
        known = np.isfinite(frame.depth_m) & (frame.depth_m > 0.05) & (frame.depth_m < MAX_DEPTH_M)
        if frame.mask is not None:
            known &= frame.mask
        share = frame.sigma_m / np.maximum(frame.depth_m, 0.05)
        weight = np.where(known, 1.0 / (1.0 + (share / sigma_unit) ** 2), 0.0)
    depth_mm = np.where(known, frame.depth_m * 1e3, 0.0).astype(np.uint16)
    weight_8 = np.clip(np.nan_to_num(weight) * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    levels, camera, rgb = [], frame.camera, frame.rgb
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
        arrays = (np.ascontiguousarray(array) for array in (planes, d, wt))
        hidden = None if frame.mask is None or frame.mask.all() else ~frame.mask[sampled]
        levels.append(Level(camera, *arrays, pixels, z, hidden))
    T_anchor_camera = np.array(frame.T_anchor_camera, dtype=np.float64)
    return Held(frame.id, frame.anchor, T_anchor_camera, levels, reach_m=reach_m(frame))


def reach_m(frame: Keyframe) -> float:
    """Optical z beyond which nothing is seen. Where more than a twentieth of the picture has no depth, it
    may look through a door or a window."""
    with np.errstate(invalid="ignore"):
        known = (frame.depth_m > 0.05) & (frame.depth_m < MAX_DEPTH_M)
    if not known.any():
        return MAX_DEPTH_M
    farthest_m = 1.1 * float(frame.depth_m[known].max()) + 0.5
    unknown = ~known if frame.mask is None else ~known & frame.mask
    return farthest_m if unknown.mean() < 0.05 else max(farthest_m, _UNKNOWN_REACH_M)


def with_hidden(level: Level, image: np.ndarray, exposure: np.ndarray) -> Level:
    """The level with hidden pixels as they are rendered: there is nothing to see, for SSIM's windows too."""
    gain, offset = np.exp(exposure[:3])[:, None, None], exposure[3:, None, None]
    shown = np.clip((image[:3] * gain + offset) * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)
    return replace(level, rgb=np.where(level.hidden, shown, level.rgb))


def refine_pose(
    held: Held, gradient: np.ndarray, rates: tuple[float, float], most: tuple[float, float]
) -> None:
    """Adam on the camera's own tangent: T_map_camera <- T_map_camera @ exp(-step). `gradient` [6] is that of
    T_camera_map; `rates` and `most` in m and rad."""
    # T_camera_map <- exp(xi) T_camera_map moves T_map_camera on the right by exp(-xi).
    held.pose_steps += 1
    move = _adam_step(gradient, held.pose_first, held.pose_second, held.pose_steps) * np.repeat(rates, 3)
    tangent = se3_log(held.delta @ se3_exp(move))
    limits = np.repeat(most, 3)
    held.delta = se3_exp(np.clip(tangent, -limits, limits))


def refine_exposure(held: Held, sums: np.ndarray, rate: float) -> None:
    """Adam on gains and offsets; `sums` [rows, 8] as the loss gives them."""
    gradient = sums[:, 2:8].sum(axis=0) + 1e-3 * held.exposure  # a weak pull to "as it was taken"
    move = _adam_step(gradient, held.exposure_first, held.exposure_second, max(held.pose_steps, 1))
    held.exposure = (held.exposure - rate * move).astype(np.float32)


def _adam_step(gradient: np.ndarray, first: np.ndarray, second: np.ndarray, t: int) -> np.ndarray:
    """Adam's normalised step; updates the moments in place."""
    first += 0.1 * (gradient - first)
    second += 0.01 * (gradient**2 - second)
    return first / (1 - 0.9**t) / (np.sqrt(second / (1 - 0.99**t)) + 1e-12)


def _beams_at(uvz: np.ndarray, full: RasterCamera, camera: RasterCamera) -> tuple[np.ndarray, np.ndarray]:
    """Flat pixel numbers int32 and z float32 of the beams in a resized picture."""
    if len(uvz) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.float32)
    u = np.round((uvz[:, 0] + 0.5) * camera.width_px / full.width_px - 0.5).astype(int)
    v = np.round((uvz[:, 1] + 0.5) * camera.height_px / full.height_px - 0.5).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < camera.width_px) & (v < camera.height_px)
    return (v * camera.width_px + u)[inside].astype(np.int32), uvz[inside, 2].astype(np.float32)
