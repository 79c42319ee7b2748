"""Encoding of images for the page: only while a page is open, and once for all open pages."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np

from beamsplat.common.mapfiles.grid_tiles import TiledGrid
from beamsplat.common.messages.image_codec import decode_rgb

_DEPTH_RANGE_M = (0.3, 8.0)  # of the colour scale: indoor distances
_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 75)
_FREE, _OCCUPIED = 235, 20  # grey values of map cells
_WIDEST_MAP_PX = 4096  # larger maps are shown with larger cells


class EncodedImage(NamedTuple):
    """An image in a format that browsers can show; `metadata` is part of the image's event."""

    data: bytes
    content_type: str
    metadata: dict[str, Any]


class LatestImage:
    """The newest image of one kind. `update` and `encode_newest` may be called from different threads."""

    def __init__(self, max_hz: float) -> None:
        self._period_s = 1.0 / max_hz
        self._pending: tuple[int, float, Callable[[], EncodedImage]] | None = None
        self._encoded_at_s = -1e9
        self.number = 0  # of the encoded image
        self.received_s = 0.0  # when the encoded image was set: monotonic, s
        self.encoded: EncodedImage | None = None
        self.fault = ""  # why the newest image could not be encoded

    def update(self, encode: Callable[[], EncodedImage]) -> None:
        """Set a function that encodes the newest image; it is called only if a page needs the image."""
        number = self._pending[0] + 1 if self._pending else 1
        self._pending = number, time.monotonic(), encode

    @property
    def newest(self) -> int:
        """Number of the newest image, encoded or not; 0 = there is none yet."""
        return self._pending[0] if self._pending else 0

    def due(self) -> bool:
        """Return whether there is a newer image than the encoded one and the rate limit permits it."""
        pending = self._pending
        newer = pending is not None and pending[0] != self.number
        return newer and time.monotonic() - self._encoded_at_s >= self._period_s

    def encode_newest(self) -> None:
        """Encode the newest image.

        If its bytes are damaged, the last valid image remains and `fault` contains the reason.
        """
        pending = self._pending
        if pending is None:
            return
        self._encoded_at_s = time.monotonic()
        try:
            self.encoded, self.fault = pending[2](), ""
        except ValueError as error:  # damaged bytes
            self.fault = str(error)
        self.number, self.received_s = pending[:2]

    def metadata(self) -> dict[str, Any] | None:
        """Return the image's number and metadata for its event; None before the first image."""
        if self.encoded is None:
            return None
        return {"number": self.number, **self.encoded.metadata}


def encode_camera_image(
    data: np.ndarray,  # uint8 [B]
    encoding: str,
    size_px: tuple[int, int],  # width, height
    step_bytes: int,
    widest_px: int,
) -> EncodedImage:
    """Return a camera image as JPEG, at most `widest_px` wide; a narrower JPEG is returned unchanged.

    Raises:
        ValueError: the bytes cannot be decoded.
    """
    if encoding == "jpeg" and size_px[0] <= widest_px:
        return EncodedImage(data.tobytes(), "image/jpeg", {})
    rgb = decode_rgb(data, encoding, *size_px, step_bytes, least_width_px=widest_px)
    return _jpeg(_shrink(rgb[..., ::-1], widest_px))


def encode_depth(
    depth_m: np.ndarray,  # float32 [H, W], NaN = unknown
    widest_px: int,
) -> EncodedImage:
    """Return a depth map [H, W] (m) as colour image: near is red, unknown is black.

    Neither side is longer than `widest_px`.
    """
    stride = -(-max(depth_m.shape) // widest_px)
    small = depth_m[::stride, ::stride]
    near, far = _DEPTH_RANGE_M
    known = np.isfinite(small)
    nearness = (far - np.clip(np.where(known, small, far), near, far)) / (far - near)
    colours = cv2.applyColorMap((nearness * 255.0).astype(np.uint8), cv2.COLORMAP_TURBO)
    colours[~known] = 0
    return _jpeg(colours)


def encode_tiles(grid: TiledGrid) -> EncodedImage:
    """Return a grid that consists of tiles as `encode_grid` does, with larger cells if it is very large.

    Raises:
        ValueError: no cell is known yet, or the tiles are too far apart.
    """
    stride = grid.stride_for(_WIDEST_MAP_PX)
    cell_m = 1.0 if grid.source is None else grid.source.resolution_m * stride
    occupancy = grid.assembled(stride, max_cells=_WIDEST_MAP_PX**2)
    return encode_grid(occupancy, cell_m, grid.origin_m())


def encode_grid(
    occupancy: np.ndarray,  # int8 [H, W], row 0 at the smallest y; -1 unknown, 0 free .. 100 occupied
    resolution_m: float,
    origin_m: np.ndarray,  # [2], corner of cell (0, 0)
) -> EncodedImage:
    """Return the known part of an occupancy grid as PNG, largest y at the top; unknown is transparent.

    `metadata`: lower left corner (m), cell size (m), width and height in cells.

    Raises:
        ValueError: no cell is known yet.
    """
    known = occupancy >= 0
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not len(rows):
        raise ValueError("no cell of the map is known yet")
    row0, column0 = rows[0], columns[0]
    part = occupancy[row0 : rows[-1] + 1, column0 : columns[-1] + 1][::-1].astype(np.float32)
    grey = np.clip(_FREE + (_OCCUPIED - _FREE) * part / 100.0, 0, 255).astype(np.uint8)
    alpha = np.where(part >= 0, 255, 0).astype(np.uint8)
    pixels = np.stack([grey, grey, grey, alpha], axis=-1)
    png = cv2.imencode(".png", pixels, (cv2.IMWRITE_PNG_COMPRESSION, 2))[1].tobytes()
    corner_m = np.asarray(origin_m) + resolution_m * np.array([column0, row0])
    metadata = {
        "x_m": round(float(corner_m[0]), 4), "y_m": round(float(corner_m[1]), 4), "cell_m": resolution_m,
        "width": part.shape[1], "height": part.shape[0],
    }  # fmt: skip
    return EncodedImage(png, "image/png", metadata)


def _shrink(bgr: np.ndarray, widest_px: int) -> np.ndarray:
    height, width = bgr.shape[:2]
    if width <= widest_px:
        return bgr
    size = widest_px, max(round(height * widest_px / width), 1)
    return cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)


def _jpeg(bgr: np.ndarray) -> EncodedImage:
    return EncodedImage(
        cv2.imencode(".jpg", np.ascontiguousarray(bgr), _QUALITY)[1].tobytes(), "image/jpeg", {}
    )
