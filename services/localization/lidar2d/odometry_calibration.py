"""Systematic errors of the wheel odometry, estimated against the matched scans: scales, slip, sign."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.services.localization.lidar2d.wheel_heading import WheelHeadingError

WINDOW_M, WINDOW_RAD, WINDOW_S = 0.5, 0.5, 10.0  # a comparison covers this motion, in at most this time
MATCH_SIGMA_M, MATCH_SIGMA_RAD = 0.005, 0.003  # error of the matched motion over a comparison
INITIAL_SIGMA = 0.03  # of the scales, before the first comparison: typical errors of wheel radius and track
SIGMA_PER_WINDOW = 0.001  # drift of a scale between comparisons: load, floor, tyre pressure
# Relative error of a motion by wheels that is not systematic: initial value and limits of its estimate.
RANDOM_ERROR, MIN_RANDOM_ERROR, MAX_RANDOM_ERROR = 0.02, 0.005, 0.1
OUTLIER_SIGMAS = 4.0
RESTART_WINDOWS = 4  # comparisons in a row that disagree with the scale, after which it starts anew
FORGET = 0.95  # per comparison, of the share of comparisons that disagree
MAX_FACTOR = 20.0  # of one comparison; larger ones are those of frozen wheels
MAX_DISAGREEING = 0.3  # share of the comparisons, above which the odometry is not used
MAX_SIGMA = 0.1  # of a scale, above which the odometry is not used
REPORTED_ERROR = 0.05  # relative error of a scale that is reported


class ScaleEstimate:
    """Kalman filter of one factor from wheels to scans; disagreeing comparisons are counted, not used."""

    def __init__(self) -> None:
        self.value, self.variance = 1.0, INITIAL_SIGMA**2
        self._random_variance = RANDOM_ERROR**2
        self.disagreeing = 0.0  # recent share of the comparisons
        self.comparisons = self.outliers = 0
        self._outliers_in_a_row: list[float] = []

    @property
    def sigma(self) -> float:
        return math.sqrt(self.variance)

    @property
    def random_variance(self) -> float:
        """Relative variance of the motion over a window, beyond that of the scale."""
        return self._random_variance

    def update(self, factor: float, sigma: float) -> None:
        """Take in one comparison: the factor that it gives, and its standard deviation."""
        self.comparisons += 1
        self.variance += SIGMA_PER_WINDOW**2
        noise = sigma**2 + self._random_variance
        error = factor - self.value
        outlier = error**2 > OUTLIER_SIGMAS**2 * (self.variance + noise)
        self.disagreeing = FORGET * self.disagreeing + (1.0 - FORGET) * outlier
        sample = min(error**2, 9.0 * noise)  # bounded: slip is not typical
        self._random_variance += 0.1 * (sample - self.variance - noise)
        self._random_variance = min(max(self._random_variance, MIN_RANDOM_ERROR**2), MAX_RANDOM_ERROR**2)
        if not outlier:
            gain = self.variance / (self.variance + noise)
            self.value = float(self.value + gain * error)
            self.variance *= 1.0 - gain
            self._outliers_in_a_row.clear()
            return
        self.outliers += 1
        self._outliers_in_a_row.append(factor)
        if len(self._outliers_in_a_row) >= RESTART_WINDOWS:
            # Another constant factor, or none at all: the spread of the comparisons tells.
            recent = np.array(self._outliers_in_a_row[-RESTART_WINDOWS:])
            self.value = float(np.median(recent))
            self.variance = max(float(np.ptp(recent)), INITIAL_SIGMA) ** 2
            self._outliers_in_a_row.clear()


@dataclass(frozen=True)
class OdometryReport:
    """What is known about the wheel odometry of a drive; `text` is empty if it agrees with the scans."""

    distance_scale: float  # true distance / distance by wheels
    distance_scale_sigma: float
    turn_scale: float
    turn_scale_sigma: float
    delay_s: float  # stamps of the odometry minus those of the scans
    comparisons: int
    disagreeing: (
        int  # comparisons that disagree by more than their uncertainty: slip, frozen values, wrong sign
    )
    used: bool
    text: str


class OdometryCalibration:
    """Compares the motion by wheels with the motion by scans over windows of 0.5 m or 0.5 rad."""

    def __init__(self) -> None:
        self.distance, self.turn = ScaleEstimate(), ScaleEstimate()
        self.heading = WheelHeadingError()
        self.restart()

    def apply(self, motion: np.ndarray) -> np.ndarray:
        """Return a motion [3] by wheels with the estimated scales."""
        return motion * np.array([self.distance.value, self.distance.value, self.turn.value])

    @property
    def usable(self) -> bool:
        """Whether predictions by this odometry are better than none."""
        return all(
            s.disagreeing <= MAX_DISAGREEING and s.sigma <= MAX_SIGMA for s in (self.distance, self.turn)
        )

    @property
    def distance_random(self) -> float:
        """Relative variance of a distance of one metre, beyond that of the scale."""
        return self.distance.random_variance * WINDOW_M

    def observe(self, wheels: np.ndarray | None, scans: np.ndarray, dt_s: float) -> None:
        """Add the motion [3] between two scans by wheels, without scales, and by matching.

        `wheels` is None if there is no odometry; the window then starts again.
        """
        if wheels is None:
            self.heading.restart()
            self.restart()
            return
        scaled = self.apply(wheels)
        self.heading.observe(float(scans[2] - scaled[2]), scaled, dt_s, self.turn.sigma)
        if self._duration_s > WINDOW_S:
            self.restart()
            return
        self._duration_s += dt_s
        length = math.hypot(wheels[0], wheels[1])
        if length > 1e-6:
            self._along_m += (wheels[0] * scans[0] + wheels[1] * scans[1]) / length
        self._wheels_m += length
        self._wheels_rad += wheels[2]
        self._scans_m += math.hypot(scans[0], scans[1])
        self._scans_rad += scans[2]
        moved_m = max(self._wheels_m, self._scans_m)
        turned_rad = max(abs(self._wheels_rad), abs(self._scans_rad))
        if moved_m < WINDOW_M and turned_rad < WINDOW_RAD:
            return
        if moved_m >= WINDOW_M / 2:
            frozen = self._wheels_m < moved_m / MAX_FACTOR
            factor = MAX_FACTOR if frozen else self._along_m / self._wheels_m
            self.distance.update(factor, MATCH_SIGMA_M / moved_m)
        if turned_rad >= WINDOW_RAD / 2:
            frozen = abs(self._wheels_rad) < turned_rad / MAX_FACTOR
            factor = MAX_FACTOR if frozen else self._scans_rad / self._wheels_rad
            self.turn.update(factor, MATCH_SIGMA_RAD / turned_rad)
        self.restart()

    def restart(self) -> None:
        """Start a new window: the motion before it cannot be compared."""
        # Sums over the window: distance and turn by wheels; by scans the distance along the direction of the
        # wheels (negative: against it), the distance in any direction, and the turn.
        self._wheels_m = self._wheels_rad = 0.0
        self._along_m = self._scans_m = self._scans_rad = 0.0
        self._duration_s = 0.0

    def report(self, delay_s: float) -> OdometryReport:
        """Return the estimates and a sentence about what disagrees."""
        d, t = self.distance, self.turn
        found = []
        if not self.usable:
            share = max(d.disagreeing, t.disagreeing)
            found.append(
                f"not used: {share:.0%} of the recent comparisons with the scans disagree"
                if share > MAX_DISAGREEING
                else "not used: its scale is not constant"
            )
        for name, s in (("distances", d), ("turns", t)):
            if abs(s.value - 1.0) > REPORTED_ERROR + 2.0 * s.sigma:
                sign = "their sign is wrong; " if s.value < 0 else ""
                found.append(f"{sign}true {name} are {abs(s.value):.3f} +- {s.sigma:.3f} of those by wheels")
        if abs(delay_s) > 0.05:
            found.append(f"its stamps are {abs(delay_s):.2f} s {'late' if delay_s > 0 else 'early'}")
        outliers = d.outliers + t.outliers
        return OdometryReport(
            d.value, d.sigma, t.value, t.sigma, delay_s, d.comparisons + t.comparisons, outliers, self.usable,
            "; ".join(found),
        )  # fmt: skip
