"""The tracker's own small map: Gaussians put where keyframes' depth shows surfaces, and optimised a little.

It is not the map that anybody looks at: it has to look like the pictures from where the camera is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.discs import choose_pixels, make_discs
from beamsplat.common.raster.layout import MEAN, OPACITY, SCALE
from beamsplat.common.raster.optimiser import GaussianArrays, rate_rows
from beamsplat.common.raster.rasterizer import Rasterizer, Render
from beamsplat.services.localization.camera.kernels import map_loss
from beamsplat.services.localization.camera.settings import CameraTrackerSettings


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
    """Gaussians, and the pictures that they were made of."""

    def __init__(self, camera: RasterCamera, settings: CameraTrackerSettings) -> None:
        self.camera, self.settings = camera, settings
        self.rasterizer = Rasterizer()
        self.keyframes: list[MapKeyframe] = []
        self.store = GaussianArrays(1 << 14)
        s = settings
        self._rates = rate_rows(s.mean_rate_m, s.log_scale_rate, s.quat_rate, s.opacity_rate, s.colour_rate)
        self._gradient = np.empty((5, camera.height_px, camera.width_px), np.float32)

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> Render:
        """The map from a pose; give it back with `release`."""
        return self.rasterizer.render(self.store.params, self.store.count, camera, T_camera_map)

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
        grey = frame.rgb.mean(axis=0)
        wanted = missing & (frame.z_m > 0.0)
        lattice = choose_pixels(wanted, grey, s.stride_px, s.fine_stride_px, s.texture)
        room = s.max_gaussians - self.store.count
        u, v, spacing = (column[:room] for column in lattice)
        if len(u):
            discs = make_discs(
                u, v, spacing, frame.z_m, frame.rgb[:, v, u], self.camera, frame.T_map_camera,
                size=s.size, flatness=s.flatness, opacity=s.opacity, least_slant=0.2,
            )  # fmt: skip
            self.store.append(discs)
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
        points = T[:3, :3] @ self.store.params[MEAN:SCALE, index] + T[:3, 3:4]
        z = np.maximum(points[2], 1e-6)
        u = np.floor(points[0] / z * camera.fx_px + camera.cx_px + 0.5).astype(np.int64)
        v = np.floor(points[1] / z * camera.fy_px + camera.cy_px + 0.5).astype(np.int64)
        inside = (points[2] > 0.05) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        index, z, u, v = index[inside], z[inside], u[inside], v[inside]
        surface = frame.z_m[v, u]
        known = (surface > 0.0) & (frame.weight[v, u] > s.least_depth_weight)
        size = np.exp(self.store.params[SCALE : SCALE + 2, index].max(axis=0))
        floats = known & (z + 2.0 * size < surface * (1.0 - s.float_margin))
        on_it = (surface > 0.0) & (np.abs(z - surface) < s.depth_off * surface)
        coarse = size * camera.fx_px / z > s.coarse_px
        faint = self.store.params[OPACITY, index] < np.log(s.prune_opacity / (1.0 - s.prune_opacity))
        return index[floats | faint | (on_it & (missing[v, u] | coarse))]

    def _drop(self, index: np.ndarray) -> None:
        """Removes Gaussians; the others keep their order, and the keyframes' lists their meaning."""
        if not len(index):
            return
        keep = np.ones(self.store.count, bool)
        keep[index] = False
        self.store.keep(keep)
        place = np.cumsum(keep, dtype=np.int32) - 1
        for frame in self.keyframes[-1:]:  # the others' lists are not asked for any more
            frame.in_view = place[frame.in_view[keep[frame.in_view]]]

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
        self.store.step(self.rasterizer.team, gradients, self._rates)
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
