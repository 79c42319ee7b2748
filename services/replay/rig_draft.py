"""Draft of a rig file: values found in the data, values assumed, and values that the user must measure."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.rig import CameraSection, LidarSection, Mount, RigFile, format_rig
from beamsplat.common.recording.calibration import ASSUMED_MOUNTS
from beamsplat.services.replay.bag_source import BagSource
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import data_path, open_source

_HEADER = """Calibration of one robot: mounts of camera and lidar, and intrinsics of the camera.
The body frame lies on the floor between the wheels: x forward, y left, z up. Metres and degrees.
rpy_deg = [roll, pitch, yaw]: zero is level and straight ahead; positive pitch is down,
positive yaw is to the left. Lines marked MEASURE were assumed: replace them by measured values."""
_ASSUMED_FOV_DEG = 65.0  # of common webcams
_MEASURE = """MEASURE from the floor point between the wheels to the {what} (forward, left, up). The
accuracy must be 1 cm, and 1 degree of pitch."""


def draft_from_data(path: Path) -> tuple[str, list[str]]:
    """Return the text of a rig file for a bag, recording or folder, and sentences for the user.

    Raises:
        UserError: the data cannot be read, or have neither camera nor lidar.
    """
    relaxed = SourceOptions(
        require=frozenset(), without=frozenset({"odometry", "pose"}), allow_truncated=True
    )
    source = open_source(data_path(path), relaxed)
    try:
        if isinstance(source, BagSource):
            return _from_bag(source, str(path))
        rig = RigFile.of(source.rig())
        if rig.camera is None and rig.lidar is None:
            raise UserError(f"{path}: has neither camera nor lidar: there is nothing to calibrate")
        return format_rig(rig, _HEADER, {}), [f"found: calibration in {path}"]
    finally:
        source.close()


def _from_bag(source: BagSource, where: str) -> tuple[str, list[str]]:
    if not source.chosen:
        raise UserError(f"{where}: has neither camera nor lidar: there is nothing to calibrate")
    notes = []
    try:
        source.calibrate()
    except UserError as error:  # an unusable calibration is the reason for a draft
        notes.append(str(error))
    found = source.calibration
    notes += [f"found: {text}" for text in found.found] + [f"assumed: {text}" for text in found.assumed]
    assumed = list(found.assumed)
    comments: dict[str, str] = {"camera": f"Found in {where}."}
    if "image" in source.chosen and found.camera is None:
        size_px = source.image_size_px()
        assert size_px is not None  # there are images
        width, height = size_px
        found.camera = pinhole_from_fov(width, height, _ASSUMED_FOV_DEG)
        text = (
            f"fx, fy from an assumed horizontal field of view of {_ASSUMED_FOV_DEG:g} degrees, no distortion"
        )
        comments["camera"] = f"MEASURE with a chessboard: {text}."
        assumed.append(text)
    for sensor, sensor_name in (("camera", "image"), ("lidar", "scan")):
        if sensor_name not in source.chosen:
            continue
        if sensor in found.mounts and not _is_assumed(sensor, assumed):
            comments[f"{sensor}.mount"] = f"From the fixed transforms in {where}; check it with a tape."
            continue
        found.mounts.setdefault(sensor, ASSUMED_MOUNTS[sensor])
        comments[f"{sensor}.mount"] = _MEASURE.format(what=f"{sensor}'s centre")
        if not _is_assumed(sensor, assumed):
            assumed.append(f"mount of the {sensor}: not in the data, a usual one was assumed")
    notes += [f"assumed, to be measured: {text}" for text in assumed[len(found.assumed) :]]
    found.assumed = assumed
    rig = found.rig(where)
    reader = source.scan_reader()
    if reader is not None and rig.lidar is not None:
        scan = reader.learner.found_section()
        rig = rig.model_copy(update={"lidar": rig.lidar.model_copy(update={"scan": scan})})
        comments["lidar.scan"] = f"Found in {where}: {reader.learner.evidence()}."
        notes.append(f"found: {reader.learner.evidence()}")
    return format_rig(rig, _HEADER, comments), notes


def _is_assumed(sensor: str, assumed: list[str]) -> bool:
    """Return whether `calibration.py` has assumed the mount of a sensor, judged by its sentences."""
    return any(text.startswith(f"the {sensor} is at") for text in assumed)


def is_device(source: str) -> bool:
    """Return whether `source` is a camera (index, /dev/videoN, URL of a stream) and not data."""
    return source.isdecimal() or source.startswith("/dev/") or "://" in source


def draft_from_device(source: str, fov_deg: float) -> tuple[str, list[str]]:
    """Return the text of a rig file for a camera that OpenCV can open, and sentences for the user.

    Raises:
        UserError: the camera cannot be opened, or returns no image.
    """
    capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
    try:
        ok, image = capture.read() if capture.isOpened() else (False, None)
    finally:
        capture.release()
    if not ok or image is None:
        raise UserError(
            f"{source}: no image from this camera; check the cable, the index, and other programs that use it"
        )
    height, width = image.shape[:2]
    text = f"fx, fy from a horizontal field of view of {fov_deg:g} degrees as stated, no distortion"
    camera = CameraSection(
        **pinhole_from_fov(width, height, fov_deg), mount=Mount.of(camera_mount(0.1, 0.0, 0.3))
    )
    lidar = LidarSection(mount=Mount.of(ASSUMED_MOUNTS["lidar"]))
    assumed = (text, "mounts of camera and lidar: usual ones were assumed")
    comments = {
        "camera": f"MEASURE with a chessboard: {text}.",
        "camera.mount": _MEASURE.format(what="camera's centre"),
        "lidar.mount": _MEASURE.format(what="lidar's centre") + "\nRemove this section if there is no lidar.",
    }
    rig = RigFile(camera=camera, lidar=lidar, assumed=assumed, source=source)
    return format_rig(rig, _HEADER, comments), [f"found: images of {width}x{height} px", *assumed]


def pinhole_from_fov(width_px: int, height_px: int, fov_deg: float) -> dict[str, object]:
    """Return the camera fields of a rig file for a lens without distortion and square pixels.

    `fov_deg`: horizontal field of view. Pixel centres are integers, so the image extends from -0.5 to width -
    0.5.
    """
    focal_px = 0.5 * width_px / math.tan(math.radians(fov_deg) / 2.0)
    return {
        "width_px": width_px, "height_px": height_px,
        "fx_px": round(focal_px, 3), "fy_px": round(focal_px, 3),
        "cx_px": np.round(0.5 * (width_px - 1), 3).item(), "cy_px": np.round(0.5 * (height_px - 1), 3).item(),
    }  # fmt: skip
