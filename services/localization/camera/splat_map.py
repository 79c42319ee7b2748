"""The tracker's own Gaussian map: Gaussians placed on the surfaces of keyframe depth, then optimised.

It serves tracking only and is separate from the map of the mapping service. Which keyframes there are, and
where Gaussians are added and removed, is decided here; an engine (common/engines) holds and renders the
Gaussians and optimises them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.engines.coverage import differing_pixels
from beamsplat.common.engines.cpu import CpuSplatEngine
from beamsplat.common.engines.protocol import SplatEngine, SplatView
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.discs import choose_pixels, make_discs
from beamsplat.common.raster.layout import MEAN, OPACITY, SCALE
from beamsplat.common.raster.optimiser import learning_rates
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

    def __init__(
        self, camera: RasterCamera, settings: CameraTrackerSettings, engine: SplatEngine | None = None
    ) -> None:
        """`engine` must be empty; None = the CPU. It is closed with the map."""
        self.camera, self.settings = camera, settings
        self.engine: SplatEngine = CpuSplatEngine() if engine is None else engine
        self.keyframes: list[MapKeyframe] = []
        s = settings
        self._rates = learning_rates(
            s.mean_rate_m, s.log_scale_rate, s.quat_rate, s.opacity_rate, s.colour_rate
        )

    @property
    def count(self) -> int:
        """Return the number of Gaussians."""
        return self.engine.store.count

    def view(self, camera: RasterCamera, T_camera_map: np.ndarray) -> SplatView:
        """Render the map from the camera pose `T_camera_map`, float64 [4, 4]."""
        return self.engine.view(camera, T_camera_map)

    def clear(self) -> None:
        """Remove all Gaussians and keyframes."""
        self.engine.store.keep(np.zeros(self.count, bool))
        self.keyframes = []

    # --- growing -----------------------------------------------------------------------------------

    def add(self, frame: MapKeyframe) -> int:
        """Add a keyframe, and Gaussians where the map differs from it; return the number of new Gaussians."""
        s, T_camera_map = self.settings, inverse(frame.T_map_camera)
        before = self.view(self.camera, T_camera_map)
        missing = _unexplained(before.image, frame, s)
        stale = self._contradicted_by(before.visible, missing, frame)
        if len(stale):
            self._remove(stale)
            missing = _unexplained(self.view(self.camera, T_camera_map).image, frame, s)
        grey = frame.rgb.mean(axis=0)
        wanted = missing & (frame.z_m > 0.0)
        lattice = choose_pixels(wanted, grey, s.stride_px, s.fine_stride_px, s.texture)
        room = s.max_gaussians - self.count
        u, v, spacing = (column[:room] for column in lattice)
        if len(u):
            discs = make_discs(
                u, v, spacing, frame.z_m, frame.rgb[:, v, u], self.camera, frame.T_map_camera,
                size=s.size, flatness=s.flatness, opacity=s.opacity, least_slant=0.2,
            )  # fmt: skip
            self.engine.store.add(discs, anchor=0)
        frame.in_view = self.view(self.camera, T_camera_map).visible
        for previous in self.keyframes[-1:]:
            previous.in_view = np.zeros(0, np.int32)  # not used any more
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
        T, params = inverse(frame.T_map_camera), self.engine.store.selected(index)
        points = T[:3, :3] @ params[MEAN:SCALE] + T[:3, 3:4]
        z = np.maximum(points[2], 1e-6)
        u = np.floor(points[0] / z * camera.fx_px + camera.cx_px + 0.5).astype(np.int64)
        v = np.floor(points[1] / z * camera.fy_px + camera.cy_px + 0.5).astype(np.int64)
        inside = (points[2] > 0.05) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
        index, params, z, u, v = index[inside], params[:, inside], z[inside], u[inside], v[inside]
        surface = frame.z_m[v, u]
        known = (surface > 0.0) & (frame.weight[v, u] > s.min_depth_weight)
        size = np.exp(params[SCALE : SCALE + 2].max(axis=0))
        floats = known & (z + 2.0 * size < surface * (1.0 - s.float_margin))
        on_surface = (surface > 0.0) & (np.abs(z - surface) < s.max_depth_error * surface)
        coarse = size * camera.fx_px / z > s.coarse_px
        faint = params[OPACITY] < np.log(s.prune_opacity / (1.0 - s.prune_opacity))
        return index[floats | faint | (on_surface & (missing[v, u] | coarse))]

    def _remove(self, index: np.ndarray) -> None:
        """Remove Gaussians; the others keep their order. Renumbers `in_view` of the newest keyframe."""
        if not len(index):
            return
        keep = np.ones(self.count, bool)
        keep[index] = False
        self.engine.store.keep(keep)
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

        def loss(image: np.ndarray, gradient: np.ndarray) -> float:
            return float(
                map_loss(
                    image, frame.rgb, frame.z_m, frame.weight, np.float32(1.0 / (3 * pixels)),
                    np.float32(s.depth_weight / pixels), gradient,
                )
            )  # fmt: skip

        return self.engine.fit(self.camera, inverse(frame.T_map_camera), loss, self._rates)

    def close(self) -> None:
        """Close the engine."""
        self.engine.close()


def _unexplained(image: np.ndarray, frame: MapKeyframe, s: CameraTrackerSettings) -> np.ndarray:
    """Return bool [H, W]: pixels where the map is transparent or has another colour or depth than `frame`."""
    known = (frame.z_m > 0.0) & (frame.weight > 0.5)
    return differing_pixels(
        image, frame.rgb, frame.z_m, known, min_alpha=s.alpha_low, max_colour_error=s.max_colour_error,
        max_depth_error=s.max_depth_error,
    )  # fmt: skip
