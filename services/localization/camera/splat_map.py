"""The tracker's own Gaussian map: Gaussians placed on the surfaces of keyframe depth, then optimised.

It serves tracking only and is separate from the map of the mapping service.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.discs import choose_pixels, make_discs
from beamsplat.common.raster.layout import MEAN, OPACITY, SCALE
from beamsplat.common.raster.optimiser import GaussianArrays, learning_rates
from beamsplat.common.raster.rasterizer import Rasterizer, Render
from beamsplat.services.localization.camera.kernels import map_loss
from beamsplat.services.localization.camera.settings import CameraTrackerSettings


@dataclass
class MapKeyframe:
    """A keyframe of the tracker's map, at the tracker's resolution."""

    stamp_ns: int
    T_map_camera: np.ndarray  # float64 [4, 4]
    rgb: np.ndarray  # float32 [3, H, W] in [0, 1]
    z_m: np.ndarray  # float32 [H, W], 0 unknown
    weight: np.ndarray  # float32 [H, W] of the depth
    in_view: np.ndarray  # int32: Gaussians in the frustum when the keyframe was added; of the newest only
    thumbnail: np.ndarray  # float32 [h, w], descriptor for relocalization


class SplatMap:
    """The Gaussians, and the keyframes from which they were created."""

    def __init__(self, camera: RasterCamera, settings: CameraTrackerSettings) -> None:
        self.camera, self.settings = camera, settings
        self.rasterizer = Rasterizer()
        self.keyframes: list[MapKeyframe] = []
        self.store = GaussianArrays(1 << 14)
        s = settings
        self._rates = learning_rates(
            s.mean_rate_m, s.log_scale_rate, s.quat_rate, s.opacity_rate, s.colour_rate
        )
        self._gradient = np.empty((5, camera.height_px, camera.width_px), np.float32)

    def render(self, camera: RasterCamera, T_camera_map: np.ndarray) -> Render:
        """Render the map from the camera pose `T_camera_map`; pass the result to `release` after use."""
        return self.rasterizer.render(self.store.params, self.store.count, camera, T_camera_map)

    def release(self, render: Render) -> None:
        """Return the buffers of a render to the rasterizer."""
        self.rasterizer.release(render)

    # --- growing -----------------------------------------------------------------------------------

    def add(self, frame: MapKeyframe) -> int:
        """Add a keyframe, and Gaussians where the map differs from it; return the number of new Gaussians."""
        s = self.settings
        render = self.render(self.camera, inverse(frame.T_map_camera))
        missing = _unexplained(render.image, frame, s)
        stale = self._contradicted_by(render.index.copy(), missing, frame)
        self.release(render)
        if len(stale):
            self._remove(stale)
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
        for before in self.keyframes[-1:]:
            before.in_view = np.zeros(0, np.int32)  # not used any more
        self.keyframes.append(frame)
        if len(self.keyframes) > s.max_keyframes:
            self._drop_keyframe()
        return len(u)

    def _drop_keyframe(self) -> None:
        """Drop the keyframe that is most similar to a newer one: relocalization needs it least.

        The first keyframe and the newest `window` stay.
        """
        thumbnails = np.array([frame.thumbnail.ravel() for frame in self.keyframes])
        correlation = np.triu(thumbnails @ thumbnails.T, 1)  # of each keyframe with all newer ones
        most_similar = correlation[1 : -self.settings.window].max(axis=1)
        del self.keyframes[1 + int(np.argmax(most_similar))]

    def _contradicted_by(self, index: np.ndarray, missing: np.ndarray, frame: MapKeyframe) -> np.ndarray:
        """Return the indices int32 [C] of the Gaussians that contradict the keyframe; `add` removes them.

        A Gaussian contradicts the keyframe if it is in front of the measured surface, transparent, or on the
        surface but too large or of another colour.

        Args:
            index: int32 [V], the Gaussians in view of the keyframe.
            missing: bool [H, W], see `_unexplained`.
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
        known = (surface > 0.0) & (frame.weight[v, u] > s.min_depth_weight)
        size = np.exp(self.store.params[SCALE : SCALE + 2, index].max(axis=0))
        floats = known & (z + 2.0 * size < surface * (1.0 - s.float_margin))
        on_surface = (surface > 0.0) & (np.abs(z - surface) < s.max_depth_error * surface)
        coarse = size * camera.fx_px / z > s.coarse_px
        faint = self.store.params[OPACITY, index] < np.log(s.prune_opacity / (1.0 - s.prune_opacity))
        return index[floats | faint | (on_surface & (missing[v, u] | coarse))]

    def _remove(self, index: np.ndarray) -> None:
        """Remove Gaussians; the others keep their order. Renumbers `in_view` of the newest keyframe."""
        if not len(index):
            return
        keep = np.ones(self.store.count, bool)
        keep[index] = False
        self.store.keep(keep)
        new_index = np.cumsum(keep, dtype=np.int32) - 1
        for frame in self.keyframes[-1:]:
            frame.in_view = new_index[frame.in_view[keep[frame.in_view]]]

    # --- optimising --------------------------------------------------------------------------------

    def step(self, frame: MapKeyframe) -> tuple[float, np.ndarray]:
        """Optimise the Gaussians by one Adam step on one keyframe.

        Returns:
            The loss, and its gradient dL/dxi [6] with respect to a left perturbation of T_camera_map.
        """
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
        """Release the rasterizer's threads and buffers."""
        self.rasterizer.close()


def _unexplained(image: np.ndarray, frame: MapKeyframe, s: CameraTrackerSettings) -> np.ndarray:
    """Return bool [H, W]: pixels where the map is transparent or has another colour or depth than `frame`."""
    alpha = image[4]
    colour_differs = cv2.blur(np.abs(image[:3] - frame.rgb).mean(axis=0), (5, 5)) > s.max_colour_error
    expected = image[3] / np.maximum(alpha, 1e-3)
    known = (frame.z_m > 0.0) & (frame.weight > 0.5)
    depth_differs = (known & (np.abs(expected - frame.z_m) > s.max_depth_error * frame.z_m)).astype(np.uint8)
    depth_differs = cv2.erode(depth_differs, np.ones((5, 5), np.uint8)) > 0
    return (alpha < s.alpha_low) | colour_differs | depth_differs
