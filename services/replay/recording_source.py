"""One of our own recordings as a source: what its sensors said, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.rig import LidarSection, Mount, RigFile, load_rig
from beamsplat.common.recording import RecordingReader
from beamsplat.common.recording.sensors import SENSORS
from beamsplat.services.replay.options import SourceOptions


class RecordingSource:
    """Sensor messages of a recording by arrival.

    Raises:
        UserError: nothing recorded, or a required sensor or the calibration is not in it.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self.where = str(path)
        self.options = options
        self._reader = RecordingReader(path)
        self.words = [
            word
            for word, sensor in SENSORS.items()
            if self._reader.counts[sensor.topic] and word not in options.without
        ]
        if not self._reader.counts:
            self.close()
            raise UserError(f"{path}: the recording holds no messages; record again")
        for word in sorted(options.require - options.without):
            if word not in self.words:
                self.close()
                there = ", ".join(sorted(self._reader.counts))
                raise UserError(
                    f"{path}: has no {word}: nothing on {SENSORS[word].topic}; it holds {there}. Use another "
                    f'recording, or set without = ["{word}"] if the deployment does not need one'
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

    def expected(self) -> int:
        """How many messages the chosen topics hold."""
        return sum(self._reader.counts[SENSORS[word].topic] for word in self.words)

    def rig(self) -> Any:
        """The calibration as the message `Rig`: the rig file given by option, else the first recorded one.

        Raises:
            UserError: neither is there.
        """
        if self.options.rig is not None:
            rig = load_rig(self.options.rig)
            return rig.message(self.start_ns, rig.source or str(self.options.rig))
        recorded = next(self._reader.messages(["rig"]), None)
        if recorded is None and ({"image", "scan"} & set(self.words)) == {"scan"}:
            origin = LidarSection(mount=Mount(xyz_m=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0)))
            said = ("the lidar sits at the body's origin, facing forward (no rig was recorded)",)
            return RigFile(lidar=origin, assumed=said).message(self.start_ns, self.where)
        if recorded is None:
            raise UserError(
                f"{self.where}: calibration is missing: nothing was recorded on rig; give a rig file "
                '(`beamsplat rig` writes a first one) with rig = "rig.toml"'
            )
        return recorded.message

    def messages(self, start_ns: int = 0, stop_ns: int | None = None) -> Iterator[tuple[int, str, Any]]:
        """(arrival, our topic, message) with start_ns <= arrival < stop_ns, in that order."""
        topics = [SENSORS[word].topic for word in self.words]
        for recorded in self._reader.messages(topics, start_ns, stop_ns):
            yield recorded.log_time_ns, recorded.topic, recorded.message

    def sample(self, word: str, count: int) -> list[dict[str, Any]]:
        """Fields of up to `count` messages of a sensor, spread evenly over the recording."""
        topic = SENSORS[word].topic
        step = max(1, self._reader.counts[topic] // count)
        recorded = self._reader.messages([topic]) if word in self.words else ()
        return [vars(r.message) for i, r in enumerate(recorded) if i % step == 0][:count]

    def close(self) -> None:
        self._reader.close()
