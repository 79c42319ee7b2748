"""The tracker's own small map: Gaussians put where keyframes' depth shows surfaces, and optimised a little.

It is not the map that anybody looks at: it has to look like the pictures from where the camera is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from common.geometry import inverse
from common.raster.camera import RasterCamera
from common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE
from common.raster.rasterizer import Rasterizer, Render
from services.localization.camera.kernels import adam_rows, map_loss
from services.localization.camera.settings import CameraTrackerSettings

_SEARCH_PX = 2  # reach of normals


@dataclass
class MapKeyframe:
    """A picture that the map is made of, at the tracker's size."""

    stamp_ns: int
    T_map_camera: np.ndarray
    rgb: np.ndarray  # float32 [3, H, W] in [0, 1]
    z_m: np.ndarray  # float32 [H, W], 0 unknown
    weight: np.ndarray  # float32 [H, W] of the depth
    in_view: np.ndarray  # int32: Gaussians in view when it was taken in
    thumbnail: np.ndarray  # float32 [h, w], to find it again


class SplatMap:
    """Columns 0 ... count of `params` are Gaussians, rows as in common.raster.layout."""

    def __init__(self, camera: RasterCamera, settings: CameraTrackerSettings) -> None:
        self.camera, self.settings = camera, settings
        self.rasterizer = Rasterizer()
        self.count = 0
        self.keyframes: list[MapKeyframe] = []
        self._allocate(1 << 14)
        s = settings
        self._rates = np.empty(PARAMS, np.float32)
        self._rates[MEAN:SCALE], self._rates[SCALE:QUAT] = s.mean_rate_m, s.log_scale_rate
        self._rates[QUAT:OPACITY], self._rates[OPACITY:COLOUR] = s.quat_rate, s.opacity_rate
        self._rates[COLOUR:] = s.colour_rate
        self._gradient = np.empty((5, camera.height_px, camera.width_px), np.float32)

    def _allocate(self, capacity: int) -> None:
        self.params = np.zeros((PARAMS, capacity), np.float32)
        self._first = np.zeros((PARAMS, capacity), np.float32)  # Adam's moments
        self._second = np.zeros((PARAMS, capacity), np.float32)
        self._steps = np.zeros(capacity, np.float32)

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> Render:
        """The map from a pose; give it back with `release`."""
        return self.rasterizer.render(self.params, self.count, camera, T_camera_map)

    def release(self, render: Render) -> None:
        """Gives a render's memory back."""
        self.rasterizer.release(render)

    # --- growing -----------------------------------------------------------------------------------

    def add(self, frame: MapKeyframe) -> int:
        """Takes a keyframe in: Gaussians where the map does not explain it. Gives how many."""
        s = self.settings
        render = self.render(self.camera, inverse(frame.T_map_camera))
        missing = _unexplained(render.image, frame, s)
        stale = self._stale(render.index.copy(), missing, frame)
        self.release(render)
        if len(stale):
            self._drop(stale)
            render = self.render(self.camera, inverse(frame.T_map_camera))
            missing = _unexplained(render.image, frame, s)
            self.release(render)
        u, v, spacing = _candidates(missing, frame, s)
        room = s.max_gaussians - self.count
        u, v, spacing = u[:room], v[:room], spacing[:room]
        if len(u):
            self._append(make_discs(u, v, spacing, frame, self.camera, s))
        render = self.render(self.camera, inverse(frame.T_map_camera))
        frame.in_view = render.index.copy()
        self.release(render)
        self.keyframes.append(frame)
        return len(u)

    def _stale(self, index: np.ndarray, missing: np.ndarray, frame: MapKeyframe) -> np.ndarray:
        """Of the Gaussians in view int32 [V], those that the keyframe speaks against.

        They float before the surface that its depth shows; or lie on the surface where the picture looks
        different, or finer than they are. What replaces them is put there next.
        """
        s, camera = self.settings, self.camera
        h, w = frame.z_m.shape
        T = inverse(frame.T_map_camera)
        points = T[:3, :3] @ self.params[MEAN:SCALE, index] + T[:3, 3:4]
        z = np.maximum(points[2], 1e-6)
        u = np.floor(points[0] / z * camera.fx_px + camera.cx_px + 0.5).astype(np.int64)
        v = np.floor(points[1] / z * camera.fy_px + camera.cy_px + 0.5).astype(np.int64)
        inside = (points[2] > 0.05) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        index, z, u, v = index[inside], z[inside], u[inside], v[inside]
        surface = frame.z_m[v, u]
        known = (surface > 0.0) & (frame.weight[v, u] > s.least_depth_weight)
        size = np.exp(self.params[SCALE : SCALE + 2, index].max(axis=0))
        floats = known & (z + 2.0 * size < surface * (1.0 - s.float_margin))
        on_it = (surface > 0.0) & (np.abs(z - surface) < s.depth_off * surface)
        coarse = size * camera.fx_px / z > s.coarse_px
        faint = self.params[OPACITY, index] < np.log(s.prune_opacity / (1.0 - s.prune_opacity))
        return index[floats | faint | (on_it & (missing[v, u] | coarse))]

    def _drop(self, index: np.ndarray) -> None:
        """Removes Gaussians; the others keep their order, and the keyframes' lists their meaning."""
        if not len(index):
            return
        keep = np.ones(self.count, bool)
        keep[index] = False
        kept = np.flatnonzero(keep)
        for array in (self.params, self._first, self._second, self._steps):
            array[..., : len(kept)] = array[..., kept]
        place = np.cumsum(keep, dtype=np.int32) - 1
        self.count = len(kept)
        for frame in self.keyframes[-1:]:  # the others' lists are not asked for any more
            frame.in_view = place[frame.in_view[keep[frame.in_view]]]

    def _append(self, params: np.ndarray) -> None:
        new, capacity = params.shape[1], self.params.shape[1]
        if self.count + new > capacity:
            old = (self.params, self._first, self._second, self._steps)
            self._allocate(-(-max(self.count + new, 2 * capacity) // 16) * 16)
            for array, before in zip((self.params, self._first, self._second, self._steps), old):
                array[..., :capacity] = before
        self.params[:, self.count : self.count + new] = params
        for array in (self._first, self._second, self._steps):
            array[..., self.count : self.count + new] = 0.0
        self.count += new

    # --- optimising --------------------------------------------------------------------------------

    def step(self, frame: MapKeyframe) -> tuple[float, np.ndarray]:
        """One step of Adam on what a keyframe sees. Gives the loss, and dL/dxi [6] of its T_camera_map."""
        s, pixels = self.settings, frame.z_m.size
        render = self.render(self.camera, inverse(frame.T_map_camera))
        loss = map_loss(
            render.image, frame.rgb, frame.z_m, frame.weight, np.float32(1.0 / (3 * pixels)),
            np.float32(s.depth_weight / pixels), self._gradient,
        )  # fmt: skip
        gradients = self.rasterizer.backward(render, self._gradient)
        adam_rows(
            gradients.by_splat, gradients.index, len(gradients.index), self.params, self._first, self._second,
            self._steps, self._rates,
        )  # fmt: skip
        pose = gradients.pose.copy()
        self.release(render)
        return float(loss), pose

    def close(self) -> None:
        """Ends the rasterizer."""
        self.rasterizer.close()


def _unexplained(image: np.ndarray, frame: MapKeyframe, s: CameraTrackerSettings) -> np.ndarray:
    """bool [H, W]: seen through, of another colour, or behind what the depth says."""
    alpha = image[4]
    colour_off = cv2.blur(np.abs(image[:3] - frame.rgb).mean(axis=0), (5, 5)) > s.colour_off
    expected = image[3] / np.maximum(alpha, 1e-3)
    known = (frame.z_m > 0.0) & (frame.weight > 0.5)
    depth_off = (known & (np.abs(expected - frame.z_m) > s.depth_off * frame.z_m)).astype(np.uint8)
    depth_off = cv2.erode(depth_off, np.ones((5, 5), np.uint8)) > 0
    return (alpha < s.alpha_low) | colour_off | depth_off


def _candidates(
    missing: np.ndarray, frame: MapKeyframe, s: CameraTrackerSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v, spacing in px) of pixels to turn into Gaussians: a coarse lattice, a fine one on texture."""
    h, w = missing.shape
    grey = frame.rgb.mean(axis=0)
    change = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    rough = cv2.blur(change, (s.stride_px + 1, s.stride_px + 1)) * np.float32(0.5) > s.texture
    out = []
    for step, wanted in ((s.stride_px, ~rough), (s.fine_stride_px, rough)):
        v, u = np.mgrid[step // 2 : h : step, step // 2 : w : step]
        v, u = v.ravel(), u.ravel()
        cell_v = np.minimum(v // s.stride_px * s.stride_px + s.stride_px // 2, h - 1)
        cell_u = np.minimum(u // s.stride_px * s.stride_px + s.stride_px // 2, w - 1)
        chosen = missing[v, u] & wanted[cell_v, cell_u] & (frame.z_m[v, u] > 0.0)
        out.append(np.stack([u[chosen], v[chosen], np.full(chosen.sum(), step)]))
    u, v, spacing = np.concatenate(out, axis=1)
    order = np.lexsort((u // 32, v // 32))  # neighbours in the picture become neighbours in memory
    return u[order], v[order], spacing[order].astype(np.float64)


def make_discs(
    u: np.ndarray, v: np.ndarray, spacing_px: np.ndarray, frame: MapKeyframe, camera: RasterCamera,
    s: CameraTrackerSettings,
) -> np.ndarray:  # fmt: skip
    """float32 [14, N]: discs at pixels (u, v), as wide as the spacing, flat along the depth's normal."""
    z = frame.z_m[v, u].astype(np.float64)
    normals = _normals(frame.z_m, u, v, camera)
    points = _points(frame.z_m, u, v, camera)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    slant = np.clip(np.abs(np.sum(normals * rays, axis=1)), 0.2, 1.0)
    across = s.size * spacing_px * z / camera.fx_px
    R = frame.T_map_camera[:3, :3]
    out = np.empty((PARAMS, len(u)), np.float32)
    out[MEAN:SCALE] = (points @ R.T + frame.T_map_camera[:3, 3]).T
    out[SCALE] = np.log(across / slant)  # along the slope a pixel covers more surface
    out[SCALE + 1] = np.log(across)
    out[SCALE + 2] = np.log(across * s.flatness)
    out[QUAT:OPACITY] = disc_quats(normals @ R.T, rays @ R.T).T
    out[OPACITY] = np.log(s.opacity / (1.0 - s.opacity))
    out[COLOUR:] = frame.rgb[:, v, u]
    return out


def _points(z_m: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera) -> np.ndarray:
    """float64 [N, 3] in the camera's frame."""
    z = z_m[v, u].astype(np.float64)
    return np.stack([(u - camera.cx_px) / camera.fx_px * z, (v - camera.cy_px) / camera.fy_px * z, z], axis=1)


def _normals(z_m: np.ndarray, u: np.ndarray, v: np.ndarray, camera: RasterCamera) -> np.ndarray:
    """Unit normals [N, 3] towards the camera by differences; the line of sight where the depth jumps."""
    h, w = z_m.shape
    here = z_m[v, u]

    def beside(du: int, dv: int) -> tuple[np.ndarray, np.ndarray]:
        uu, vv = np.clip(u + du, 0, w - 1), np.clip(v + dv, 0, h - 1)
        return _points(z_m, uu, vv, camera), np.abs(z_m[vv, uu] - here) < 0.05 * here

    (right, a), (left, b) = beside(_SEARCH_PX, 0), beside(-_SEARCH_PX, 0)
    (down, c), (up, d) = beside(0, _SEARCH_PX), beside(0, -_SEARCH_PX)
    normal = np.cross(right - left, down - up)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    point = _points(z_m, u, v, camera)
    view = -point / np.linalg.norm(point, axis=1, keepdims=True)
    smooth = (a & b & c & d)[:, None] & (length > 1e-12)
    normal = np.where(smooth, normal / np.maximum(length, 1e-12), view)
    return np.where(np.sum(normal * view, axis=1, keepdims=True) < 0.0, -normal, normal)


def disc_quats(normals: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) [N, 4] of discs: z along unit normals [N, 3], x down the slope seen by rays.

    The shortest turn that takes the z axis to the normal, after a turn about z that takes x to the slope.
    """
    n = np.where(normals[:, 2:] < -0.999, -normals, normals)  # a disc has two sides
    tilt = np.stack([1.0 + n[:, 2], -n[:, 1], n[:, 0]], axis=1)
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    w, x, y = tilt.T
    # The ray in the tilted frame: its part in the disc's plane is the slope.
    along_x = (1 - 2 * y * y) * rays[:, 0] + 2 * x * y * rays[:, 1] - 2 * w * y * rays[:, 2]
    along_y = 2 * x * y * rays[:, 0] + (1 - 2 * x * x) * rays[:, 1] + 2 * w * x * rays[:, 2]
    half = 0.5 * np.arctan2(along_y, along_x)
    c, d = np.cos(half), np.sin(half)
    return np.stack([w * c, x * c + y * d, y * c - x * d, w * d], axis=1)
