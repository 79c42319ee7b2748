"""Rules of a stream of scans that its first messages show: units, limits, directions, durations, stamps."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from beamsplat.common.scans.laser import LaserMessage
from beamsplat.common.scans.rules import (
    FULL_TURN_TOLERANCE,
    TWO_PI,
    AngleRule,
    ScanRules,
    claimed_sweep_s,
    is_contradictory,
    stated_angles,
)

MAX_PERIOD_S = 2.0  # of a revolution: the slowest planar lidars make one per second
_LARGEST_LIMIT_M = 1e5  # of range_max in a `Scan` message
_LARGEST_RANGE_M = 300.0  # of any planar lidar
_LARGEST_MEDIAN_M = 80.0  # of the readings of a stream, indoors or out
_CODE_SHARE = 0.005  # of the readings that are exactly the largest, for a code of "no return"
_CODE_COUNT = 20
_FULL_TURN = 0.0025  # relative difference from a whole revolution
_UNKNOWN_RANGE_MAX_M = 30.0
_SOON = (0.85, 1.4)  # receive delay in sweeps of a lidar that is read at once and stamps the first beam
_FULL_FIELD = math.radians(300.0)
_FEW = 4  # messages that show their period


@dataclass(frozen=True)
class HeaderFacts:
    """What the first messages of a stream show, besides its rules."""

    period_s: float
    angle_candidates: tuple[AngleRule, ...]  # possible readings of the directions; the first is the default
    sweep_candidates_s: tuple[float, ...]  # possible signed durations of a sweep; the first is the default
    sweep_fault: str  # why the stated duration cannot be; "" = it can
    lag_s: float  # receive time minus stamp, of the promptest tenth of the messages
    receive_times_tell: bool  # whether receive times are not copies of the stamps


def learn_header(messages: list[LaserMessage]) -> tuple[ScanRules, HeaderFacts]:
    """Return rules and facts from the first messages (at least one) of a stream, in order of reception."""
    frames = Counter(message.frame_id for message in messages)
    frame = frames.most_common(1)[0][0]
    rules = ScanRules(frame_id=frame)
    messages = [message for message in messages if message.frame_id == frame and len(message.ranges_m)]
    if not messages:
        return rules, HeaderFacts(0.1, ("increment",), (0.0,), "", 0.0, False)
    received = np.array([message.at_ns for message in messages], np.int64)
    stamps = np.array([message.stamp_ns for message in messages], np.int64)
    tell = bool(np.any(received != stamps))
    why = _useless_stamps(stamps, received) if tell else ""
    period_s = _period_s(received if why else stamps)
    rules = replace(rules, period_s=period_s, use_received=bool(why), received_why=why)
    rules = replace(rules, degrees=_in_degrees(messages))
    candidates, angles_why = _angle_candidates(messages, rules)
    rules = replace(_range_rules(messages, rules), angles=candidates[0], angles_why=angles_why)
    lag_s = float(np.quantile((received - stamps) / 1e9, 0.1))
    sweeps, fault = _sweeps(messages, rules, period_s, lag_s if tell and not why else None)
    if fault:
        rules = replace(rules, sweep_s=sweeps[0], sweep_why=fault)
    return rules, HeaderFacts(period_s, candidates, sweeps, fault, lag_s, tell)


def _period_s(times_ns: np.ndarray) -> float:
    steps = np.diff(times_ns) / 1e9
    steps = steps[steps > 1e-4]
    return float(np.median(steps)) if len(steps) else 0.1


def _useless_stamps(stamps: np.ndarray, received: np.ndarray) -> str:
    """Return why the stamps do not tell the times of the scans; "" if they do."""
    n = len(stamps)
    if n < 4 or not stamps.any():
        return ""
    if len(np.unique(stamps)) == 1:
        return "all scans have the same stamp"
    span, span_received = float(np.ptp(stamps)) / 1e9, float(np.ptp(received)) / 1e9
    if len(np.unique(stamps)) < 0.5 * n:
        return f"{n} scans have only {len(np.unique(stamps))} different stamps"
    period = span_received / max(n - 1, 1)
    if period < 0.9 and bool(np.all(stamps % 10**9 == 0)):
        return "the stamps are whole seconds"
    if span_received > 0.3 and not 0.02 < span / span_received < 50.0:
        return f"the stamps advance by {span:.3g} s within {span_received:.3g} s"
    return ""


def _in_degrees(messages: list[LaserMessage]) -> frozenset[str]:
    """Return the names of the angles that are in degrees, because they are impossible in radians."""
    found = set()

    def middle(values: list[float]) -> float:
        finite = [value for value in values if math.isfinite(value)]
        return float(np.median(finite)) if finite else 0.0

    beams = middle([len(message.ranges_m) for message in messages])
    step = middle([message.angle_increment_rad for message in messages])
    span = abs(step) * max(beams - 1, 1)
    if TWO_PI * 1.1 < span <= 361.0 and abs(step) > 0.01:
        found.add("angle_increment")
    limits = {
        "angle_min": middle([message.angle_min_rad for message in messages]),
        "angle_max": middle([message.angle_max_rad for message in messages]),
    }
    # Angles in radians are within two revolutions.
    impossible = any(2.0 * TWO_PI + 0.1 < abs(value) <= 720.0 for value in limits.values())
    width = limits["angle_max"] - limits["angle_min"]
    if impossible or ("angle_increment" in found and math.isclose(width, step * (beams - 1), rel_tol=0.02)):
        found |= set(limits)
    return frozenset(found)


def _angle_candidates(messages: list[LaserMessage], rules: ScanRules) -> tuple[tuple[AngleRule, ...], str]:
    """Return the possible readings of the directions, the most likely first, and why."""
    contradictory = [message for message in messages if is_contradictory(message, rules)]
    if len(contradictory) <= 0.5 * len(messages):
        return ("increment",), ""
    message = contradictory[len(contradictory) // 2]
    n = len(message.ranges_m)
    first, last, step = stated_angles(message, rules)
    even = (last - first) / max(n - 1, 1)
    steps: dict[AngleRule, float] = {"increment": step, "limits": even, "from_max": step, "to_max": step}
    possible: list[AngleRule] = []
    for rule in get_args(AngleRule):
        start = last if rule in ("from_max", "to_max") else first
        span = abs(steps[rule]) * (n - 1)
        if math.isfinite(start) and math.isfinite(steps[rule]) and 0.0 < span <= TWO_PI * FULL_TURN_TOLERANCE:
            possible.append(rule)
    # Limits that are swapped: the scan may start at angle_max. Without them, it starts at angle_min.
    if step * even > 0.0 or not math.isfinite(step * even):
        possible = [rule for rule in possible if rule != "from_max"]
    if not possible:
        return ("increment",), ""
    if len(possible) == 1:
        return tuple(possible), f"only this is at most one revolution for {n} beams"
    full = [
        rule for rule in possible
        if min(abs(abs(steps[rule]) * k / TWO_PI - 1.0) for k in (n, n - 1)) < _FULL_TURN
    ]  # fmt: skip
    if len({abs(round(steps[rule], 9)) for rule in possible}) > 1 and 0 < len(full) < len(possible):
        order = [*full, *(rule for rule in possible if rule not in full)]
        return tuple(order), "they are one whole revolution"
    return tuple(possible), "the motion of the robot has not shown yet which of the fields is wrong"


def _range_rules(messages: list[LaserMessage], rules: ScanRules) -> ScanRules:
    """Return the rules with the unit of the ranges, range_max, and the code for "no return"."""
    with np.errstate(invalid="ignore"):
        ranges = np.concatenate([message.ranges_m for message in messages[:100]]).astype(np.float64)
    known = ranges[np.isfinite(ranges) & (ranges > 0.0)]
    tops = [message.range_max_m for message in messages]
    top = float(np.median(tops)) if all(map(math.isfinite, tops)) else math.nan
    if not len(known):
        return (
            rules
            if top > 0.0
            else replace(rules, range_max_m=_UNKNOWN_RANGE_MAX_M, range_max_why=_not_stated(top))
        )
    code = _no_return_code(known, len(ranges), top)
    measured = known if code is None else known[np.abs(known - code) > 1e-4 * code]
    measured = measured if len(measured) else known
    middle = float(np.median(measured))
    scale, limit_scale = 1.0, 1.0
    for unit in (0.01, 0.001):
        in_limits = float(np.mean(measured * unit < top)) if top > 0.0 else 1.0
        beyond = float(np.mean(measured > top)) if 0.0 < top <= _LARGEST_RANGE_M else 0.0
        if middle > _LARGEST_MEDIAN_M and 0.05 < middle * unit < 0.5 * _LARGEST_MEDIAN_M:
            # Limits in metres: the readings exceed them. In the unit of the ranges: they are impossible.
            if 0.0 < top <= _LARGEST_RANGE_M and (beyond < 0.9 or in_limits < 0.9):
                continue
            scale, limit_scale = unit, 1.0 if not top > _LARGEST_RANGE_M else unit
            break
    rules = replace(
        rules,
        range_scale=scale,
        limit_scale=limit_scale,
        no_return_m=None if code is None or code * scale >= top * limit_scale else code * scale,
    )
    largest = float(measured.max()) * scale
    top *= limit_scale
    replaced = max(_UNKNOWN_RANGE_MAX_M, 1.5 * largest)
    if not (math.isfinite(top) and 0.0 < top <= _LARGEST_LIMIT_M):
        return replace(rules, range_max_m=replaced, range_max_why=_not_stated(top))
    low = float(np.median([message.range_min_m for message in messages])) * limit_scale
    if 0.0 < low < top and float(np.mean(measured * scale < low)) > 0.5:
        rules = replace(rules, range_min_m=0.0, range_min_why="most of the readings are below it")
    if float(np.mean(measured * scale > top)) > 0.5:
        return replace(rules, range_max_m=replaced, range_max_why="most of the readings are beyond it")
    return rules


def _not_stated(top: float) -> str:
    return "it is not a range" if not top > 0.0 else "it is no limit"


def _no_return_code(known: np.ndarray, beams: int, top: float) -> float | None:
    """Return the largest reading if many beams have exactly this value: a driver's code for "no return"."""
    largest = float(known.max())
    count = int(np.sum(known == largest))
    if math.isfinite(top) and 0.0 < largest < 0.98 * top:
        return None
    # Without a limit, a far wall that is seen from one place may be the largest reading too.
    share = _CODE_SHARE if math.isfinite(top) and top > 0.0 else 4.0 * _CODE_SHARE
    return largest if count > _CODE_COUNT and count > share * beams else None


def _sweeps(
    messages: list[LaserMessage], rules: ScanRules, period_s: float, lag_s: float | None
) -> tuple[tuple[float, ...], str]:
    """Return the possible signed durations of a sweep, the default first, and why the stated one cannot be.

    A duration is possible if it is at most the period of the scans and 2 s. `lag_s`: receive time minus
    stamp, None = unknown: a message cannot be received before its last beam, and usually is soon after it.
    """
    claims = [claimed_sweep_s(message) for message in messages]
    claimed = float(np.median(claims)) if all(map(math.isfinite, claims)) else math.nan
    beams = float(np.median([len(message.ranges_m) for message in messages]))
    step = abs(float(np.median([message.angle_increment_rad for message in messages])))
    step = math.radians(step) if "angle_increment" in rules.degrees else step
    span = step * max(beams - 1, 1) if math.isfinite(step) else TWO_PI
    limit_s = min(MAX_PERIOD_S, 1.3 * period_s) if len(messages) >= _FEW else MAX_PERIOD_S
    # A turning lidar measures without pause, so the sweep takes its share of the period.
    turning_s = period_s * min(span / TWO_PI, 1.0)
    expected_s = turning_s if span > math.radians(200.0) else min(turning_s, period_s)
    fault = ""
    if not (math.isfinite(claimed) and abs(claimed) <= limit_s):
        stated = (
            f"{abs(claimed):.4g} s for one scan every {period_s:.3g} s"
            if math.isfinite(claimed)
            else "no number"
        )
        fault = f"impossible, it makes {stated}"
        claimed = _plausible_duration_s(messages, claimed, period_s, expected_s)
    soon = lag_s is not None and _SOON[0] * expected_s <= lag_s <= _SOON[1] * expected_s + 0.02
    if not fault and claimed < 0.0 and lag_s is not None and lag_s > 0.6 * abs(claimed):
        fault = f"negative, but the scans are received {lag_s * 1e3:.0f} ms after their stamps"
        claimed = abs(claimed)
    elif not fault and 0.005 < claimed < 0.6 * expected_s and soon and span > _FULL_FIELD:
        fault = (
            f"it makes {claimed:.3g} s, but there is a revolution every {period_s:.3g} s, received "
            f"{(lag_s or 0.0) * 1e3:.0f} ms after its stamp"
        )
        claimed = expected_s
    elif not fault and 0.0 < claimed <= 0.005 and soon and span > _FULL_FIELD:
        fault = f"it makes {claimed * 1e3:.2g} ms, but the scans are received a revolution after their stamps"
        claimed = expected_s
    candidates = [claimed]
    durations = [abs(claimed)] if abs(claimed) > 0.005 else []
    if (
        expected_s > 0.01
        and (not durations or durations[0] < 0.6 * expected_s)
        and expected_s <= MAX_PERIOD_S
    ):
        durations.append(expected_s)
    for duration in durations:
        candidates += [duration, -duration]
    candidates.append(0.0)
    unique: list[float] = []
    for value in candidates:
        if all(abs(value - other) > 1e-3 for other in unique):
            unique.append(value)
    return tuple(unique), fault


def _plausible_duration_s(
    messages: list[LaserMessage], claimed: float, period_s: float, expected_s: float
) -> float:
    """Return the duration of a sweep whose time_increment is impossible: in other units, or by scan_time."""
    for unit in (1e-3, 1e-6, 1e-9):
        if math.isfinite(claimed) and 0.8 * expected_s <= abs(claimed) * unit <= 1.1 * period_s:
            return abs(claimed) * unit
    stated = float(np.median([message.scan_time_s for message in messages]))
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        if math.isfinite(stated) and 0.9 * period_s <= stated * unit <= 1.15 * period_s:
            return min(stated * unit, period_s) * min(expected_s / period_s, 1.0)
    return expected_s
