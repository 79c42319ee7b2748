"""Options of data sources."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class SourceOptions:
    """Options of a data source: topics, calibration, and tolerance for damaged data."""

    image_topic: str = ""
    scan_topic: str = ""
    odometry_topic: str = ""
    pose_topic: str = ""
    camera_info_topic: str = ""
    body_frame: str = ""
    rig: Path | None = None  # a rig file; overrides the calibration of the data
    without: frozenset[str] = field(default_factory=frozenset)  # image, scan, odometry, pose
    require: frozenset[str] = frozenset({"scan"})
    assume_mounts: bool = False  # assume usual mounts where there are none; listed in Rig.assumed
    allow_truncated: bool = False

    def topic_for(self, sensor_name: str) -> str:
        """Return the topic set by option for "image", "scan", "odometry" or "pose"; "" = select by type."""
        return getattr(self, f"{sensor_name}_topic")
