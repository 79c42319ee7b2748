"""Source of sensor messages from a plain folder: images, scans and poses with stamps in nanoseconds.

    images/<stamp_ns>.jpg | .png
    lasers/<stamp_ns>.pcd      or   scans.csv
    odometry.txt               TUM, T_odom_body
    poses.txt                  TUM, T_map_body
    rig.toml                   calibration (common/rig.py)
    folder.toml                optional: range_min_m, range_max_m, scan_time_s of the PCD scans

docs/recordings.md describes the layout. The data have no receive times: the stamp is used instead.
"""

from __future__ import annotations

import heapq
import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import read_limited
from beamsplat.common.geometry.rig import load_rig
from beamsplat.common.geometry.trajectory import Trajectory, read_tum
from beamsplat.common.geometry.transforms import se3_to_se2, so3_log
from beamsplat.common.messages.image_header import read_image_header
from beamsplat.common.recording.calibration import check_lidar_plane
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.recording.sensors import SENSORS, build_message
from beamsplat.common.scans.clocks import UNIT_NAMES, UNITS_NS, stamp_unit
from beamsplat.common.scans.laser import LaserMessage, laser_of_fields
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.replay.folder_scans import CsvScans, scan_from_points, xy_from_pcd
from beamsplat.services.replay.options import SourceOptions

_MAX_SETTINGS_BYTES = 1_000_000  # of folder.toml
_MAX_FILE_BYTES = 64_000_000  # of an image or a scan
_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
Stamped = tuple[int, str, Any]


@dataclass(frozen=True)
class FolderLidar:
    """Properties of the lidar that PCD files do not contain; read from folder.toml."""

    range_min_m: float = 0.02
    range_max_m: float = 30.0
    scan_time_s: float = 0.0


def looks_like_folder(path: Path) -> bool:
    """Return whether `path` is a folder with at least one of the files of this layout."""
    names = ("images", "lasers", "scans.csv", "odometry.txt", "poses.txt")
    return path.is_dir() and any((path / name).exists() for name in names)


class FolderSource:
    """Source of the messages of a plain folder, in order of their stamps.

    Raises:
        UserError: a file does not fit the layout, or a required sensor is missing.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self.path = Path(path)
        self.where = str(path)
        self.options = options
        self.report = InputReport()  # of what was repaired and refused since `messages` was called
        self._units: list[str] = []  # sentences on stamps that are not in nanoseconds
        self._learnt: ScanReader | None = None
        self._tilt = ""
        self._settings = self._read_settings()
        self._streams = {
            sensor_name: stream
            for sensor_name, stream in self._find_streams().items()
            if sensor_name not in options.without
        }
        for sensor_name in sorted(options.require - options.without):
            if not self._streams.get(sensor_name):
                there = (
                    ", ".join(sensor_name for sensor_name, stream in self._streams.items() if stream)
                    or "nothing"
                )
                raise UserError(
                    f"{path}: has no {sensor_name}; it holds {there}. Use another recording, or set "
                    f'without = ["{sensor_name}"] if the deployment does not need one'
                )
        stamps = [stamp for stream in self._streams.values() for stamp, _ in stream]
        if not stamps:
            raise UserError(f"{path}: the folder has no images, scans or poses")
        self.start_ns, self.end_ns = min(stamps), max(stamps)

    @property
    def problems(self) -> list[str]:
        found = [*self._units, *([self._tilt] if self._tilt else [])]
        if self._learnt is not None:
            found += self._learnt.warnings
        return [*found, *(f"{self.where}: {sentence}" for sentence in self.report.sentences)]

    def counts(self) -> dict[str, int]:
        """Return the number of files or rows of each sensor ("image", "scan", ...)."""
        return {sensor_name: len(stream) for sensor_name, stream in self._streams.items() if stream}

    def message_count(self) -> int:
        return sum(self.counts().values())

    def rig(self) -> Any:
        """Return the calibration as the message `Rig`, from the option `rig` or from rig.toml in the folder.

        Raises:
            UserError: both are missing, or K is for another image size.
        """
        file = self.options.rig or self.path / "rig.toml"
        if self.options.rig is None and not file.exists():
            raise UserError(
                f"{self.where}: calibration is missing: no rig.toml in the folder; put one there or give "
                'one with rig = "rig.toml" (`beamsplat rig` writes a first one)'
            )
        rig = load_rig(file)
        if rig.lidar is not None:
            self._tilt = check_lidar_plane(rig.lidar.model().T_body_lidar, str(file))
        images = self._streams.get("image")
        if images:
            if rig.camera is None:
                raise UserError(f'{file}: has no [camera] for the images; add it, or set without = ["image"]')
            head = read_image_header(read_limited(images[0][1], _MAX_FILE_BYTES))
            size = (rig.camera.width_px, rig.camera.height_px)
            if head is not None and head[1:] != size:
                raise UserError(
                    f"{file}: K is for {size[0]}x{size[1]} px but {images[0][1]} is {head[1]}x{head[2]} px; "
                    "calibrate at this size"
                )
        return rig.message(self.start_ns, rig.source or str(file))

    def messages(self, start_ns: int = 0, stop_ns: int | None = None) -> Iterator[Stamped]:
        """Yield (stamp ns, topic, message) with start_ns <= stamp < stop_ns, in order of stamps."""
        stop_ns = 2**63 if stop_ns is None else stop_ns
        self.report.clear()
        scans = self.scan_reader()
        self._reader = None if scans is None else scans.again(self.report)
        makers = {
            "image": self._image, "scan": self._scan, "odometry": self._odometry, "pose": self._pose,
        }  # fmt: skip
        streams = [
            self._stream(
                sensor_name,
                [entry for entry in stream if start_ns <= entry[0] < stop_ns],
                makers[sensor_name],
            )
            for sensor_name, stream in self._streams.items()
        ]
        yield from heapq.merge(*streams, key=itemgetter(0))

    def stamps(self) -> dict[str, list[int]]:
        """Return the stamps (ns) of the messages of each sensor ("image", "scan", ...)."""
        return {
            sensor_name: [stamp for stamp, _ in stream]
            for sensor_name, stream in self._streams.items()
            if stream
        }

    def sample(self, sensor_name: str, count: int) -> list[dict[str, Any]]:
        """Return the fields of up to `count` messages of a sensor, evenly spread over the folder."""
        topic = SENSORS[sensor_name].topic
        step = max(1, len(self._streams.get(sensor_name, ())) // count)
        found = (message for _, name, message in self.messages() if name == topic)
        return [vars(message) for i, message in enumerate(found) if i % step == 0][:count]

    def close(self) -> None:
        """Do nothing, because no file remains open."""

    def _stream(self, sensor_name: str, entries: list[tuple[int, Any]], make: Any) -> Iterator[Stamped]:
        topic = SENSORS[sensor_name].topic
        for stamp_ns, entry in entries:
            try:
                fields = {"stamp_ns": stamp_ns, **make(entry)}
                read = [fields]
                if sensor_name == "scan" and self._reader is not None:
                    read = self._reader.read(laser_of_fields(fields, stamp_ns))
                messages = [build_message(topic, found) for found in read]
            except (ValueError, OSError) as error:
                self.report.refused(
                    sensor_name, error if isinstance(error, ValueError) else ValueError(error)
                )
                continue
            for message in messages:
                yield stamp_ns, topic, message

    def scan_reader(self) -> ScanReader | None:
        """Return a reader that has learnt how the folder's scans are to be read; None if there are none."""
        if not self._streams.get("scan") or self._learnt is not None:
            return self._learnt
        file = self.options.rig or self.path / "rig.toml"
        lidar = load_rig(file).lidar if file.exists() else None
        self._learnt = ScanReader("scan", InputReport(), None if lidar is None else lidar.scan)
        if lidar is not None:
            self._learnt.set_mount(lidar.model().T_body_lidar)
        self._learnt.learn(self._measurements())
        return self._learnt

    def _measurements(self) -> Iterator[LaserMessage | tuple[int, np.ndarray]]:
        """Yield scans, and odometry as (stamp ns, pose_odom_body [3]), in order of stamps."""
        named = [
            (stamp_ns, sensor_name, entry)
            for sensor_name in ("odometry", "scan")
            for stamp_ns, entry in self._streams.get(sensor_name, ())
        ]
        for stamp_ns, sensor_name, entry in sorted(named, key=itemgetter(0)):
            if sensor_name == "odometry":
                yield stamp_ns, se3_to_se2(entry[0])
                continue
            try:
                yield laser_of_fields({"stamp_ns": stamp_ns, **self._scan(entry)}, stamp_ns)
            except (ValueError, OSError):  # counted in `messages`
                continue

    def _find_streams(self) -> dict[str, list[tuple[int, Any]]]:
        pcds = _stamped_files(self.path / "lasers", (".pcd",))
        csv = self.path / "scans.csv"
        if pcds and csv.exists():
            raise UserError(f"{self.path}: has both lasers/ and scans.csv; keep one of them")
        self._csv = CsvScans(csv) if csv.exists() else None
        streams: dict[str, list[tuple[int, Any]]] = {
            "image": _stamped_files(self.path / "images", _IMAGE_SUFFIXES),
            "scan": self._csv.rows if self._csv else pcds,
        }
        for sensor_name, name in (("odometry", "odometry.txt"), ("pose", "poses.txt")):
            if (self.path / name).exists():
                poses = read_tum(self.path / name)
                made = _with_velocity(poses) if sensor_name == "odometry" else poses.T_a_b
                streams[sensor_name] = list(zip(poses.stamps_ns.tolist(), made))
        return {
            name: self._in_nanoseconds(name, stream) if name in ("image", "scan") else stream
            for name, stream in streams.items()
        }

    def _in_nanoseconds(self, sensor_name: str, stream: list[tuple[int, Any]]) -> list[tuple[int, Any]]:
        """Return a stream with its stamps in nanoseconds, whatever unit its files use.

        Raises:
            UserError: the stamps do not advance.
        """
        stamps = np.array([stamp for stamp, _ in stream], np.int64)
        if len(stamps) > 3 and len(np.unique(stamps)) < 0.5 * len(stamps):
            raise UserError(
                f"{self.where}: {sensor_name}: stamp = {stamps[0]}: {len(stamps)} entries have only "
                f"{len(np.unique(stamps))} different stamps; write the time of each in nanoseconds"
            )
        unit = stamp_unit(stamps) if len(stamps) > 1 else "ns"
        if unit == "ns":
            return stream
        self._units.append(
            f"{self.where}: {sensor_name}: stamp = {stamps[0]}: the {len(stamps)} stamps are in "
            f"{UNIT_NAMES[unit]} "
            "and were converted; write nanoseconds"
        )
        return [(stamp * UNITS_NS[unit], entry) for stamp, entry in stream]

    def _read_settings(self) -> FolderLidar:
        file = self.path / "folder.toml"
        if not file.exists():
            return FolderLidar()
        try:
            table = tomllib.loads(read_limited(file, _MAX_SETTINGS_BYTES).decode())
        except (OSError, ValueError) as error:
            raise UserError(f"{file}: not a TOML file: {reason(error)}") from error
        known = [field.name for field in fields(FolderLidar)]
        for name, value in table.items():
            if name not in known:
                raise UserError(f"{file}: unknown option {name!r} (there are: {', '.join(known)})")
            if type(value) not in (int, float) or not 0.0 <= value < math.inf:
                raise UserError(f"{file}: {name} = {value!r} is not a number of at least 0")
        return FolderLidar(**table)

    def _image(self, file: Path) -> dict[str, Any]:
        data = np.frombuffer(read_limited(file, _MAX_FILE_BYTES), np.uint8)
        head = read_image_header(data.data)
        if head is None:
            raise ValueError(f"{file.name} is neither JPEG nor PNG")
        return {**head._asdict(), "data": data}

    def _scan(self, entry: Any) -> dict[str, Any]:
        if self._csv is not None:
            return self._csv.fields(entry)
        settings = self._settings
        points = xy_from_pcd(read_limited(entry, _MAX_FILE_BYTES), entry.name)
        return scan_from_points(points, settings.range_min_m, settings.range_max_m, settings.scan_time_s)

    @staticmethod
    def _odometry(entry: tuple[np.ndarray, np.ndarray, np.ndarray]) -> dict[str, Any]:
        return dict(zip(("T_odom_body", "velocity_m_s", "angular_velocity_rad_s"), entry))

    @staticmethod
    def _pose(T_map_body: np.ndarray) -> dict[str, Any]:
        return {"T_map_body": T_map_body}


def _stamped_files(folder: Path, endings: tuple[str, ...]) -> list[tuple[int, Path]]:
    """Return (stamp ns, file) of all files with these endings, in order of stamps.

    Raises:
        UserError: a file name is not a stamp.
    """
    found = []
    for file in folder.glob("*") if folder.is_dir() else ():
        if file.suffix.lower() not in endings or file.name.startswith("."):
            continue
        if not (file.stem.isascii() and file.stem.isdecimal()) or int(file.stem) >= 2**63:
            raise UserError(
                f"{file}: the name must be the stamp in nanoseconds, like 1700000000000000000{file.suffix}"
            )
        found.append((int(file.stem), file))
    return sorted(found)


def _with_velocity(poses: Trajectory) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return (T [4, 4], velocity [3] m/s, angular velocity [3] rad/s) of each pose, in the body frame.

    Velocities are differences to the previous pose; 0 for the first pose.
    """
    made = [(T, np.zeros(3), np.zeros(3)) for T in poses.T_a_b[:1]]
    for i in range(1, len(poses)):
        T_0, T_1 = poses.T_a_b[i - 1], poses.T_a_b[i]
        dt_s = (poses.stamps_ns[i] - poses.stamps_ns[i - 1]) / 1e9
        velocity = T_1[:3, :3].T @ (T_1[:3, 3] - T_0[:3, 3]) / dt_s
        made.append((T_1, velocity, so3_log(T_0[:3, :3].T @ T_1[:3, :3]) / dt_s))
    return made
