"""Conversion of the raw image encodings of ROS (sensor_msgs/image_encodings) to those of our messages.

Colour and grey images with 8 bits are passed on as they are. Mosaics of Bayer sensors, subsampled YUV and
16-bit images are converted once, where they enter the system.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.recording.input_report import InputFault

# Encodings with several names in ROS: OpenCV's type names and others. yuv422 is UYVY, see image_encodings.h.
_ALIASES = {
    "8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC3": "bgr16", "16UC4": "bgra16",
    "yuyv": "yuv422_yuy2", "yuy2": "yuv422_yuy2", "yuv422": "uyvy", "yuv420": "i420", "y8": "mono8",
    "y16": "mono16", "rgb": "rgb8", "bgr": "bgr8", "grey": "mono8", "gray": "mono8",
}  # fmt: skip
# Encodings that `common.messages.Image` carries, with their bytes per pixel.
DIRECT = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "yuv422_yuy2": 2}
# ROS names the first two pixels of the first two rows; OpenCV's long names follow the same rule.
_BAYER = {
    "rggb": cv2.COLOR_BayerRGGB2RGB, "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB, "grbg": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
_PLANAR = {
    "nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21, "i420": cv2.COLOR_YUV2RGB_I420,
    "yv12": cv2.COLOR_YUV2RGB_YV12,
}  # fmt: skip
_PACKED = {"uyvy": cv2.COLOR_YUV2RGB_UYVY, "yvyu": cv2.COLOR_YUV2RGB_YVYU}
_WIDE = {"mono16": 1, "rgb16": 3, "bgr16": 3, "rgba16": 4, "bgra16": 4}  # 16 bits: channels
_BITS = (8, 10, 12, 14, 16)  # of the samples in 16-bit images
NOT_CAMERA = ("16UC1", "32FC1", "64FC1", "16SC1", "32SC1", "8SC1", "16SC2", "32FC2", "32FC3", "32FC4")
SUPPORTED = frozenset(
    {*DIRECT, *_PLANAR, *_PACKED, *_WIDE, "nv24", "nv42"}
    | {f"bayer_{pattern}{bits}" for pattern in _BAYER for bits in (8, 16)}
)


def canonical(encoding: str) -> str:
    """Return the usual name of an encoding; unknown names are returned unchanged."""
    name = encoding.strip()
    return _ALIASES.get(name, _ALIASES.get(name.lower(), name if name in NOT_CAMERA else name.lower()))


def is_camera_encoding(encoding: str) -> bool:
    """Return whether images of this encoding can be those of a camera, not depth maps or masks."""
    return canonical(encoding) in SUPPORTED


@dataclass(frozen=True)
class RawImage:
    """A raw image as received; `data` is uint8 [B]."""

    encoding: str  # `canonical`
    width_px: int
    height_px: int
    step_bytes: int
    data: np.ndarray
    big_endian: bool = False

    @property
    def row_bytes(self) -> int:
        """Number of bytes of a row without padding; of the luminance, if the chrominance is apart."""
        name = self.encoding
        if name in DIRECT:
            return self.width_px * DIRECT[name]
        if name in _PACKED:
            return self.width_px * 2
        if name in _WIDE:
            return self.width_px * 2 * _WIDE[name]
        if name.startswith("bayer_"):
            return self.width_px * (2 if name.endswith("16") else 1)
        return self.width_px

    @property
    def rows(self) -> int:
        """Number of rows of `row_bytes` in the data."""
        if self.encoding in _PLANAR:
            return self.height_px * 3 // 2
        return self.height_px * (3 if self.encoding in ("nv24", "nv42") else 1)


def repaired_step(image: RawImage) -> tuple[int, str]:
    """Return (length of a row in bytes, what was wrong with `step`; "" = nothing).

    The number of bytes decides: drivers state a `step` of another encoding, or none.

    Raises:
        InputFault: there are too few bytes for the image, or too many for any padding.
    """
    row, rows, size = image.row_bytes, image.rows, len(image.data)
    if image.encoding in _PLANAR and (image.height_px % 2 or image.width_px % 2):
        raise InputFault("encoding", image.encoding, f"odd size {image.width_px}x{image.height_px} px")
    if (image.encoding in _PACKED or image.encoding == "yuv422_yuy2") and image.width_px % 2:
        raise InputFault("encoding", image.encoding, f"odd width of {image.width_px} px")
    step = image.step_bytes
    if step >= row + image.width_px and step % image.width_px == 0 and size >= step * rows:
        raise InputFault(
            "encoding", image.encoding,
            f"rows of {step} bytes have {step // image.width_px} bytes a pixel, not {row // image.width_px}",
            "correct the encoding that the driver states",
        )  # fmt: skip
    if step >= row and size >= step * (rows - 1) + row:
        return step, ""
    if size < row * rows:
        raise InputFault(
            "data", f"{size} bytes",
            f"the image is truncated: {image.width_px}x{image.height_px} {image.encoding} has "
            f"{row * rows} bytes", "check the driver's width, height and encoding",
        )  # fmt: skip
    if size % rows == 0 and row <= size // rows < 2 * row:
        return size // rows, "does not fit the size of the image and its data: rows of the data's length"
    raise InputFault(
        "step", step, f"does not fit {size} bytes of {image.width_px}x{image.height_px} {image.encoding}",
        "check the driver's width, height and encoding",
    )  # fmt: skip


class RawImageConverter:
    """Converter of the raw images of one topic; the number of bits of 16-bit images is learned.

    `repairs`: what the last image needed, as (field, value, sentence).
    """

    def __init__(self) -> None:
        self._bits = 0
        self.repairs: list[tuple[str, object, str]] = []

    def convert(self, image: RawImage) -> tuple[str, int, np.ndarray]:
        """Return (encoding, step in bytes, data uint8 [B]) for the message `Image`.

        Raises:
            InputFault: the encoding is not that of a camera, or the data do not fit it.
        """
        self.repairs = []
        name = image.encoding
        if name not in SUPPORTED:
            what = "is that of a depth map or mask" if name in NOT_CAMERA else "is not supported"
            raise InputFault("encoding", name, what, "publish rgb8, bgr8, mono8 or compressed images (JPEG)")
        step, wrong = repaired_step(image)
        if wrong and image.step_bytes:
            self.repairs.append(("step", image.step_bytes, wrong))
        if name in DIRECT:
            return name, step, image.data
        pixels = _rows(image.data, image.row_bytes, image.rows, step)
        if name in _PLANAR:
            rgb = cv2.cvtColor(pixels, _PLANAR[name])
        elif name in ("nv24", "nv42"):
            rgb = _from_full_chroma(pixels, image.height_px, swapped=name == "nv42")
        elif name in _PACKED:
            rgb = cv2.cvtColor(pixels.reshape(image.height_px, image.width_px, 2), _PACKED[name])
        elif name.startswith("bayer_"):
            wide = name.endswith("16")
            mosaic = self._eight_bits(pixels, image) if wide else pixels
            rgb = cv2.cvtColor(np.ascontiguousarray(mosaic), _BAYER[name[6:10]])
        else:
            values = self._eight_bits(pixels, image).reshape(image.height_px, image.width_px, -1)
            encoding = name.replace("16", "8")
            return encoding, image.width_px * values.shape[2], np.ascontiguousarray(values).ravel()
        return "rgb8", image.width_px * 3, np.ascontiguousarray(rgb).ravel()

    def _eight_bits(self, pixels: np.ndarray, image: RawImage) -> np.ndarray:
        """Return 16-bit samples, rows of bytes [H, 2N], as uint8 [H, N].

        Cameras of 10 to 14 bits leave the upper bits 0: the largest value seen decides. A wrong byte order
        makes noise of every smooth image, so it shows in the differences between neighbours.
        """
        stated = np.ascontiguousarray(pixels).view(">u2" if image.big_endian else "<u2").astype(np.uint16)
        other = stated.byteswap()
        samples = _WIDE.get(image.encoding, 1)
        if _roughness(stated, samples) > 3.0 * _roughness(other, samples):
            self.repairs.append(
                ("is_bigendian", int(image.big_endian), "the bytes are in the other order: swapped")
            )
            stated = other
        peak = int(np.percentile(stated, 99.9)) if stated.size else 0
        bits = next((b for b in _BITS if peak < 2**b), 16)
        self._bits = max(self._bits, bits)
        if self._bits < 16:
            self.repairs.append(
                ("data", f"at most {peak}", f"samples of {self._bits} bits in 16 bits: scaled to 8 bits")
            )
        return np.minimum(stated >> (self._bits - 8), 255).astype(np.uint8)


def _rows(data: np.ndarray, row_bytes: int, rows: int, step: int) -> np.ndarray:
    """Return uint8 [rows, row_bytes] without the padding at the end of each row."""
    if step == row_bytes:
        return data[: rows * step].reshape(rows, step)
    missing = rows * step - len(data)  # the last row may have no padding
    padded = np.pad(data, (0, missing)) if missing > 0 else data[: rows * step]
    return np.ascontiguousarray(padded.reshape(rows, step)[:, :row_bytes])


def _from_full_chroma(pixels: np.ndarray, height_px: int, *, swapped: bool) -> np.ndarray:
    """Return RGB uint8 [H, W, 3] of NV24 (Y plane, then interleaved U V of full size), NV42: V U."""
    width_px = pixels.shape[1]
    chroma = pixels[height_px:].reshape(height_px, width_px, 2)
    u, v = (chroma[..., 1], chroma[..., 0]) if swapped else (chroma[..., 0], chroma[..., 1])
    # BT.601 with limited range, as OpenCV's conversions of YUV 4:2:0 and 4:2:2.
    y = 1.164 * (pixels[:height_px].astype(np.float32) - 16.0)
    u, v = u.astype(np.float32) - 128.0, v.astype(np.float32) - 128.0
    rgb = np.stack([y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u], axis=-1)
    return np.clip(np.rint(rgb), 0.0, 255.0).astype(np.uint8)


def _roughness(values: np.ndarray, samples: int) -> float:
    """Return the mean difference of samples two pixels apart (as in a mosaic), by their deviation."""
    part = values[::4].astype(np.float32)
    apart = 2 * samples
    if part.shape[1] <= apart or not part.std() > 0.0:
        return 0.0
    return float(np.abs(part[:, apart:] - part[:, :-apart]).mean() / part.std())
