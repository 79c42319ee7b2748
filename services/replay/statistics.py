"""Statistics of topics (rates, gaps, delays) and of lidar scans, computed from arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_GAP_PERIODS = 3.0  # a longer pause is a gap
_VARYING = 0.9  # of the beams: lidars whose speed is not constant have some more or fewer in each revolution


@dataclass(frozen=True)
class TopicStatistics:
    """Statistics of one topic, from stamps if there are any, else from receive times; None = unknown."""

    name: str
    type: str
    count: int
    rate_hz: float | None  # mean
    largest_gap_s: float | None
    gaps: int  # pauses longer than three periods
    backwards: int  # stamps earlier than the one before
    lag_median_ms: float | None  # receive time minus stamp
    lag_max_ms: float | None
    lag_min_ms: float | None


@dataclass(frozen=True)
class LidarStatistics:
    """Statistics of a sample of lidar scans."""

    beams_min: int
    beams_max: int
    field_of_view_deg: float
    range_min_m: float
    range_max_m: float
    scan_time_s: float
    time_increment_s: float
    no_return_share: float  # +inf
    invalid_share: float  # NaN, negative, or below range_min_m
    beyond_share: float  # finite, but beyond range_max_m
    most_common_far_m: float | None  # a large range that many beams have exactly: a code for "no return"
    most_common_far_share: float


def topic_statistics(
    name: str, type_name: str, at_ns: np.ndarray, stamp_ns: np.ndarray | None
) -> TopicStatistics:
    """Return statistics of one topic.

    `at_ns`: receive times int64 [N], in this order; `stamp_ns`: stamps int64 [N], or None.
    """
    times = at_ns if stamp_ns is None else stamp_ns
    steps = np.diff(times)
    forward = np.diff(np.sort(times))
    # Bursts lower the median and gaps raise the mean; a gap is long compared to both.
    period = float(max(np.median(forward), forward.mean())) if len(forward) else 0.0
    span = float(forward.sum())
    lag_ms = None if stamp_ns is None or not len(stamp_ns) else (at_ns - stamp_ns) / 1e6
    return TopicStatistics(
        name=name,
        type=type_name,
        count=len(times),
        rate_hz=len(forward) * 1e9 / span if span > 0.0 else None,
        largest_gap_s=float(forward.max()) / 1e9 if len(forward) else None,
        gaps=int((forward > _GAP_PERIODS * period).sum()) if period > 0.0 else 0,
        backwards=int((steps < 0).sum()),
        lag_median_ms=None if lag_ms is None else float(np.median(lag_ms)),
        lag_max_ms=None if lag_ms is None else float(lag_ms.max()),
        lag_min_ms=None if lag_ms is None else float(lag_ms.min()),
    )


def lidar_statistics(scans: list[dict[str, Any]]) -> LidarStatistics:
    """Return statistics of a sample of scans; each scan is a dictionary with the fields of a `Scan`."""
    first = scans[0]
    beams = [len(scan["ranges_m"]) for scan in scans]
    ranges = np.concatenate([scan["ranges_m"] for scan in scans]).astype(np.float64)
    total = max(len(ranges), 1)
    low, high = first["range_min_m"], first["range_max_m"]
    finite = np.isfinite(ranges)
    invalid = np.isnan(ranges) | (ranges < low)
    far, far_share = None, 0.0
    # Many drivers write their maximum, or a number beyond it, for "nothing seen".
    candidates = ranges[finite & (ranges >= 0.98 * high)]
    if len(candidates):
        values, counts = np.unique(candidates, return_counts=True)
        share = float(counts.max()) / total
        if share > 0.005 and counts.max() > 20:
            far, far_share = float(values[counts.argmax()]), share
    return LidarStatistics(
        beams_min=min(beams),
        beams_max=max(beams),
        field_of_view_deg=float(np.degrees(abs(first["angle_increment_rad"]) * max(max(beams) - 1, 0))),
        range_min_m=low,
        range_max_m=high,
        scan_time_s=first["scan_time_s"],
        time_increment_s=first["time_increment_s"],
        no_return_share=float(np.isposinf(ranges).sum()) / total,
        invalid_share=float(invalid.sum()) / total,
        beyond_share=float((finite & (ranges > high)).sum()) / total,
        most_common_far_m=far,
        most_common_far_share=far_share,
    )


def topic_problems(facts: TopicStatistics) -> list[str]:
    """Return sentences about properties of a topic that may disturb its subscribers."""
    found = []
    if facts.gaps:
        found.append(
            f"{facts.name}: {facts.gaps} gaps of more than three periods, "
            f"the longest {facts.largest_gap_s:.2f} s"
        )
    if facts.backwards:
        found.append(f"{facts.name}: {facts.backwards} stamps are earlier than the one before")
    if facts.lag_min_ms is not None and facts.lag_min_ms < -1.0:
        found.append(
            f"{facts.name}: stamps are up to {-facts.lag_min_ms:.0f} ms later than the receive time: "
            "sensor and recorder have different clocks"
        )
    if facts.lag_median_ms is not None and facts.lag_median_ms > 1000.0:
        found.append(f"{facts.name}: arrives {facts.lag_median_ms / 1e3:.1f} s after its stamps")
    return found


def lidar_problems(facts: LidarStatistics, *, sparse: bool = False) -> list[str]:
    """Return sentences about problems of the scans; `sparse`: beams that were not measured are normal."""
    found = []
    if facts.beams_min < _VARYING * facts.beams_max:
        found.append(f"the scans have between {facts.beams_min} and {facts.beams_max} beams")
    if facts.invalid_share > 0.2 and not sparse:
        found.append(
            f"{facts.invalid_share:.0%} of the beams are NaN, negative or below range_min: not measured, or "
            "removed by the driver; they are not used"
        )
    if facts.most_common_far_m is not None:
        used = facts.most_common_far_m < facts.range_max_m
        found.append(
            f"{facts.most_common_far_share:.1%} of the beams read exactly {facts.most_common_far_m:.2f} m: "
            "the driver's code for no return; "
            + ("drop these beams" if used else "it is not below range_max: they are not used")
        )
    if facts.time_increment_s == 0.0:
        found.append("the scans have no time per beam (time_increment is 0): they are not deskewed")
    return found
