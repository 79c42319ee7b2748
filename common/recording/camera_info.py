"""Intrinsics of a camera from sensor_msgs/CameraInfo: region of interest, binning, distortion, rectification.

K and P of a CameraInfo belong to the full image of the sensor; a driver that crops or bins states it in `roi`
and `binning`. Drivers differ in how they fill width, height and K then: what contradicts is decided from the
size of the images and the principal point, or refused.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

# Distortion model names of ROS -> ours. Other models are rejected.
_MODELS = {
    "": "plumb_bob",
    "plumb_bob": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "thin_prism": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "none": "none",
}
# Numbers of coefficients that OpenCV takes for its polynomial model.
_POLYNOMIAL_SIZES = (4, 5, 8, 12, 14)
_RECTIFIED_WORDS = frozenset({"rect", "rectified", "undistorted"})
_USE_RIG = "give the calibration of these images in a rig file (create one with `beamsplat rig`)"
_OFF_CENTRE = 0.15  # of the image size: a principal point farther from the centre is doubted
_SAME_CENTRE = 0.03  # of the image size: two principal points count as equally plausible
_PIXEL_ASPECT = 0.05  # |fx / fy - 1| of a camera with square pixels
_LEAST_CORNER = 0.7  # of its radius: how far a pincushion distortion moves the corner inwards
_MOST_TANGENTIAL = 0.05  # p1 and p2; decentred lenses have 0.001
_P_RATIO = (0.4, 1.4)  # of fx in P to fx in K, for a lens with distortion


@dataclass(frozen=True)
class CameraInfoIntrinsics:
    """Intrinsics for the images of one topic.

    `fields`: of `CameraSection`, without the mount. `notes`: how they were derived from the message, where
    that is not obvious. `doubts`: sentences about values that contradict each other.
    """

    fields: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Window:
    """Part of the calibrated image that the driver publishes: pixel (u, v) of the calibrated image is at
    ((u - x + 0.5) / bin_x - 0.5, (v - y + 0.5) / bin_y - 0.5) of the published one."""

    x: float = 0.0
    y: float = 0.0
    bin_x: int = 1
    bin_y: int = 1
    note: str = ""

    def apply(self, fx: float, fy: float, cx: float, cy: float) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) of the published image."""
        return (
            fx / self.bin_x, fy / self.bin_y,
            (cx - self.x + 0.5) / self.bin_x - 0.5, (cy - self.y + 0.5) / self.bin_y - 0.5,
        )  # fmt: skip


def is_rectified(topic: str) -> bool:
    """Return whether a name of a topic says that its images are rectified: "rect" as a word in it.

    /camera/image_rect_color and /cam/rect/image are; /direct/image_raw and /correction/image are not.
    """
    return any(word in _RECTIFIED_WORDS for word in re.split(r"[/_]", topic.lower()))


def is_calibrated(info: Any) -> bool:
    """Return whether a CameraInfo has a camera matrix; drivers of uncalibrated cameras publish zeros."""
    K = np.asarray(_field(info, "k"), dtype=np.float64).ravel()
    P = np.asarray(_field(info, "p"), dtype=np.float64).ravel()
    return (K.size == 9 and K[0] > 0.0 and K[4] > 0.0) or (P.size == 12 and P[0] > 0.0 and P[5] > 0.0)


def read_camera_info(
    info: Any, image_size_px: tuple[int, int], image_topic: str, where: str
) -> CameraInfoIntrinsics | None:
    """Return the intrinsics from a CameraInfo; None if the camera is uncalibrated (K is zero).

    For a rectified image topic the intrinsics are taken from the projection matrix P, without distortion.

    Args:
        info: ROS CameraInfo message.
        image_size_px: width and height of the images on the topic.
        image_topic: ROS topic of the images; see `is_rectified`.
        where: name of the CameraInfo's source, for error texts.

    Raises:
        UserError: the CameraInfo has another image size, an unsupported distortion model, or invalid values.
    """
    K, D, P = (np.asarray(_field(info, name), dtype=np.float64).ravel() for name in "kdp")
    P_valid = P.size == 12 and bool(np.all(np.isfinite(P))) and P[0] > 0.0 and P[5] > 0.0
    K_valid = K.size == 9 and bool(np.all(np.isfinite(K))) and K[0] > 0.0 and K[4] > 0.0
    rectified = is_rectified(image_topic)
    if not K_valid and not (rectified and P_valid):
        if np.any(K):
            raise UserError(f"{where}: K = {_short(K)} is not a camera matrix; {_USE_RIG}")
        return None
    use_P = rectified and P_valid
    values = (P[0], P[5], P[2], P[6]) if use_P else (K[0], K[4], K[2], K[5])
    window = _window(info, image_size_px, (values[2], values[3]), image_topic, where)
    notes, doubts = [window.note] if window.note else [], []
    coefficients: tuple[float, ...] = ()
    if rectified:
        model = "none"
        notes.append(f"{image_topic} is rectified: {'P' if use_P else 'K'} without distortion")
    else:
        model, coefficients = _distortion(str(info.distortion_model), D, where)
        if P_valid:
            doubts += _contradiction(K, P, bool(coefficients))
    fx, fy, cx, cy = window.apply(*values)
    width, height = image_size_px
    doubts += _doubts(fx, fy, cx, cy, width, height)
    if coefficients and model != "equidistant":
        doubts += _folds(fx, fy, cx, cy, width, height, coefficients)
    fields = {
        "width_px": width, "height_px": height,
        "fx_px": float(fx), "fy_px": float(fy), "cx_px": float(cx), "cy_px": float(cy),
        "distortion_model": model, "distortion": coefficients,
    }  # fmt: skip
    return CameraInfoIntrinsics(fields, notes, doubts)


def _window(
    info: Any, image: tuple[int, int], centre: tuple[float, float], image_topic: str, where: str
) -> _Window:
    """Return which part of the calibrated image is published; `centre`: the principal point in the message.

    Raises:
        UserError: size, roi and binning do not fit the images.
    """
    size = (int(info.width), int(info.height))
    roi = info.roi
    bins = (max(int(info.binning_x), 1), max(int(info.binning_y), 1))
    corner = (int(roi.x_offset), int(roi.y_offset))
    part = (int(roi.width), int(roi.height))
    cropped = 0 not in part and (any(corner) or part != size)
    part = part if cropped else size
    if cropped and any(corner[i] + part[i] > size[i] for i in (0, 1)) and size == image:
        return _window_of_cropped_size(corner, image, centre, where)
    if (part[0] // bins[0], part[1] // bins[1]) == image:
        crop = f"roi at ({corner[0]}, {corner[1]}) of {size[0]}x{size[1]} px" if cropped else ""
        binned = f"binning {bins[0]}x{bins[1]}" if bins != (1, 1) else ""
        applied = " and ".join(text for text in (crop, binned) if text)
        note = f"K of the whole sensor was adapted to the published images: {applied}" if applied else ""
        x, y = corner if cropped else (0, 0)
        return _Window(x, y, *bins, note)
    if size == image:  # the driver has adapted width, height and K already
        return _Window(note="roi and binning do not fit the size of the images: K is taken as it is")
    raise UserError(
        f"{where}: K is for {size[0]}x{size[1]} px"
        + (f" with roi {part[0]}x{part[1]}" if cropped else "")
        + (f" and binning {bins[0]}x{bins[1]}" if bins != (1, 1) else "")
        + f" but the images on {image_topic} are {image[0]}x{image[1]} px; {_USE_RIG}"
    )


def _window_of_cropped_size(
    corner: tuple[int, int], image: tuple[int, int], centre: tuple[float, float], where: str
) -> _Window:
    """Return the window if width and height are those of the crop, but the roi lies in a larger image.

    Whether K belongs to the crop or to the whole sensor is decided by the principal point, which is near
    the middle of the image for which K was calibrated.

    Raises:
        UserError: both are equally plausible.
    """
    middle = np.array([(image[0] - 1) / 2.0, (image[1] - 1) / 2.0])
    whole = float(np.abs((np.array(centre) - corner - middle) / image).max())
    crop = float(np.abs((np.array(centre) - middle) / image).max())
    if abs(whole - crop) < _SAME_CENTRE:
        raise UserError(
            f"{where}: roi.x_offset = {corner[0]}, roi.y_offset = {corner[1]}: K (cx {centre[0]:.1f}, cy "
            f"{centre[1]:.1f}) may belong to the whole sensor or to the published part; {_USE_RIG}"
        )
    if crop < whole:
        return _Window(note=f"K belongs to the published part of the sensor, roi at {corner}")
    note = f"K of the whole sensor was adapted to the published images: roi at {corner}"
    return _Window(corner[0], corner[1], note=note)


def _distortion(name: str, D: np.ndarray, where: str) -> tuple[str, tuple[float, ...]]:
    """Return our model and its coefficients; trailing zeros decide which polynomial it is, not the name.

    Raises:
        UserError: an unknown model, or coefficients that it does not have.
    """
    model = _MODELS.get(name.strip().lower())
    if model is None:
        known = ", ".join(sorted(set(_MODELS.values())))
        raise UserError(f"{where}: distortion model {name!r} is not supported ({known}); use a rig file")
    if not np.all(np.isfinite(D)):
        raise UserError(f"{where}: d = {_short(D)}: the distortion is not finite; use a rig file")
    if not np.any(D):
        return "none", ()
    used = int(np.flatnonzero(D)[-1]) + 1
    sizes = (4,) if model == "equidistant" else _POLYNOMIAL_SIZES
    size = next((n for n in sizes if n >= used), None)
    if size is None or model == "none":
        raise UserError(
            f"{where}: distortion model {name!r} has {used} coefficients, at most "
            f"{0 if model == 'none' else sizes[-1]} are supported; use a rig file"
        )
    if model != "equidistant":  # OpenCV's polynomial: the number of coefficients says which
        size = max(size, 5) if size <= 5 else size
        model = "plumb_bob" if size == 5 else "rational_polynomial"
    return model, tuple(float(value) for value in np.pad(D[:size], (0, max(0, size - len(D)))))


def _contradiction(K: np.ndarray, P: np.ndarray, distorted: bool) -> list[str]:
    """Return a sentence if K and P cannot belong to the same camera: without distortion they are equal."""
    low, high = _P_RATIO if distorted else (0.98, 1.02)
    found = []
    for axis, in_K, in_P in (("fx", K[0], P[0]), ("fy", K[4], P[5])):
        if not low <= in_P / in_K <= high:
            found.append(
                f"CameraInfo contradicts itself: {axis} is {in_K:.1f} px in K and {in_P:.1f} px in P; "
                "K is used: calibrate the camera, or check who scales the images"
            )
    for axis, in_K, in_P, focal in (("cx", K[2], P[2], K[0]), ("cy", K[5], P[6], K[4])):
        if abs(in_P - in_K) > (0.3 if distorted else 0.02) * focal:
            found.append(
                f"CameraInfo contradicts itself: {axis} is {in_K:.1f} px in K and {in_P:.1f} px in P; "
                "K is used: calibrate the camera, or check who crops the images"
            )
    return found[:1]


def _doubts(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> list[str]:
    """Return sentences about implausible intrinsics of an image of this size."""
    found = []
    if abs(fx / fy - 1.0) > _PIXEL_ASPECT:
        found.append(
            f"fx = {fx:.1f} and fy = {fy:.1f} px differ: pixels are rarely that far from square; K may "
            "belong to another image size: calibrate at this size"
        )
    off = max(abs(cx - (width - 1) / 2.0) / width, abs(cy - (height - 1) / 2.0) / height)
    if off > _OFF_CENTRE:
        found.append(
            f"the principal point ({cx:.1f}, {cy:.1f}) px is far from the middle of the {width}x{height} "
            "images: K belongs to another image size, or the images are a part of the calibrated ones; "
            "calibrate at this size"
        )
    return found


def _folds(
    fx: float, fy: float, cx: float, cy: float, width: int, height: int, D: tuple[float, ...]
) -> list[str]:
    """Return a sentence if the distortion is not invertible within the image: its radius decreases."""
    corners = np.array([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    radius_image = float(np.hypot((corners[:, 0] - cx) / fx, (corners[:, 1] - cy) / fy).max())
    k = np.zeros(8)
    k[: min(len(D), 8)] = D[:8]
    r = np.linspace(0.0, 10.0 * radius_image, 4000)
    with np.errstate(all="ignore"):  # impossible values give NaN, and the sentence
        r2 = r**2
        bent = r * (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        folded = np.flatnonzero(~(np.diff(bent) > 0.0))
    reach = bent[folded[0]] if len(folded) else bent[-1]
    if reach >= 0.95 * radius_image:
        corner = float(r[int(np.argmax(bent >= 0.95 * radius_image))])
        tangential = float(np.abs(D[2:4]).max(initial=0.0))
        if corner >= _LEAST_CORNER * radius_image and tangential <= _MOST_TANGENTIAL:
            return []
        return [
            f"d = {_short(np.array(D))}: no lens bends an image that much: the coefficients are in another "
            "order or of another camera; calibrate the camera"
        ]
    return [
        f"d = {_short(np.array(D))}: this distortion cannot be inverted towards the corners of the "
        f"{width}x{height} images: it belongs to another camera or size; calibrate the camera"
    ]


def _field(info: Any, name: str) -> Any:
    """Return a field of a CameraInfo; its names are upper case in ROS 1, lower case in ROS 2."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _short(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values[:14]) + "]"
