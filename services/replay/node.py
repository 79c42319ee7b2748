"""The replay service: publishes recorded sensor data."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from beamsplat.common.geometry.rig import check_rig_option
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.services.replay.config import ReplayConfig
from beamsplat.services.replay.options import SourceOptions
from beamsplat.services.replay.source import ReplaySource, open_source, play

log = logging.getLogger("beamsplat.replay")


class ReplayNode(Node):
    """Publishes the sensor topics of a bag, a recording or a folder, paced by the runner."""

    name = "replay"
    Config = ReplayConfig
    config: ReplayConfig
    outputs = ("rig", "wheel/odometry", "lidar/scan", "camera/image", "external/pose", "tick")

    def __init__(self, config: ReplayConfig) -> None:
        super().__init__(config)
        self._source: ReplaySource | None = None

    def configure(self) -> None:
        """Open the data, so that errors in them are reported before the system starts."""
        self._open()

    def _open(self) -> ReplaySource:
        if self._source is not None:
            return self._source
        source = open_source(self.config.data, source_options(self.config))
        try:
            source.rig()
        except ValueError:
            source.close()
            raise
        self._source = source
        for choice in getattr(source, "choices", ()):
            log.info("%s", choice)
        return source

    def check_resources(self) -> None:
        check_rig_option(self.config.rig)
        self.configure()
        self.close()

    def expected_messages(self) -> int | None:
        """Return the number of sensor messages; None if playback is endless or limited to a part."""
        config = self.config
        if config.loop or config.start_s or config.duration_s is not None:
            return None
        return self._open().message_count()

    def source(self) -> Iterator[SourceItem]:
        """Yield the calibration, then all messages in order of arrival time."""
        source = self._open()
        config = self.config
        played = play(source, start_s=config.start_s, duration_s=config.duration_s, loop=config.loop)
        for at_ns, topic, message in played:
            yield SourceItem(at_ns, topic, message)
        for problem in source.problems:
            log.warning("%s", problem)
            self.rejections.add(problem)

    def close(self) -> None:
        if self._source is not None:
            self._source.close()
            self._source = None


def source_options(config: ReplayConfig) -> SourceOptions:
    """Return the options of the data source that are part of the node's options."""
    names = (
        "image_topic", "scan_topic", "odometry_topic", "pose_topic", "camera_info_topic", "body_frame", "rig",
        "assume_mounts", "allow_truncated",
    )  # fmt: skip
    return SourceOptions(
        **{name: getattr(config, name) for name in names},
        without=frozenset(config.without),
        require=frozenset(config.require),
    )
