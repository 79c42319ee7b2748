"""Motion of the lidar from its sweeps alone, and evidence on the order in which the beams are measured.

While the robot turns, a sweep is distorted: each beam is measured at another heading. Two sweeps whose beams
are deskewed in the true order agree; in a wrong order, they do not. Consecutive sweeps have nearly the same
distortion, which hides it. So each sweep is compared with an earlier one of another heading, where other
beams see the same surface: the start and the end of a revolution then differ by the turn within one
revolution; or with one of another turn rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from beamsplat.common.scans.sweeps import MIN_POINTS, Sweep, Target, between, compose, deskewed

_KEEP = 60  # recent sweeps that a new one can be compared with
_MAX_DISTANCE_M = 1.2  # between compared sweeps: farther ones see other surfaces
_MAX_TURN_RAD = math.radians(200.0)
_MIN_SKEW_RAD = math.radians(0.4)  # expected disagreement in a wrong order, for a comparison to be made
_MIN_AGREEING = 0.6  # of the points, for a link of the chain
MIN_PAIRS = 6  # compared pairs of sweeps before a decision
MANY_PAIRS = 16  # before a decision by small differences
_MAX_STEP_S = 1.0  # a longer gap between sweeps interrupts the chain


@dataclass
class TrackedSweep:
    """A sweep with its pose in the frame of the chain's first sweep, and its twist once the next is known."""

    sweep: Sweep
    pose: np.ndarray  # float64 [3] at the middle of the sweep
    chain: int  # number of the uninterrupted chain
    twist: np.ndarray | None = None  # float64 [3], m/s, m/s, rad/s in the lidar frame


class SweepMotion:
    """Poses of consecutive sweeps by ICP, without deskewing and without odometry."""

    def __init__(self) -> None:
        self.tracked: list[TrackedSweep] = []
        self._chain = 0
        self._target: Target | None = None

    def add(self, sweep: Sweep) -> TrackedSweep | None:
        """Add the next sweep; return the sweep before it, whose twist is now known."""
        if len(sweep) < MIN_POINTS:
            return None
        last = self.tracked[-1] if self.tracked else None
        pose = None
        if last is not None:
            dt_s = (sweep.stamp_ns - last.sweep.stamp_ns) * 1e-9
            if -_MAX_STEP_S < dt_s <= 0.0:
                return None
            pose = self._pose(sweep, last, dt_s) if dt_s > 0.0 else None  # None: the clock was set back
        if pose is None:
            self._chain += 1
            pose = np.zeros(3)
        new = TrackedSweep(sweep, pose, self._chain)
        self.tracked.append(new)
        del self.tracked[:-_KEEP]
        self._target = Target(sweep.points_m, sweep.normals)
        if len(self.tracked) < 3:
            return None
        before, middle, after = self.tracked[-3:]
        if not before.chain == middle.chain == after.chain:
            return None
        span_s = (after.sweep.stamp_ns - before.sweep.stamp_ns) * 1e-9
        moved = between(before.pose, after.pose)
        turn = 0.5 * moved[2]
        c, s = math.cos(turn), math.sin(turn)  # to the frame of the middle
        middle.twist = (
            np.array([c * moved[0] + s * moved[1], -s * moved[0] + c * moved[1], moved[2]]) / span_s
        )
        return middle

    def _pose(self, sweep: Sweep, last: TrackedSweep, dt_s: float) -> np.ndarray | None:
        if dt_s > _MAX_STEP_S or self._target is None:
            return None
        guesses = [np.zeros(3)]
        if len(self.tracked) > 1 and self.tracked[-2].chain == last.chain:
            before = self.tracked[-2]
            previous_s = (last.sweep.stamp_ns - before.sweep.stamp_ns) * 1e-9
            guesses.insert(0, between(before.pose, last.pose) * min(dt_s / previous_s, 3.0))
        best = None
        for guess in guesses:
            found = self._target.align(sweep.points_m, guess)
            if found is not None and (best is None or found.residual_m < best.residual_m):
                best = found
            if best is not None and best.agreeing > 0.85:
                break
        if best is None or best.agreeing < _MIN_AGREEING:
            return None
        return compose(last.pose, best.pose)


@dataclass
class OrderEvidence:
    """Residuals of compared sweeps for each candidate of the sweep's signed duration.

    `candidates_s`: time from the first beam in the array to the last; negative: the last was measured first;
    0: all beams at once.
    """

    candidates_s: tuple[float, ...]
    residuals_m: list[list[float]] = field(default_factory=list)  # per pair, one residual per candidate
    turn_rate_rad_s: float = 0.0  # largest turn rate of a compared sweep

    def compare(self, new: TrackedSweep, others: list[TrackedSweep]) -> bool:
        """Compare a sweep with the earlier one that tells most; return whether there was one."""
        best, best_skew = None, _MIN_SKEW_RAD
        sweep_s = max(abs(s) for s in self.candidates_s)
        if new.twist is None:
            return False
        for other in others:
            if other is new or other.twist is None or other.chain != new.chain:
                continue
            moved = between(other.pose, new.pose)
            turn = abs(moved[2])
            if math.hypot(moved[0], moved[1]) > _MAX_DISTANCE_M or turn > _MAX_TURN_RAD:
                continue
            # Part of the sweep beyond the seam, where other ends of the two sweeps see the same surface.
            full = new.sweep.field_of_view_rad > math.radians(345.0)
            seam = min(turn, math.pi) / (2.0 * math.pi) if full else 0.0
            rates = abs(new.twist[2] + other.twist[2]) / 2.0, abs(new.twist[2] - other.twist[2]) / 2.0
            skew = sweep_s * max(rates[0] * seam * 2.0, rates[1])
            if skew > best_skew:
                best, best_skew = other, skew
        if best is None or best.twist is None:
            return False
        row = []
        guess = between(best.pose, new.pose)
        for sweep_s in self.candidates_s:
            target = Target(*deskewed(best.sweep, best.twist, sweep_s))
            points, _ = deskewed(new.sweep, new.twist, sweep_s)
            found = target.align(points, guess, (0.6, 0.4, 0.3, 0.2, 0.2, 0.2))
            if found is None or found.agreeing < 0.4:
                return False
            row.append(found.residual_m)
        self.residuals_m.append(row)
        self.turn_rate_rad_s = max(self.turn_rate_rad_s, abs(float(new.twist[2])))
        return True

    @property
    def pairs(self) -> int:
        return len(self.residuals_m)

    @property
    def means_m(self) -> np.ndarray:
        """Return the mean residual float64 [C] of each candidate, in m."""
        return np.mean(np.array(self.residuals_m).reshape(-1, len(self.candidates_s)), axis=0)

    def decide(self) -> int | None:
        """Return the index of the candidate that is clearly better than all others; else None."""
        if self.pairs < MIN_PAIRS:
            return None
        best = int(self.means_m.argmin())
        others = [other for other in range(len(self.candidates_s)) if other != best]
        return best if all(self._is_better(best, other) for other in others) else None

    def _is_better(self, a: int, b: int) -> bool:
        """Return whether the candidate `a` explains the sweeps clearly better than `b`.

        Pairs of one turn have common errors, so a small difference counts only over many pairs.
        """
        rows, means = np.array(self.residuals_m), self.means_m
        wins = float((rows[:, a] < rows[:, b]).mean())
        ratio = means[a] / max(means[b], 1e-9)
        return any(
            self.pairs >= pairs and wins >= least_wins and ratio <= most
            for pairs, least_wins, most in ((MIN_PAIRS, 0.8, 0.88), (MANY_PAIRS, 0.85, 0.95))
        )

    def sentence(self) -> str:
        """Return the evidence in words: the mean residual of each candidate, and the number of pairs."""
        said = ", ".join(
            f"{describe_sweep(s)} {mean * 100.0:.2f} cm"
            for s, mean in sorted(zip(self.candidates_s, self.means_m), key=lambda pair: pair[1])
        )
        rate_deg_s = math.degrees(self.turn_rate_rad_s)
        return f"{self.pairs} pairs of sweeps at up to {rate_deg_s:.0f} deg/s disagree by {said}"


def describe_sweep(sweep_s: float) -> str:
    """Return the order of the beams of a signed duration of a sweep, in words."""
    if sweep_s == 0.0:
        return "all at once"
    return f"{'in order' if sweep_s > 0.0 else 'reversed'} within {abs(sweep_s):.3g} s"
