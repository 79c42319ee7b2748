"""What one session observed, in the common frame: depth of its keyframes, its Gaussians, lidar submaps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from beamsplat.common.geometry.camera import Undistorter
from beamsplat.common.geometry.depth_sigma import OF_KEYFRAMES, stated_sigma_log
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import KeyframeView, keyframe_views, store_of
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.mapfiles.surface import flying_pixels
from beamsplat.common.messages import Keyframe
from beamsplat.common.messages.codec import decode
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.services.mapping.messages import decode_keyframe

WIDTH_PX = 160  # working width: a pixel at 3 m is a few centimetres, the size of a voxel
MIN_ALPHA = 0.8  # rendered pixels with less are seen through


@dataclass(frozen=True)
class DepthView:
    """What one keyframe observed, at the working size."""

    id: int
    camera: RasterCamera
    T_map_camera: np.ndarray  # float64 [4, 4]
    # Half precision, because all views of a session are in memory: 4 mm at 4 m.
    depth_m: np.ndarray  # float16 [H, W] optical z measured at the keyframe, NaN = unknown
    sigma_m: np.ndarray  # float16 [H, W] its standard deviation with gross errors
    rendered_m: np.ndarray  # float16 [H, W] optical z of the session's own map, NaN = unsure
    rgb: np.ndarray  # uint8 [H, W, 3] rendered from the session's own map


@dataclass(frozen=True)
class MappedDrive:
    """A session whose contents are in the common map frame."""

    name: str
    store: GaussianStore
    slam: LidarSlam
    pose_map_submap: dict[int, np.ndarray]  # float64 [3] by submap id, in the common frame
    keyframes: list[KeyframeView]  # poses in the common frame
    read: Callable[[int], Any]  # RgbdKeyframe by id; raises ValueError


def open_drive(
    folder: SessionFolder, arrays: Arrays, slam: LidarSlam, pose_map_submap: dict[int, np.ndarray]
) -> MappedDrive:
    """Return a session in the common frame.

    Args:
        arrays: state of the session whose anchors are in the common frame already.
        pose_map_submap: poses of the submaps of `slam` in the common frame.
    """
    lens = lru_cache(maxsize=4)(Undistorter)

    def read(id: int) -> Any:
        message = decode(*folder.read_keyframe(id))
        assert isinstance(message, Keyframe)  # sessions store keyframes only
        return decode_keyframe(message, lens)

    path = folder.path.resolve()
    name = path.parent.name if path.name == "session" else path.name  # `demo` writes NAME/session
    return MappedDrive(name, store_of(arrays), slam, pose_map_submap, keyframe_views(arrays), read)


def depth_views(
    drive: MappedDrive,
    rasterizer: Rasterizer,
    progress: Callable[[list[KeyframeView]], Iterable[KeyframeView]] = iter,
) -> Iterator[DepthView]:
    """Yield what each keyframe of a session observed; keyframes that cannot be decoded are skipped."""
    for view in progress(drive.keyframes):
        try:
            frame = drive.read(view.id)
        except ValueError:
            continue
        step = max(view.camera.width_px // WIDTH_PX, 1)
        camera = view.camera.resized(view.camera.width_px // step, view.camera.height_px // step)
        rows, columns = camera.height_px * step, camera.width_px * step
        sampled = np.s_[step // 2 : rows : step, step // 2 : columns : step]
        depth, typical = frame.depth_m[sampled].copy(), frame.sigma_m[sampled]
        if frame.mask is not None:
            depth[~frame.mask[sampled]] = np.nan  # a dynamic object
        with np.errstate(invalid="ignore", divide="ignore"):
            sigma = depth * stated_sigma_log(typical / depth, OF_KEYFRAMES)
        rgb, rendered, alpha = render_rgb_depth(rasterizer, drive.store, camera, view.T_map_camera)
        sure = (alpha > MIN_ALPHA) & np.isfinite(rendered) & ~flying_pixels(rendered)
        rendered = np.where(sure, rendered, np.float32(np.nan))
        yield DepthView(
            id=view.id,
            camera=camera,
            T_map_camera=view.T_map_camera,
            depth_m=depth.astype(np.float16),
            sigma_m=sigma.astype(np.float16),
            rendered_m=rendered.astype(np.float16),
            rgb=(rgb * 255.0 + 0.5).astype(np.uint8),
        )
