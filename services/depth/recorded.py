"""Source `recorded`: reads depth maps from a folder, for networks that cannot run on this machine."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.messages.image_codec import decode_compressed
from beamsplat.common.messages.image_header import read_image_header
from beamsplat.services.depth.source import DepthInput, Estimate, Kind, check_depth_map


class RecordedDepth:
    """Depth source that reads `<stamp_ns>.png` (uint16 mm, 0 = unknown) or `.npy` (float; option `kind`).

    Raises:
        UserError: the folder is missing, or contains no such file.
    """

    def __init__(self, folder: str | Path = "", kind: Kind = "metric", tolerance_ns: int = 1_000_000) -> None:
        self._folder = Path(folder)
        if not folder or not self._folder.is_dir():
            raise UserError(f"recorded depth: folder = {str(folder)!r} is not a folder with depth maps")
        files = [p for p in self._folder.iterdir() if p.suffix in (".png", ".npy") and p.stem.isdigit()]
        if not files:
            raise UserError(f"{self._folder}: contains no <stamp_ns>.png and no <stamp_ns>.npy")
        files.sort(key=lambda p: int(p.stem))
        self._stamps = np.array([int(p.stem) for p in files], dtype=np.int64)
        self._files = files
        self._kind = kind
        self._tolerance_ns = tolerance_ns

    def estimate(self, view: DepthInput) -> Estimate:
        """Return the depth map nearest in time, resized to the image size.

        If its stamp differs by more than the tolerance, all values are NaN and `status` contains the reason.
        """
        i = int(np.argmin(np.abs(self._stamps - view.stamp_ns)))
        empty = np.full(view.camera.shape, np.nan, dtype=np.float32)
        if abs(int(self._stamps[i]) - view.stamp_ns) > self._tolerance_ns:
            return Estimate(empty, self._kind, f"no recorded depth at {view.stamp_ns} ns")
        values = read_depth(self._files[i])
        if values.shape != view.camera.shape:
            h, w = view.camera.shape
            if abs(values.shape[1] / values.shape[0] - w / h) > 0.02:
                return Estimate(
                    empty, self._kind,
                    f"{self._files[i]}: {values.shape[1]}x{values.shape[0]} does not fit the {w}x{h} image",
                )  # fmt: skip
            values = cv2.resize(values, (w, h), interpolation=cv2.INTER_NEAREST)
        return Estimate(values, self._kind, check_depth_map(values, min_known_share=0.01))


def read_depth(path: Path) -> np.ndarray:
    """Return a depth map float32 [H, W]: a 16 bit PNG in mm as metres (0 = NaN), or a .npy file unchanged.

    Raises:
        UserError: the file cannot be read, or is neither of these two.
    """
    if path.suffix == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError, MemoryError, TypeError) as error:
            raise UserError(f"{path}: not a numpy array: {reason(error)}") from error
    else:
        raw = _read_png(path)
        if raw.dtype != np.uint16:
            raise UserError(f"{path}: expected a 16 bit PNG in millimetres")
        values = np.where(raw > 0, raw, np.nan) * 1e-3
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        raise UserError(f"{path}: {values.dtype} {list(values.shape)}; expected numbers [H, W]")
    return values.astype(np.float32)


def _read_png(path: Path) -> np.ndarray:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        head = read_image_header(data.data)
        if head is None or head.encoding != "png":
            raise UserError("not a PNG")
        return decode_compressed(data, "png", head.width_px, head.height_px, cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read: {reason(error)}") from error
