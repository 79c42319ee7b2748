"""Splitting of a stream of measurements into revolutions, resampled to a regular grid of directions."""

from __future__ import annotations

import numpy as np

from beamsplat.services.lidar.framing import StreamCounters
from beamsplat.services.lidar.range_filter import confirmed_ranges
from beamsplat.services.lidar.samples import LidarRevolution, Samples

_MIN_COVERAGE = 0.1  # ratio of a revolution's directions that must have been measured
_MIN_SAMPLES = 40  # of a revolution; fewer do not define the grid
_MAX_STEP_BACK_DEG = 20.0  # RPLIDAR's angle corrections are below 8 degrees


class RevolutionBuilder:
    """Assembles revolutions from samples.

    The first, incomplete revolution is dropped, and revolutions with a gap of nearly a revolution or more.
    """

    def __init__(self, counters: StreamCounters, *, clockwise: bool) -> None:
        self._counters = counters
        self._clockwise = clockwise
        self._parts: list[Samples] = []
        self._complete = False  # the current revolution has its start
        self._total_deg: float | None = None  # unwrapped angle of the newest sample
        self._turn = 0
        self._last_time = -np.inf
        self._period_s: float | None = None
        self._previous: LidarRevolution | None = None

    def reset(self) -> None:
        """Discard the present revolution after an interruption of the stream."""
        if self._parts and self._complete:
            self._counters.dropped_scans += 1
        self._parts, self._complete, self._previous, self._total_deg = [], False, None, None
        self._last_time = -np.inf

    def add(self, samples: Samples, noisy: bool = False) -> list[LidarRevolution]:
        """Add samples and return the revolutions now complete; `noisy`: unconfirmed ranges become NaN."""
        if not len(samples):
            return []
        if self._period_s is not None and samples.time_s[0] - self._last_time > 0.9 * self._period_s:
            self.reset()  # the number of revolutions in the gap is unknown
        total, turn = self._unwrap_angles(samples.angle_deg)
        cuts = np.flatnonzero(np.diff(turn, prepend=self._turn)).tolist()
        turns = []
        start = 0
        for cut in [*cuts, len(samples)]:
            if cut > start:
                self._parts.append(_slice(samples, slice(start, cut), total - 360.0 * turn[start]))
            if cut < len(samples):
                turns += self._finish(float(samples.time_s[cut]), noisy)
            start = cut
        self._total_deg, self._turn = float(total[-1]), int(turn[-1])
        self._last_time = float(samples.time_s[-1])
        return turns

    def _unwrap_angles(self, angle_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the angles of the samples without wrap at 360 degrees, and their revolution numbers.

        A device that corrects its angles by the range may step back by a small angle, but never forward by
        nearly a revolution. A step back across the start of a revolution does not return to the previous
        revolution.
        """
        if self._total_deg is None:
            self._total_deg = float(angle_deg[0] % 360.0)
            self._turn = 0
        steps = np.mod(np.diff(angle_deg, prepend=self._total_deg), 360.0)
        steps[steps > 360.0 - _MAX_STEP_BACK_DEG] -= 360.0
        total = self._total_deg + np.cumsum(steps)
        turn = np.maximum.accumulate(np.maximum(np.floor(total / 360.0).astype(np.int64), self._turn))
        return total, turn

    def _finish(self, next_time_s: float, noisy: bool) -> list[LidarRevolution]:
        parts, self._parts = self._parts, []
        complete, self._complete = self._complete, True
        if not complete or not parts:
            return []
        turn = _resample_to_grid(parts, next_time_s, self._clockwise)
        if turn is None:
            self._counters.dropped_scans += 1
            self._previous = None
            return []
        full = round(2.0 * np.pi / abs(turn.angle_increment_rad))
        return self.accept(turn, full - sum(len(part) for part in parts), noisy)

    def accept(self, turn: LidarRevolution, missing: int, noisy: bool) -> list[LidarRevolution]:
        """Count a revolution with `missing` lost measurements and return it in a list.

        With `noisy`, unconfirmed ranges become NaN.
        """
        self._period_s = turn.scan_time_s
        previous, self._previous = self._previous, turn
        self._counters.lost_samples += max(missing, 0)
        if noisy:
            turn = self._remove_unconfirmed(turn, previous)
        self._counters.scans += 1
        return [turn]

    def _remove_unconfirmed(self, turn: LidarRevolution, previous: LidarRevolution | None) -> LidarRevolution:
        ranges = turn.range_m.astype(np.float64)
        agrees = confirmed_ranges(ranges, ranges_in_directions_of(turn, previous))
        doubtful = np.isfinite(ranges) & ~agrees
        self._counters.lost_samples += int(doubtful.sum())
        ranges[doubtful] = np.nan
        return LidarRevolution(
            turn.time_s, turn.angle_min_rad, turn.angle_increment_rad, turn.time_increment_s,
            turn.scan_time_s, ranges.astype(np.float32), turn.intensity,
        )  # fmt: skip


def ranges_in_directions_of(turn: LidarRevolution, previous: LidarRevolution | None) -> np.ndarray:
    """Return the ranges (m), float64 [N], of `previous` in the directions of `turn`; NaN = none."""
    found = np.full(len(turn.range_m), np.nan)
    if previous is None or not len(previous.range_m):
        return found
    angle = turn.angle_min_rad + turn.angle_increment_rad * np.arange(len(found))
    apart = np.mod(
        (angle - previous.angle_min_rad) * np.sign(previous.angle_increment_rad) + 0.1, 2.0 * np.pi
    )
    index = np.round((apart - 0.1) / abs(previous.angle_increment_rad)).astype(np.int64)
    inside = (index >= 0) & (index < len(previous.range_m))
    found[inside] = previous.range_m[index[inside]]
    return found


def _resample_to_grid(parts: list[Samples], next_time_s: float, clockwise: bool) -> LidarRevolution | None:
    """Return the revolution on the regular grid that fits its directions best; None for too few samples.

    The motor's speed is nearly constant, so the directions are regular to a fraction of a step. Each
    measurement is assigned to the nearest grid direction; of two measurements in one direction, the nearer
    one is used.
    """
    angle = np.concatenate([part.angle_deg for part in parts])
    if len(angle) < _MIN_SAMPLES:
        return None
    ranges = np.concatenate([part.range_m for part in parts])
    intensity = np.concatenate([part.intensity for part in parts])
    time_s = np.concatenate([part.time_s for part in parts])
    if parts[0].number is not None:
        place = np.concatenate([part.number for part in parts])
        place = place - place[0]
    else:
        place = _beam_numbers(angle)
    step, first = np.polyfit(place, angle, 1) if place[-1] > 0.0 else (0.0, 0.0)
    if step <= 0.0 or 360.0 / step * _MIN_COVERAGE > len(angle):
        return None
    exact = (angle - first) / step
    beam = np.round(exact).astype(np.int64)
    first += beam.min() * step
    beam -= beam.min()
    count = int(beam.max()) + 1
    # Written in this order, the measurement nearest to a grid direction overwrites the others.
    order = np.argsort(-np.abs(exact - np.round(exact)), kind="stable")
    filled, light = np.full(count, np.nan, np.float32), np.zeros(count, np.float32)
    filled[beam[order]], light[beam[order]] = ranges[order], intensity[order]
    time_step, time_first = np.polyfit(beam, time_s, 1)
    off = np.abs(time_s - time_first - time_step * beam)
    if off.max() > 4.0 * off.mean():  # outliers: refit without them
        kept = off <= 4.0 * off.mean()
        time_step, time_first = np.polyfit(beam[kept], time_s[kept], 1)
    sign = -1.0 if clockwise else 1.0
    angle_min = float(np.angle(np.exp(1j * np.radians(sign * first))))
    return LidarRevolution(
        time_s=float(time_first),
        angle_min_rad=angle_min,
        angle_increment_rad=float(sign * np.radians(step)),
        time_increment_s=max(float(time_step), 0.0),
        scan_time_s=max(next_time_s - float(time_s[0]), 0.0),
        range_m=filled,
        intensity=light,
    )


def _beam_numbers(angle_deg: np.ndarray) -> np.ndarray:
    """Return the number of each measurement, float64 [N], from the steps of the angle; gaps are counted."""
    steps = np.diff(angle_deg)
    typical = float(np.median(steps))
    near = np.abs(steps - typical) < 0.5 * abs(typical)
    if typical <= 0.0 or not near.any():
        return np.zeros(len(angle_deg))
    return np.concatenate([[0.0], np.cumsum(np.round(steps / float(steps[near].mean())))])


def _slice(samples: Samples, piece: slice, angle_deg: np.ndarray) -> Samples:
    """Return the samples of the slice `piece`, with their angles replaced by `angle_deg`."""
    number = None if samples.number is None else samples.number[piece]
    return Samples(
        angle_deg[piece], samples.range_m[piece], samples.intensity[piece], samples.time_s[piece], number
    )
