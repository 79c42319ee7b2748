"""Recordings with ground truth, for evaluating the mapper: images, true poses, beams, true depth.

Reads a folder with `bag/`, `groundtruth.txt` (T_map_body), `depth_gt/` and `extra_views/`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import NO_BEAMS, Beams, deskew_beams, scan_points
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.trajectory import Trajectory, read_tum
from beamsplat.common.geometry.transforms import make_transform, matrix_from_quat_xyzw


@dataclass(frozen=True)
class PosedImage:
    """A compressed image with the true pose of the camera, and the lidar beams at its time."""

    stamp_ns: int
    T_map_camera: np.ndarray  # float64 [4, 4]
    jpeg: bytes
    beams: Beams = NO_BEAMS  # in the body frame at the time of the image


@dataclass(frozen=True)
class OffPathView:
    """A held-out view away from the robot's path: true camera pose float64 [4, 4], image file, depth file."""

    T_map_camera: np.ndarray
    image_file: Path
    depth_file: Path


@dataclass
class TruthDataset:
    """A recording with ground truth: images with true poses, calibration, held-out views.

    `load_dataset` creates it.
    """

    path: Path
    camera: Pinhole  # of the undistorted images that `image` returns
    T_body_camera: np.ndarray
    posed_images: list[PosedImage]
    offpath_views: list[OffPathView] = field(default_factory=list)
    undistort: Undistorter | None = None

    @property
    def seconds(self) -> float:
        """Time from the first to the last image, s."""
        return (self.posed_images[-1].stamp_ns - self.posed_images[0].stamp_ns) * 1e-9

    def image(self, index: int) -> np.ndarray:
        """Return image `index`, undistorted, RGB uint8 [H, W, 3]."""
        bgr = cv2.imdecode(np.frombuffer(self.posed_images[index].jpeg, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            raise ValueError(f"image {index} cannot be decoded")
        rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        return rgb if self.undistort is None else self.undistort(rgb)

    def true_depth(self, index: int) -> np.ndarray | None:
        """Return the true depth (optical z) of image `index`, float32 [H, W] in metres, NaN where unknown.

        None if the image has no depth file.
        """
        file = self.path / "depth_gt" / f"{self.posed_images[index].stamp_ns}.png"
        return read_depth_png(file) if file.is_file() else None


def read_depth_png(file: Path) -> np.ndarray:
    """Return depth float32 [H, W] in metres from a 16 bit PNG in millimetres; the value 0 becomes NaN.

    Raises:
        UserError: the file cannot be read, or is not a 16 bit PNG.
    """
    raw = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype != np.uint16:
        raise UserError(f"{file}: expected a 16 bit PNG in millimetres")
    return np.where(raw > 0, raw * np.float32(1e-3), np.float32(np.nan)).astype(np.float32)


def load_dataset(path: Path) -> TruthDataset:
    """Load a recording with its ground truth from a folder; images without a true pose are left out.

    The folder contains bag/, groundtruth.txt (T_map_body) and, if available, depth_gt/ and extra_views/.

    Raises:
        UserError: a file is missing, or the bag has no images, camera_info or static transforms.
    """
    path = Path(path)
    truth_file = path / "groundtruth.txt"
    if not truth_file.is_file():
        raise UserError(f"{truth_file} is missing; `bench map` needs true poses (TUM, T_map_body)")
    truth = read_tum(truth_file)
    raw = _read_bag(path / "bag")
    camera, static = raw.camera, raw.static
    if camera is None or "camera" not in static:
        raise UserError(f"{path / 'bag'} has no camera_info, or no static transform to the camera")
    T_body_camera = static["camera"]
    beams = _BeamsAtImages(raw.scans, static.get("lidar"), truth)
    posed_images = []
    for stamp_ns, jpeg in raw.images:
        T_map_body = truth.at(stamp_ns, max_extrapolation_ns=50_000_000)
        if T_map_body is not None:
            posed_images.append(
                PosedImage(stamp_ns, T_map_body @ T_body_camera, jpeg, beams.at(stamp_ns, T_map_body))
            )
    if not posed_images:
        raise UserError(f"{path}: no image has a true pose")
    undistort = Undistorter(camera) if camera.is_distorted else None
    return TruthDataset(
        path,
        camera.undistorted(),
        T_body_camera,
        posed_images,
        read_offpath_views(path / "extra_views"),
        undistort,
    )


@dataclass
class _Raw:
    images: list[tuple[int, bytes]] = field(default_factory=list)
    scans: list[tuple[int, Any]] = field(default_factory=list)
    static: dict[str, np.ndarray] = field(default_factory=dict)
    camera: Pinhole | None = None


def _read_bag(path: Path) -> _Raw:
    from rosbags.highlevel import AnyReader

    raw = _Raw()
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            kind = connection.msgtype.rsplit("/", 1)[-1]
            if kind not in ("CompressedImage", "CameraInfo", "LaserScan", "TFMessage"):
                continue
            if kind == "TFMessage" and not connection.topic.endswith("tf_static"):
                continue
            if kind == "CameraInfo" and raw.camera is not None:
                continue
            message: Any = reader.deserialize(data, connection.msgtype)
            if kind == "CompressedImage":
                raw.images.append((_stamp_ns(message.header), message.data.tobytes()))
            elif kind == "LaserScan":
                raw.scans.append((_stamp_ns(message.header), message))
            elif kind == "CameraInfo":
                k = message.k
                raw.camera = Pinhole(k[0], k[4], k[2], k[5], message.width, message.height,
                                     message.distortion_model or "none", tuple(message.d))  # fmt: skip
            else:
                _take_static(raw.static, message)
    raw.images.sort(key=lambda pair: pair[0])
    raw.scans.sort(key=lambda pair: pair[0])
    return raw


def _stamp_ns(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def _take_static(static: dict[str, np.ndarray], message: Any) -> None:
    for item in message.transforms:
        t, q = item.transform.translation, item.transform.rotation
        T = make_transform(matrix_from_quat_xyzw(np.array([q.x, q.y, q.z, q.w])), np.array([t.x, t.y, t.z]))
        name = item.child_frame_id
        if "camera" in name:
            static["camera"] = T
        elif "laser" in name or "lidar" in name or "scan" in name:
            static["lidar"] = T


class _BeamsAtImages:
    """Finder of the scan nearest in time to an image; its beams are transformed to the time of the image."""

    def __init__(
        self, scans: list[tuple[int, Any]], T_body_lidar: np.ndarray | None, truth: Trajectory
    ) -> None:
        self._scans, self._T_body_lidar, self._truth = scans, T_body_lidar, truth
        self._stamps = np.array([stamp for stamp, _ in scans], dtype=np.int64)

    def at(self, stamp_ns: int, T_map_body: np.ndarray) -> Beams:
        """Return the deskewed beams in the body frame at `stamp_ns`; no beams without a scan within 0.2 s.

        `T_map_body` is the true pose of the body at that time, float64 [4, 4].
        """
        if len(self._scans) == 0 or self._T_body_lidar is None:
            return NO_BEAMS
        i = int(np.argmin(np.abs(self._stamps - stamp_ns)))
        start_ns, scan = self._scans[i]
        if abs(start_ns - stamp_ns) > 200_000_000:
            return NO_BEAMS
        points, index = scan_points(
            np.asarray(scan.ranges, dtype=np.float32), scan.angle_min, scan.angle_increment, scan.range_min,
            scan.range_max,
        )  # fmt: skip
        last = max(len(scan.ranges) - 1, 1)
        first_pose = self._pose(start_ns)
        last_pose = self._pose(start_ns + int(scan.time_increment * last * 1e9))
        body = deskew_beams(points, index / last, first_pose, last_pose, T_map_body, self._T_body_lidar)
        return Beams(body, index, np.full(len(index), 0.01))

    def _pose(self, stamp_ns: int) -> np.ndarray:
        T = self._truth.at(stamp_ns, max_extrapolation_ns=200_000_000)
        return self._truth.T_a_b[-1] if T is None else T


def read_offpath_views(folder: Path) -> list[OffPathView]:
    """Return the held-out views that poses.json of a folder lists; [] if that file is missing."""
    file = folder / "poses.json"
    if not file.is_file():
        return []
    views = []
    for entry in json.loads(file.read_text())["views"]:
        T = np.array(
            entry["T_world_camera"]["matrix"]
            if isinstance(entry["T_world_camera"], dict)
            else entry["T_world_camera"]
        )
        named = folder / entry["file"]
        image = named if named.is_file() else named.with_suffix(".jpg")
        views.append(OffPathView(T, image, folder / entry["depth"]))
    return views
