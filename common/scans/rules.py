"""The rules by which the messages of one lidar are read, and their application to a message."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from beamsplat.common.recording.input_report import InputFault
from beamsplat.common.scans.laser import LaserMessage

AngleRule = Literal["increment", "limits", "from_max", "to_max"]
ANGLE_RULES: dict[str, str] = {
    "increment": "angle_min + i * angle_increment",
    "limits": "evenly from angle_min to angle_max",
    "from_max": "angle_max + i * angle_increment",
    "to_max": "by angle_increment, the last at angle_max,",
}
TWO_PI = 2.0 * math.pi
FULL_TURN_TOLERANCE = 1.003  # of more than a revolution: rounding of the increment
_DEGREES = "it is in degrees and was converted"

Repaired = Callable[[str, object, str, str], None]  # field, value, what, remedy


@dataclass(frozen=True)
class ScanRules:
    """How the fields of one lidar's messages are to be read. The defaults are what ROS defines."""

    frame_id: str | None = None  # scans of other frames are refused
    degrees: frozenset[str] = frozenset()  # fields that are in degrees: angle_min, angle_max, angle_increment
    angles: AngleRule = "increment"
    angles_why: str = ""  # evidence for `angles`, if the fields contradict each other
    mirrored: bool = False  # the directions change sign
    mirrored_why: str = ""
    range_scale: float = 1.0  # metres per unit of the ranges
    limit_scale: float = 1.0  # the same of range_min and range_max
    range_max_m: float | None = None  # in place of range_max
    range_max_why: str = ""
    range_min_m: float | None = None  # in place of range_min
    range_min_why: str = ""
    no_return_m: float | None = None  # this reading means "no return"
    sweep_s: float | None = None  # first to last beam in the array, see `OrderEvidence`; None: as each states
    order: Literal[-1, 0, 1] | None = None  # sign of the sweep; None: as each message states
    sweep_why: str = ""
    stamp_at: Literal["first", "last"] | None = None  # beam of the stamp, in time; None: as ROS defines
    stamp_why: str = ""
    use_received: bool = False  # stamps do not tell the time
    received_why: str = ""
    period_s: float = 0.1


def stated_angles(message: LaserMessage, rules: ScanRules) -> tuple[float, float, float]:
    """Return angle_min, angle_max and angle_increment in rad, from degrees where `rules` says so."""
    first, last, step = (
        math.radians(value) if name in rules.degrees else value
        for name, value in (
            ("angle_min", message.angle_min_rad),
            ("angle_max", message.angle_max_rad),
            ("angle_increment", message.angle_increment_rad),
        )
    )
    return first, last, step


def read_angles(message: LaserMessage, rules: ScanRules) -> tuple[float, float]:
    """Return the direction of the first beam and the increment (rad) by the rule `rules.angles`.

    Raises:
        InputFault: the fields define no directions.
    """
    n = len(message.ranges_m)
    first, last, step = stated_angles(message, rules)
    start = last if rules.angles == "from_max" else first
    if rules.angles == "to_max":
        start = last - (n - 1) * step
    if rules.angles == "limits":
        step = (last - first) / max(n - 1, 1)
    for name, value in (
        ("angle_min" if rules.angles in ("increment", "limits") else "angle_max", start),
        ("angle_increment", step),
    ):
        if not math.isfinite(value):
            raise InputFault(name, value, "the directions of the beams are unknown", "correct the driver")
    if step == 0.0 and n > 1:
        raise InputFault("angle_increment", step, "all beams have one direction", "correct the driver")
    if abs(step) * (n - 1) > TWO_PI * 1.02:
        raise InputFault(
            "angle_increment", f"{step:.6g}", f"{n} beams are more than a revolution", "correct the driver"
        )
    sign = -1.0 if rules.mirrored else 1.0
    return sign * math.remainder(start, TWO_PI) if abs(start) > 50.0 else sign * start, sign * step


def is_contradictory(message: LaserMessage, rules: ScanRules) -> bool:
    """Return whether angle_min, angle_max, angle_increment and the number of ranges do not fit together."""
    n = len(message.ranges_m)
    first, last, step = stated_angles(message, rules)
    if not (math.isfinite(first) and math.isfinite(last) and math.isfinite(step)) or step == 0.0:
        return True
    error = last - first - (n - 1) * step
    # A driver may wrap the last angle, or state the end of the last beam's interval.
    return min(abs(error), abs(error - TWO_PI), abs(error + TWO_PI)) > 1.6 * abs(step) and n > 1


def claimed_sweep_s(message: LaserMessage) -> float:
    """Return the time from the first beam to the last by time_increment, negative if it is negative."""
    return message.time_increment_s * max(len(message.ranges_m) - 1, 0)


def apply_rules(message: LaserMessage, rules: ScanRules, repaired: Repaired) -> dict[str, Any]:
    """Return the fields of the `Scan` message of `message`; each repair is passed to `repaired`.

    Raises:
        InputFault: the message cannot be used.
    """
    n = len(message.ranges_m)
    if n == 0:
        raise InputFault("ranges", "[]", "the scan has no beams", "check the lidar and its driver")
    if rules.frame_id is not None and message.frame_id != rules.frame_id:
        raise InputFault(
            "header.frame_id", message.frame_id,
            f"the scans of the frame {rules.frame_id!r} are used, and a map is made with one lidar",
            "publish each lidar on its own topic",
        )  # fmt: skip
    angle_min, increment = _angles(message, rules, repaired)
    range_min, range_max, ranges = _ranges(message, rules, repaired)
    intensities = message.intensities
    if len(intensities) not in (0, n):
        repaired("intensities", f"{len(intensities)} values", f"there are {n} ranges: they are left out", "")
        intensities = np.zeros(0, np.float32)
    if message.echoes > 1:
        repaired("ranges", f"{message.echoes} echoes", "the first echo of each beam is used", "")
    sweep_s, stamp_ns = _times(message, rules, repaired)
    if sweep_s < 0.0:  # a scan's beams are in the order of time
        angle_min, increment = angle_min + (n - 1) * increment, -increment
        ranges, intensities = ranges[::-1], intensities[::-1]
    scan_time = message.scan_time_s
    if not (math.isfinite(scan_time) and 0.0 <= scan_time <= 10.0):
        repaired(
            "scan_time", f"{scan_time:g}", f"{rules.period_s:.4g} s, the period of the scans, is used", ""
        )
        scan_time = rules.period_s
    return {
        "stamp_ns": stamp_ns,
        "angle_min_rad": float(angle_min),
        "angle_increment_rad": float(increment),
        "time_increment_s": abs(sweep_s) / (n - 1) if n > 1 else 0.0,
        "scan_time_s": float(scan_time),
        "range_min_m": range_min,
        "range_max_m": range_max,
        "ranges_m": np.ascontiguousarray(ranges, np.float32),
        "intensities": np.ascontiguousarray(intensities, np.float32),
    }


def _angles(message: LaserMessage, rules: ScanRules, repaired: Repaired) -> tuple[float, float]:
    for name, value in (
        ("angle_min", message.angle_min_rad),
        ("angle_max", message.angle_max_rad),
        ("angle_increment", message.angle_increment_rad),
    ):
        if name in rules.degrees:
            repaired(name, f"{value:.6g}", _DEGREES, "")
    angle_min, increment = read_angles(message, rules)
    if is_contradictory(message, rules):
        repaired(
            "angle_increment", f"{message.angle_increment_rad:.6g}",
            f"{len(message.ranges_m)} beams from angle_min {message.angle_min_rad:.4g} do not end at "
            "angle_max "
            f"{message.angle_max_rad:.4g}: the directions {ANGLE_RULES[rules.angles]} are used"
            + (f" ({rules.angles_why})" if rules.angles_why else ""),
            'correct the driver, or set angles in [lidar.scan] of a rig file',
        )  # fmt: skip
    if rules.mirrored:
        repaired("angle_increment", f"{message.angle_increment_rad:.6g}",
                 f"the scans are mirrored: the directions change sign ({rules.mirrored_why})",
                 "correct the driver, or the transform of a lidar that is mounted upside down")  # fmt: skip
    return angle_min, increment


def _ranges(message: LaserMessage, rules: ScanRules, repaired: Repaired) -> tuple[float, float, np.ndarray]:
    ranges = message.ranges_m
    if rules.range_scale != 1.0:
        unit = "millimetres" if rules.range_scale < 0.005 else "centimetres"
        known = ranges[np.isfinite(ranges)]
        example = f"{float(np.median(known)):.4g} in the middle" if len(known) else "none"
        repaired("ranges", example, f"they are in {unit} and were converted to metres", "correct the driver")
        ranges = ranges * np.float32(rules.range_scale)
    low, high = message.range_min_m * rules.limit_scale, message.range_max_m * rules.limit_scale
    if rules.limit_scale != 1.0:
        repaired(
            "range_max", f"{message.range_max_m:g}", "it is in the unit of the ranges and was converted", ""
        )
    if rules.range_max_m is not None:
        repaired("range_max", f"{message.range_max_m:g}",
                 f"{rules.range_max_why}: {rules.range_max_m:.3g} m is used", "correct it")  # fmt: skip
        high = rules.range_max_m
    elif not (math.isfinite(high) and 0.0 < high <= 1e5):
        raise InputFault("range_max", f"{message.range_max_m:g}", "it is not a range", "correct the driver")
    if rules.range_min_m is not None:
        why = f"{rules.range_min_why}: {rules.range_min_m:g} m is used"
        repaired("range_min", f"{message.range_min_m:g}", why, "correct the driver")
        low = rules.range_min_m
    elif not (math.isfinite(low) and 0.0 <= low < high):
        repaired("range_min", f"{message.range_min_m:g}", "it is not below range_max: 0 m is used", "")
        low = 0.0
    if rules.no_return_m is not None:
        with np.errstate(invalid="ignore"):
            code = np.abs(ranges - np.float32(rules.no_return_m)) < 1e-4 * rules.no_return_m
        if code.any():
            repaired(
                "ranges",
                f"{rules.no_return_m:.2f} m",
                "the driver's code for no return: no surface is there",
                "",
            )
            ranges = np.where(code, np.float32(np.inf), ranges)
    return float(low), float(high), ranges


def _times(message: LaserMessage, rules: ScanRules, repaired: Repaired) -> tuple[float, int]:
    """Return the signed duration of the sweep (s) and the stamp of the beam that is first in time (ns)."""
    claimed = claimed_sweep_s(message)
    sweep_s = claimed if math.isfinite(claimed) else 0.0
    if rules.sweep_s is not None:
        sweep_s = rules.sweep_s
    elif rules.order is not None:
        sweep_s = rules.order * abs(sweep_s)
    if rules.sweep_s is not None or (rules.order is not None and sweep_s != claimed):
        order = (
            "all beams at once" if sweep_s == 0.0 else "in reversed order" if sweep_s < 0.0 else "in order"
        )
        duration = f" within {abs(sweep_s):.3g} s" if sweep_s else ""
        repaired("time_increment", f"{message.time_increment_s:.6g}",
                 f"{rules.sweep_why}: the beams are taken as measured {order}{duration}",
                 "set order and sweep_s in [lidar.scan] of a rig file to change this")  # fmt: skip
    stamp_ns = message.stamp_ns
    # By ROS, the stamp is the time of the first beam in the array; of a negative increment, the last in time.
    at_last = sweep_s < 0.0 and claimed < 0.0 if rules.stamp_at is None else rules.stamp_at == "last"
    if rules.use_received:
        stamp_ns, at_last = message.at_ns, True
        repaired("header.stamp", message.stamp_ns, f"{rules.received_why}: the receive times are used",
                 "set the clock of the lidar's driver")  # fmt: skip
    elif stamp_ns == 0:
        stamp_ns, at_last = message.at_ns, True
        repaired("header.stamp", 0, "the scan has no stamp: the receive time is used", "")
    as_ros = (
        sweep_s < 0.0 and claimed < 0.0
    )  # the stamp is that of the first beam in the array, the last in time
    if rules.stamp_at == "last" and message.stamp_ns and sweep_s and not (rules.use_received or as_ros):
        repaired("header.stamp", message.stamp_ns,
                 f"{rules.stamp_why}: it is taken as the time of the last beam, {abs(sweep_s):.3g} s "
                 "after the first",
                 "set stamp in [lidar.scan] of a rig file to change this")  # fmt: skip
    if at_last:
        stamp_ns -= round(abs(sweep_s) * 1e9)
    return sweep_s, max(stamp_ns, 0)
