"""Reading of camera images from ROS messages: formats by content, sizes, a calibration that changes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.messages.image_header import is_complete_image, read_image_header
from beamsplat.common.recording.camera_info import is_calibrated, read_camera_info
from beamsplat.common.recording.image_encodings import (
    NOT_CAMERA,
    RawImage,
    RawImageConverter,
    canonical,
    is_camera_encoding,
)
from beamsplat.common.recording.input_report import InputFault, InputReport

_SAME_FOCAL, _SAME_CENTRE = 0.002, 0.002  # relative to the focal length and the width: K has not changed
_LEAST_SHARE = 0.95  # of the calibrated image that an image of another size must show
# First bytes of formats that are not decoded, and how they are called.
_FORMATS = (
    (b"II*\0", "TIFF"), (b"MM\0*", "TIFF"), (b"BM", "BMP"), (b"GIF8", "GIF"),
    (b"\0\0\0\x01", "H.264 or H.265"), (b"\0\0\x01", "H.264 or H.265"),
    (b"\0\0\0\x0cjP", "JPEG 2000"), (b"\xff\x0a", "JPEG XL"),
)  # fmt: skip


def describe_format(data: bytes, stated: str) -> str:
    """Return what compressed image data are, judged by their first bytes, else by the stated format."""
    if not data:
        return "empty"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WebP"
    if data[12:20] == b"\x89PNG\r\n\x1a\n":
        return "a compressed depth map"
    name = next((name for head, name in _FORMATS if data.startswith(head)), "")
    return name or (f"of an unknown format (stated is {stated[:40]!r})")


def is_camera_image(ros_image: Any) -> bool:
    """Return whether a ROS image message has an image of a camera, and not a depth map or mask."""
    if not hasattr(ros_image, "format"):
        return is_camera_encoding(ros_image.encoding)
    source = str(ros_image.format).split(";")[0].strip()
    return source not in NOT_CAMERA and read_image_header(_bytes(ros_image).data) is not None


def image_size_px(ros_image: Any) -> tuple[int, int] | None:
    """Return (width, height) of a ROS image message; None if its format is not read."""
    if not hasattr(ros_image, "format"):
        return int(ros_image.width), int(ros_image.height)
    head = read_image_header(_bytes(ros_image).data)
    return None if head is None else (head.width_px, head.height_px)


class ImageReading:
    """Reads the images of one topic; repairs and refusals are counted in the report.

    Once `calibrate` has been called, an image of another size or with another K is resampled to the
    calibrated image if its CameraInfo states the K of this image; otherwise it is refused.
    """

    def __init__(self, report: InputReport, topic: str, info_topic: str = "") -> None:
        self.report, self.topic, self.info_topic = report, topic, info_topic
        self._converter = RawImageConverter()
        self._camera: dict[str, Any] | None = None
        self._info: Any = None  # newest calibrated CameraInfo
        self._key: tuple[Any, ...] = ()  # of `_info`
        self._current: dict[tuple[Any, ...], dict[str, Any] | None] = {}  # intrinsics by key and image size

    def calibrate(self, camera: dict[str, Any], *, follow: bool) -> None:
        """Set the intrinsics (fields of CameraSection) that the images must have.

        `follow`: resample images whose CameraInfo differs; otherwise CameraInfo is ignored.
        """
        self._camera = camera
        if not follow:
            self.info_topic = ""

    def add_camera_info(self, info: Any) -> None:
        """Store a CameraInfo for the images that follow; those of uncalibrated cameras are counted."""
        if not self.info_topic:
            return
        if not is_calibrated(info):
            self.report.repaired(self.info_topic, "k", 0, "K is zero: K of the other messages is used")
            return
        self._info, self._key = info, _key_of(info)

    def read(self, ros_image: Any) -> dict[str, Any]:
        """Return the fields of the message `Image` without its stamp, not validated.

        Raises:
            InputFault: the image cannot be used.
        """
        compressed = hasattr(ros_image, "format")
        fields = self._compressed(ros_image) if compressed else self._raw(ros_image)
        return self._fitted(fields)

    def _compressed(self, ros_image: Any) -> dict[str, Any]:
        data = _bytes(ros_image)
        head = read_image_header(data.data)
        stated = str(ros_image.format)
        if head is None:
            found = describe_format(data[:32].tobytes(), stated)
            raise InputFault(
                "format", stated[:40], f"the image is {found}", "only JPEG and PNG are decoded: publish JPEG"
            )
        if not is_complete_image(data.data):
            raise InputFault("data", f"{len(data)} bytes", f"the {head.encoding.upper()} is truncated")
        fields: dict[str, Any] = {**head._asdict(), "data": data}
        mosaic = canonical(stated.split(";")[0])
        if mosaic.startswith("bayer_") and is_camera_encoding(mosaic):
            return self._compressed_mosaic(fields, mosaic)
        return fields

    def _compressed_mosaic(self, fields: dict[str, Any], encoding: str) -> dict[str, Any]:
        """Return a compressed Bayer image in colour; drivers also compress the colour image itself."""
        grey = cv2.imdecode(fields["data"], cv2.IMREAD_UNCHANGED)
        if grey is None or grey.ndim != 2 or grey.dtype != np.uint8:
            return fields
        height, width = grey.shape
        raw = RawImage(f"{encoding[:10]}8", width, height, width, grey.ravel())
        name, step, data = self._converter.convert(raw)
        return {"width_px": width, "height_px": height, "encoding": name, "step_bytes": step, "data": data}

    def _raw(self, ros_image: Any) -> dict[str, Any]:
        width, height = int(ros_image.width), int(ros_image.height)
        raw = RawImage(
            canonical(str(ros_image.encoding)), width, height, int(ros_image.step), _bytes(ros_image),
            bool(ros_image.is_bigendian),
        )  # fmt: skip
        if not (0 < width <= 16384 and 0 < height <= 16384):
            raise InputFault("width, height", f"{width}, {height}", "not the size of an image")
        encoding, step, data = self._converter.convert(raw)
        for field, value, what in self._converter.repairs:
            self.report.repaired(self.topic, field, value, what)
        return {
            "width_px": width, "height_px": height, "encoding": encoding, "step_bytes": step, "data": data,
        }  # fmt: skip

    def _fitted(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Return the image as the calibrated camera would have taken it; unchanged if it is such an image."""
        camera = self._camera
        if camera is None:
            return fields
        size = (fields["width_px"], fields["height_px"])
        calibrated = (camera["width_px"], camera["height_px"])
        now = self._intrinsics_now(size)
        if now is None:
            if size == calibrated:
                return fields
            remedy = "record each size apart, or publish the CameraInfo of this size"
            raise InputFault(
                "width, height", f"{size[0]}x{size[1]}",
                f"the calibration is for images of {calibrated[0]}x{calibrated[1]} px", remedy,
            )  # fmt: skip
        if size == calibrated and _same_k(now, camera):
            return fields
        return self._resampled(fields, now, camera)

    def _intrinsics_now(self, size: tuple[int, int]) -> dict[str, Any] | None:
        """Return the intrinsics of images of this size by the newest CameraInfo; None if it has none."""
        if self._info is None:
            return None
        key = (*self._key, size)
        if key not in self._current:
            if len(self._current) > 64:  # a camera with autofocus changes K all the time
                self._current.clear()
            try:
                read = read_camera_info(self._info, size, self.topic, self.info_topic)
            except UserError:
                read = None
            self._current[key] = None if read is None else read.fields
        return self._current[key]

    def _resampled(
        self, fields: dict[str, Any], now: dict[str, Any], camera: dict[str, Any]
    ) -> dict[str, Any]:
        size = f"{now['width_px']}x{now['height_px']}"
        wanted = f"{camera['width_px']}x{camera['height_px']}"
        if (now["distortion_model"], now["distortion"]) != (camera["distortion_model"], camera["distortion"]):
            raise InputFault(
                "d", list(now["distortion"]), f"the distortion has changed, images of {size} px",
                "record each calibration apart",
            )  # fmt: skip
        # Pixel of the present image that shows pixel u of the calibrated one: both have the same ray.
        fx, fy = now["fx_px"] / camera["fx_px"], now["fy_px"] / camera["fy_px"]
        A = np.array([
            [fx, 0.0, now["cx_px"] - fx * camera["cx_px"]],
            [0.0, fy, now["cy_px"] - fy * camera["cy_px"]],
        ])  # fmt: skip
        if _shown_share(A, now, camera) < _LEAST_SHARE:
            raise InputFault(
                "width, height", size, f"the images show only a part of the calibrated {wanted} px",
                "record each crop apart",
            )  # fmt: skip
        try:
            rgb = decode_rgb(
                fields["data"], fields["encoding"], now["width_px"], now["height_px"],
                fields.get("step_bytes", 0),
            )  # fmt: skip
        except UserError as error:
            raise InputFault("data", f"{len(fields['data'])} bytes", str(error)) from error
        shrink = max(1, round(min(fx, fy)))
        if shrink > 1:  # average first: linear interpolation alone would alias
            rgb = cv2.resize(
                rgb, (now["width_px"] // shrink, now["height_px"] // shrink), interpolation=cv2.INTER_AREA
            )
            A = np.diag([1.0 / shrink] * 2) @ A
            A[:, 2] += 0.5 / shrink - 0.5
        out = cv2.warpAffine(
            rgb, A, (camera["width_px"], camera["height_px"]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        self.report.repaired(
            self.topic, "width, height", size,
            f"size or K has changed: resampled to the calibrated {wanted} px by its CameraInfo",
        )  # fmt: skip
        return {
            "width_px": camera["width_px"], "height_px": camera["height_px"], "encoding": "rgb8",
            "step_bytes": camera["width_px"] * 3, "data": out.ravel(),
        }  # fmt: skip


def _bytes(ros_image: Any) -> np.ndarray:
    return np.asarray(ros_image.data).view(np.uint8).ravel()


def _key_of(info: Any) -> tuple[Any, ...]:
    """Return what distinguishes one calibration from another in a CameraInfo."""
    arrays = [np.asarray(getattr(info, n) if hasattr(info, n) else getattr(info, n.upper())) for n in "kdp"]
    roi = info.roi
    return (
        info.width, info.height, info.binning_x, info.binning_y, roi.x_offset, roi.y_offset, roi.width,
        roi.height, *(array.tobytes() for array in arrays),
    )  # fmt: skip


def _same_k(a: dict[str, Any], b: dict[str, Any]) -> bool:
    focal = max(abs(a[name] / b[name] - 1.0) for name in ("fx_px", "fy_px"))
    centre = max(abs(a[name] - b[name]) for name in ("cx_px", "cy_px"))
    same_lens = (a["distortion_model"], a["distortion"]) == (b["distortion_model"], b["distortion"])
    return focal < _SAME_FOCAL and centre < _SAME_CENTRE * b["width_px"] and same_lens


def _shown_share(A: np.ndarray, now: dict[str, Any], camera: dict[str, Any]) -> float:
    """Return the fraction of the calibrated image that the present one shows."""
    share = 1.0
    for i, name in enumerate(("width_px", "height_px")):
        low, high = A[i, i] * -0.5 + A[i, 2], A[i, i] * (camera[name] - 0.5) + A[i, 2]
        if not 0.0 < high - low < np.inf:
            return 0.0
        shown = min(high, now[name] - 0.5) - max(low, -0.5)
        share *= max(0.0, shown) / (high - low)
    return share
