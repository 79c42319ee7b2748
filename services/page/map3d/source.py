"""Where the 3D map of a page comes from: the base of the live map and of saved maps."""

from __future__ import annotations

import threading
from collections import OrderedDict
from http import HTTPStatus
from typing import Any, NamedTuple

import cv2
import numpy as np

from beamsplat.services.page.map3d.levelled_map import LevelledMap, as_json

THUMBNAIL_PX = 320  # widest thumbnail of a keyframe
_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 75)
_IMAGES_BYTES = 24_000_000  # images of keyframes that are kept: about 300
_NO_MAPPER = "this page has no connection to a mapper"


class MapUnavailable(Exception):
    """Error: an image cannot be had now; with the status of the response, and why."""

    def __init__(self, text: str, status: HTTPStatus = HTTPStatus.SERVICE_UNAVAILABLE) -> None:
        super().__init__(text)
        self.status = status


class ViewRequest(NamedTuple):
    """A view of the map that a viewer asks for; the principal point is the centre of the image."""

    T_map_camera: np.ndarray  # float64 [4, 4], optical frame
    width_px: int
    height_px: int
    focal_px: float


class ShownCamera(NamedTuple):
    """The pinhole camera of the keyframes' undistorted images."""

    width_px: int
    height_px: int
    K: np.ndarray  # float64 [3, 3]


class MountedCamera(NamedTuple):
    """The camera of a robot."""

    shown: ShownCamera
    T_body_camera: np.ndarray  # float64 [4, 4]


class MapSource:
    """A map for viewers in browsers, without any content: base class, and what a page without bus has."""

    saved = False  # whether the map is complete and does not change

    def __init__(self, budget_mb: float = 0.0) -> None:
        self.map = LevelledMap(int(budget_mb * 1e6))
        self.keyframes: dict[int, np.ndarray] = {}  # id -> T_map_camera; replaced as a whole
        self.camera: ShownCamera | None = None
        self.note = _NO_MAPPER  # why the map is not complete; "" = it is
        self._images: OrderedDict[tuple[int, int], bytes] = OrderedDict()  # (id, width; 0: whole) -> JPEG
        self._images_lock = threading.Lock()

    # --- overridden ---

    def want(self) -> None:
        """Note that somebody looks at the map; returns at once."""

    @property
    def active(self) -> bool:
        """Whether the map is being followed."""
        return False

    def close(self) -> None:
        """Release what the source holds; it is not used afterwards."""

    def render(self, view: ViewRequest) -> bytes:
        """Return the map from a view as JPEG.

        Raises:
            MapUnavailable: it cannot be rendered now.
        """
        raise MapUnavailable(self.note or _NO_MAPPER)

    def _read_image(self, id: int) -> bytes:
        """Return the undistorted image of a keyframe as JPEG, or what `cv2.imdecode` reads.

        Raises:
            MapUnavailable: the image is not kept, or the mapper does not answer.
        """
        raise MapUnavailable(f"no keyframe {id}", HTTPStatus.NOT_FOUND)

    # --- read by the server ---

    def index(self) -> dict[str, Any]:
        """Return chunks, keyframes and camera, as data for JSON.

        Ids of keyframes are texts: JavaScript rounds numbers beyond 2^53.
        """
        camera = self.camera
        return {
            "producer": self.map.producer, "revision": self.map.revision, "saved": self.saved,
            "note": self.note, "editable": False, "chunks": self.map.index(),
            "keyframes": [{"id": str(id), "T_map_camera": as_json(T)} for id, T in self.keyframes.items()],
            "camera": None if camera is None else {
                "width": camera.width_px, "height": camera.height_px, "K": as_json(camera.K)
            },
            "limited": {
                "coarsened": self.map.coarsened, "left_out": self.map.left_out,
                "budget_mb": round(self.map.budget_bytes / 1e6, 1),
            },
        }  # fmt: skip

    def keyframe(self, id: int, width_px: int) -> bytes:
        """Return the image of a keyframe as JPEG, `width_px` wide; 0 = as large as it is. It is kept.

        Raises:
            MapUnavailable: there is no such keyframe, or its image cannot be had now.
        """
        key = (id, min(width_px, THUMBNAIL_PX))
        with self._images_lock:
            if key in self._images:
                self._images.move_to_end(key)
                return self._images[key]
        if id not in self.keyframes:
            raise MapUnavailable(f"no keyframe {id}", HTTPStatus.NOT_FOUND)
        whole = self.keyframe(id, 0) if key[1] else self._read_image(id)
        image = _resized(whole, key[1]) if key[1] else whole
        with self._images_lock:
            self._images[key] = image
            while sum(map(len, self._images.values())) > _IMAGES_BYTES:
                self._images.popitem(last=False)
        return image

    def forget_images(self) -> None:
        """Remove the kept images: ids belong to another map."""
        with self._images_lock:
            self._images.clear()


def _resized(jpeg: bytes, width_px: int) -> bytes:
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        raise MapUnavailable("the image of this keyframe cannot be decoded", HTTPStatus.NOT_FOUND)
    height = max(round(bgr.shape[0] * width_px / bgr.shape[1]), 1)
    return cv2.imencode(".jpg", cv2.resize(bgr, (width_px, height), interpolation=cv2.INTER_AREA), _QUALITY)[
        1
    ].tobytes()
