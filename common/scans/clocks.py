"""Clocks of sensors: offsets between the stamps of several streams, and the unit of bare numbers."""

from __future__ import annotations

import math

import numpy as np

UNITS_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
UNIT_NAMES = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds", "s": "seconds"}
# Receive delays of sensors on one clock: a message cannot arrive before its stamp, or much later.
_LATEST_S = 1.5
_EARLIEST_S = -0.03
_DOUBTFUL_S = 0.3  # difference of the receive delays of two sensors
# Receive delay, relative to the sweep, that shows that the stamp is that of the last beam.
_LAST_BEAM = (-0.1, 0.4)
_MIN_SWEEP_S = 0.02
_YEAR_2000_NS, _YEAR_2100_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9
_PERIODS_NS = 2_000_000, 10_000_000_000  # of scans and images


def clock_offsets_s(lags_s: dict[str, float], expected_s: dict[str, float]) -> dict[str, float]:
    """Return the offset to add to the stamps of each stream (s); streams on the right clock are left out.

    The right clock is that of the receive times, if a stream is on it. Otherwise it is that of the scans, or
    of the first stream: then only the differences between the streams matter.

    Args:
        lags_s: receive time minus stamp of each stream, of its promptest messages.
        expected_s: the same as it is with one clock: the duration of a sweep for scans, else nearly 0.
    """
    error = {name: lag - expected_s.get(name, 0.0) for name, lag in lags_s.items()}
    on_clock = [name for name, value in error.items() if _EARLIEST_S <= value <= _LATEST_S]
    if len(on_clock) == len(error):
        return {}
    if on_clock:
        return {name: value for name, value in error.items() if name not in on_clock}
    reference = error.get("scan", next(iter(error.values())))
    return {
        name: value - reference
        for name, value in error.items()
        if not _EARLIEST_S - 0.3 <= value - reference <= _LATEST_S
    }


def stamped_at_end(lag_s: float, sweep_s: float) -> bool:
    """Return whether a message received `lag_s` after its stamp has the stamp of its last beam.

    A sweep of `sweep_s` that begins at the stamp cannot be received before it has ended.
    """
    return sweep_s >= _MIN_SWEEP_S and _LAST_BEAM[0] * sweep_s - 0.003 <= lag_s <= _LAST_BEAM[1] * sweep_s


def delay_doubts(
    lags_s: dict[str, float], expected_s: dict[str, float], offsets_s: dict[str, float], names: dict[str, str]
) -> list[str]:
    """Return sentences on streams that are received much later after their stamps than others.

    Args:
        lags_s, expected_s: as for `clock_offsets_s`.
        offsets_s: its result; these streams are corrected already.
        names: topic or file of each stream.
    """
    error = {name: lag - expected_s.get(name, 0.0) for name, lag in lags_s.items() if name not in offsets_s}
    if len(error) < 2:
        return []
    promptest = min(error, key=lambda name: error[name])
    return [
        f"{names.get(name, name)}: header.stamp: the messages are received {lags_s[name]:.2f} s after their "
        f"stamps, those of {names.get(promptest, promptest)} {lags_s[promptest]:.2f} s: their clocks "
        "may differ, "
        "which shifts the sensors against each other; synchronise the clocks"
        for name, value in error.items()
        if value - error[promptest] > _DOUBTFUL_S
    ]


def clock_sentence(name: str, stamp_ns: int, offset_s: float) -> str:
    """Return why the stamps of a stream are moved by `offset_s`, for a report."""
    since = "are on another clock than the receive times"
    if abs(stamp_ns) < _YEAR_2000_NS and offset_s > 0.0:
        since = "count from the start of the device, those of the other sensors do not"
    return f"the stamps of {name} {since}"


def stamp_unit(stamps: np.ndarray) -> str:
    """Return the unit of bare numbers int64 [N] that should be stamps in ns: "ns", "us", "ms" or "s".

    It is the one in which the numbers are dates of this century, else that in which their period is that of a
    sensor.
    """
    stamps = np.sort(np.asarray(stamps, np.int64))
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if not len(steps):
        return "ns"
    period = float(np.median(steps))
    for unit, factor in UNITS_NS.items():
        if _YEAR_2000_NS <= int(stamps[0]) * factor <= _YEAR_2100_NS:
            return unit
    if period >= _PERIODS_NS[0]:
        return "ns"
    # Not dates: since the start of the device. The period alone tells.
    fitting = [u for u, factor in UNITS_NS.items() if _PERIODS_NS[0] <= period * factor <= _PERIODS_NS[1]]
    return fitting[0] if fitting else "ns"


def prompt_lag_s(at_ns: list[int], stamps_ns: list[int]) -> float | None:
    """Return receive time minus stamp (s) of the promptest tenth of some messages; None without stamps."""
    lags = [(at - stamp) / 1e9 for at, stamp in zip(at_ns, stamps_ns) if stamp]
    if not lags or all(lag == 0.0 for lag in lags):
        return None
    value = float(np.quantile(lags, 0.1))
    return value if math.isfinite(value) else None
