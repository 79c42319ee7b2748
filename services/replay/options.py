"""What a user may choose about a source."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class SourceOptions:
    """Choices that the data do not make by themselves."""

    image_topic: str = ""
    scan_topic: str = ""
    odometry_topic: str = ""
    pose_topic: str = ""
    camera_info_topic: str = ""
    body_frame: str = ""
    rig: Path | None = None  # a rig TOML; wins over what the data say
    without: frozenset[str] = field(default_factory=frozenset)  # image, scan, odometry, pose
    require: frozenset[str] = frozenset({"scan"})
    assume_mounts: bool = False  # missing mounting positions: customary ones, said in Rig.assumed
    allow_truncated: bool = False

    def topic_for(self, word: str) -> str:
        """The topic chosen for "image", "scan", "odometry" or "pose"; "" leaves it to its type."""
        return getattr(self, f"{word}_topic")
