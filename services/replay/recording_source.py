"""Source of sensor messages from a recording of BeamSplat; the messages are unchanged, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import LidarSection, Mount, RigFile, load_rig
from beamsplat.common.recording import RecordingReader
from beamsplat.common.recording.calibration import check_lidar_plane
from beamsplat.common.recording.sensors import SENSORS
from beamsplat.services.replay.options import SourceOptions


class RecordingSource:
    """Source of the sensor messages of a recording, in order of arrival time.

    Raises:
        UserError: the recording is empty, or a required sensor is missing.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self.where = str(path)
        self.options = options
        self._reader = RecordingReader(path)
        self.sensor_names = [
            sensor_name
            for sensor_name, sensor in SENSORS.items()
            if self._reader.counts[sensor.topic] and sensor_name not in options.without
        ]
        if not self._reader.counts:
            self.close()
            raise UserError(f"{path}: the recording has no messages; record again")
        for sensor_name in sorted(options.require - options.without):
            if sensor_name not in self.sensor_names:
                self.close()
                there = ", ".join(sorted(self._reader.counts))
                raise UserError(
                    f"{path}: has no {sensor_name}: nothing on {SENSORS[sensor_name].topic}; it has {there}. "
                    f'Use another recording, or set without = ["{sensor_name}"] if it is not needed'
                )

    @property
    def start_ns(self) -> int:
        return self._reader.start_ns

    @property
    def end_ns(self) -> int:
        return self._reader.end_ns

    @property
    def problems(self) -> list[str]:
        return self._reader.problems

    def message_count(self) -> int:
        """Return the number of sensor messages."""
        return sum(self._reader.counts[SENSORS[sensor_name].topic] for sensor_name in self.sensor_names)

    def rig(self) -> Any:
        """Return the calibration as the message `Rig`: from the option `rig`, else the first recorded one.

        Raises:
            UserError: both are missing.
        """
        if self.options.rig is not None:
            rig = load_rig(self.options.rig)
            if rig.lidar is not None:
                check_lidar_plane(rig.lidar.model().T_body_lidar, str(self.options.rig))
            return rig.message(self.start_ns, rig.source or str(self.options.rig))
        recorded = next(self._reader.messages(["rig"]), None)
        if recorded is None and ({"image", "scan"} & set(self.sensor_names)) == {"scan"}:
            origin = LidarSection(mount=Mount(xyz_m=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0)))
            assumed = ("the lidar is at the origin of the body frame, facing forward (no rig was recorded)",)
            return RigFile(lidar=origin, assumed=assumed).message(self.start_ns, self.where)
        if recorded is None:
            raise UserError(
                f"{self.where}: calibration is missing: nothing was recorded on rig; give a rig file "
                '(`beamsplat rig` writes a first one) with rig = "rig.toml"'
            )
        return recorded.message

    def messages(self, start_ns: int = 0, stop_ns: int | None = None) -> Iterator[tuple[int, str, Any]]:
        """Yield (arrival ns, topic, message) with start_ns <= arrival < stop_ns, in order of arrival."""
        topics = [SENSORS[sensor_name].topic for sensor_name in self.sensor_names]
        for recorded in self._reader.messages(topics, start_ns, stop_ns):
            yield recorded.log_time_ns, recorded.topic, recorded.message

    def sample(self, sensor_name: str, count: int) -> list[dict[str, Any]]:
        """Return the fields of up to `count` messages of a sensor, evenly spread over the recording."""
        topic = SENSORS[sensor_name].topic
        step = max(1, self._reader.counts[topic] // count)
        recorded = self._reader.messages([topic]) if sensor_name in self.sensor_names else ()
        return [vars(r.message) for i, r in enumerate(recorded) if i % step == 0][:count]

    def close(self) -> None:
        self._reader.close()
