"""Saved maps and splat files as the source of the 3D viewer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from http import HTTPStatus
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.mapfiles.ply import read_gaussian_ply
from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import keyframe_views, store_of
from beamsplat.common.mapfiles.store import GaussianStore, transform_gaussians
from beamsplat.common.messages import Keyframe
from beamsplat.common.messages.codec import decode
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.messages import image_message, keyframe_rgb
from beamsplat.services.page.map3d.source import MapSource, MapUnavailable, ShownCamera, ViewRequest

PIECE = 30_000  # Gaussians of a chunk at most: the unit in which viewers load and replace detail
_BUDGET_MB = 8000.0  # the map is complete in memory anyway
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 90)
# Axis of a file that points up -> rotation from the file's frame to the map frame, whose z points up.
UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


class SavedMapSource(MapSource):
    """A complete map; its coarser levels are made in a thread after the start."""

    saved = True

    def __init__(
        self, store: GaussianStore, keyframes: dict[int, np.ndarray], camera: ShownCamera | None,
        read_image: Callable[[int], bytes],
    ) -> None:  # fmt: skip
        """Pack the map.

        Args:
            store: Gaussians in the map frame, z up.
            keyframes: T_map_camera by id.
            camera: of the keyframes.
            read_image: returns the undistorted image of a keyframe as JPEG; raises UserError or ValueError.
        """
        super().__init__(_BUDGET_MB)
        self.keyframes, self.camera, self.note = keyframes, camera, ""
        self._store, self._read = store, read_image
        self._rasterizer: Rasterizer | None = None
        self._closed = threading.Event()
        self.map.start_over(f"saved-{time.time_ns():x}")  # another one for each start: see `Map3dRoutes`
        for number, params in enumerate(pieces(store.params[:, : store.count])):
            self.map.put(number, 1, np.eye(4), 0.0, pack(params).tobytes())
        threading.Thread(target=self._make_levels, name="levels", daemon=True).start()

    def _make_levels(self) -> None:
        while not self._closed.is_set() and self.map.make_levels(time.monotonic()):
            pass

    def close(self) -> None:
        self._closed.set()

    def render(self, view: ViewRequest) -> bytes:
        if self._rasterizer is None:
            self._rasterizer = Rasterizer(1)
        cx_px, cy_px = 0.5 * (view.width_px - 1), 0.5 * (view.height_px - 1)
        camera = RasterCamera(view.focal_px, view.focal_px, cx_px, cy_px, view.width_px, view.height_px)
        rgb, _, _ = render_rgb_depth(self._rasterizer, self._store, camera, view.T_map_camera)
        bgr = cv2.cvtColor((rgb * 255.0 + 0.5).astype(np.uint8), cv2.COLOR_RGB2BGR)
        return cv2.imencode(".jpg", bgr, _JPEG)[1].tobytes()

    def _read_image(self, id: int) -> bytes:
        try:
            return self._read(id)
        except ValueError as error:  # UserError too
            raise MapUnavailable(f"keyframe {id}: {reason(error)}", HTTPStatus.NOT_FOUND) from error


def pieces(params: np.ndarray, most: int = PIECE) -> Iterator[np.ndarray]:
    """Yield Gaussians float32 [14, N] in parts of at most `most`, each of one region of space.

    A part that is too large is halved at the median of its longest axis.
    """
    waiting = [np.arange(params.shape[1])]
    while waiting:
        part = waiting.pop()
        if len(part) <= most:
            if len(part):
                yield params[:, part]
            continue
        means = params[MEAN:SCALE, part]
        low, high = np.percentile(means, [5.0, 95.0], axis=1)
        half = len(part) // 2
        order = np.argpartition(means[int(np.argmax(high - low))], half)
        waiting += [part[order[half:]], part[order[:half]]]


def session_source(path: Path) -> SavedMapSource:
    """Return the map of a saved session, with the images of its keyframes.

    Raises:
        UserError: there is no session, nothing has been saved in it, or it cannot be read.
    """
    folder = SessionFolder(path)
    arrays = folder.read_state()
    if arrays is None:
        raise UserError(f"{path}: nothing has been saved in this session yet")
    store = store_of(arrays)
    _check_size(path, store.count)
    views = keyframe_views(arrays)
    camera = None
    if views:
        c = views[0].camera
        K = np.array([[c.fx_px, 0.0, c.cx_px], [0.0, c.fy_px, c.cy_px], [0.0, 0.0, 1.0]])
        camera = ShownCamera(c.width_px, c.height_px, K)
    lens = lru_cache(maxsize=4)(Undistorter)

    def read_image(id: int) -> bytes:
        message = decode(*folder.read_keyframe(id))
        if not isinstance(message, Keyframe):
            raise ValueError(f"its file holds a {type(message).__name__}")
        if message.encoding == "jpeg" and not Pinhole.of(message.camera).is_distorted:
            return message.picture.tobytes()
        return image_message(keyframe_rgb(message, lens)).data.tobytes()

    return SavedMapSource(store, {view.id: view.T_map_camera for view in views}, camera, read_image)


def ply_source(path: Path, up: str = "z") -> SavedMapSource:
    """Return the splats of a 3DGS `.ply` file.

    Args:
        up: axis of the file that points up, one of `UP`.

    Raises:
        UserError: the file cannot be read, or has no splats; or `up` is no such axis.
    """
    if up not in UP:
        raise UserError(f"--up {up!r}: choose one of {', '.join(UP)}")
    params = read_gaussian_ply(path)
    _check_size(path, params.shape[1])
    store = GaussianStore(params.shape[1])
    store.add(transform_gaussians(params, make_transform(UP[up], np.zeros(3))), 0)

    def no_image(id: int) -> bytes:
        raise ValueError("a splat file has no images")

    return SavedMapSource(store, {}, None, no_image)


def _check_size(path: Path, count: int) -> None:
    if count == 0:
        raise UserError(f"{path}: has no Gaussians: there is nothing to view")
