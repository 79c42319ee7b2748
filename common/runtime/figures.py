"""Figures of nodes: the numbers behind alerts and metrics, which each node reports with its health.

A node sets a figure with `self.figures.set(NAME, VALUE)`; figures that are fields of its own results are read
from these (`_OF_RESULTS`). They reach every host that receives the health of the node, also over the uplink.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

from beamsplat.common.messages import Message, NodeFigure
from beamsplat.common.runtime.rejections import WITH_STATUS

_STATUS_CHARS = 300


@dataclass(frozen=True)
class FigureKind:
    """Meaning of a figure; `counter`: it only grows while the process of the node runs."""

    help: str
    counter: bool = False


# The unit is the end of the name, as in Prometheus: base units, `_total` for counters.
FIGURES: dict[str, FigureKind] = {
    "disk_free_bytes": FigureKind("Free space of the disk on which the node keeps its state."),
    "disk_size_bytes": FigureKind("Size of the disk on which the node keeps its state."),
    "link_up": FigureKind("1 while both connections of the uplink to the edge server are open, else 0."),
    "link_cuts_total": FigureKind("Interruptions of the connections of the uplink.", counter=True),
    "link_sent_messages_total": FigureKind("Messages forwarded to the edge server.", counter=True),
    "link_sent_bytes_total": FigureKind("Payload forwarded to the edge server.", counter=True),
    "outbox_keyframes": FigureKind("Keyframes of this drive that the mapper has not acknowledged."),
    "outbox_bytes": FigureKind("Size of all keyframes in the outbox."),
    "outbox_dropped_total": FigureKind("Keyframes dropped because the outbox was full.", counter=True),
    "calibration_doubts": FigureKind("Faults of the calibration that were found; absent before the check."),
    "recording": FigureKind("1 while messages are recorded, 0 while the disk is full or broken."),
    "localization_quality_ratio": FigureKind("Probability of an error below 2 cm and 0.5 degrees."),
    "map_keyframes": FigureKind("Keyframes in the map."),
    "map_refused_keyframes": FigureKind("Keyframes that the mapper has refused."),
    "map_gaussians": FigureKind("Gaussians in the map."),
    "map_steps_total": FigureKind("Optimisation steps of the mapper.", counter=True),
    "map_owed_steps": FigureKind("Optimisation steps that are done when no keyframe waits."),
    "map_psnr_decibels": FigureKind("PSNR of the newest keyframe after it was added."),
    "map_depth_error_meters": FigureKind("Median difference of rendered and fused depth, newest keyframe."),
    "depth_scale_ratio": FigureKind("Metres per unit of the depth estimate, of the newest image."),
    "depth_inliers_ratio": FigureKind("Share of the lidar-depth pairs that support the newest fit."),
}

# Topic -> figure -> field of its message.
_OF_RESULTS: dict[str, dict[str, str]] = {
    "localization/odometry": {"localization_quality_ratio": "quality"},
    "fusion/depth": {"depth_scale_ratio": "scale", "depth_inliers_ratio": "inlier_share"},
    "mapping/status": {
        "map_keyframes": "keyframes", "map_refused_keyframes": "refused", "map_gaussians": "gaussians",
        "map_steps_total": "steps", "map_psnr_decibels": "psnr_db", "map_depth_error_meters": "depth_error_m",
    },
}  # fmt: skip


class Figures:
    """Figures of one node, and the status of its newest result. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._values: dict[str, float] = {}
        self._status = ""

    def set(self, name: str, value: float | None) -> None:
        """Set a figure of `FIGURES`; None and NaN remove it: the value is unknown.

        Raises:
            KeyError: there is no such figure.
        """
        if name not in FIGURES:
            raise KeyError(f"no figure is called {name!r}; there are {', '.join(FIGURES)}")
        with self._lock:
            if value is None or not math.isfinite(value):
                self._values.pop(name, None)
            else:
                self._values[name] = float(value)

    def note(self, topic: str, message: Message) -> None:
        """Read the figures and the status that a result of the node contains."""
        for name, field in _OF_RESULTS.get(topic, {}).items():
            self.set(name, getattr(message, field))
        if topic in WITH_STATUS:
            status, detail = getattr(message, "status", ""), getattr(message, "detail", "")
            self._status = (f"{status}: {detail}" if detail else status)[:_STATUS_CHARS]

    @property
    def status(self) -> str:
        """Status of the newest result: "ok", or why it is missing; "" = there is none yet."""
        return self._status

    def report(self) -> tuple[NodeFigure, ...]:
        """Return all figures, for the field `figures` of a Health message."""
        with self._lock:
            return tuple(NodeFigure(name=name, value=value) for name, value in self._values.items())
