"""Poisson completion: the shape of a depth estimate, the metres of measurements whose sigma is known.

A network knows the shape of a surface better than its distance: its log depth has errors that change slowly
over the image and jump at edges. So differences of the estimate's log depth q between neighbouring pixels are
taken as measurements of the differences of the true log depth x. Beams, floor and plane sweep measure x
itself, as m:

    minimise  sum_i (x_i - m_i)^2 / s_i^2  +  sum_ij (x_i - x_j - (q_i - q_j))^2 / s_ij^2
                                           +  sum_ij (x_i - x_j - (m_i - m_j))^2 / t_ij^2 .

The last sum is there because errors of neighbouring pixels of a plane sweep are alike: it knows differences
better than depths, and where it is sure, better than a network does.
Its Euler-Lagrange equation is a Poisson equation with the estimate's gradient as its source (Perez et al.
2003; for depth completion: Large Depth Completion Model, arXiv 2605.30115, where it starts a network). With
y = x - q, it is a Laplace equation for the correction y of the estimate's log depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.services.fusion import poisson_kernels as kernels
from beamsplat.services.fusion.scaling import MIN_PAIRS, Kind, robust_line

_COARSEST = 4  # px: the V-cycle ends at a level that is not higher and not wider than this
_TOLERANCE, _ITERATIONS = 2e-4, 60  # of conjugate gradients: change of log depth in one step, most steps
_SWEEPS = 16  # of the path variance, most
_LAGS, _LEAST_CHANGES = (4, 16), 30  # px of the working size; pairs of pixels
_COPIED = 0.003  # log depth: an estimate with a smaller error at beams and floor was made from them
_MAX_DEPTH_M = 30.0
_FIT_POINTS = 2000  # to which scale and shift of a disparity are fitted, most


Grid = tuple[np.ndarray, np.ndarray]  # float64 [h, w] each: to the neighbour at the right, and below


@dataclass(frozen=True)
class PoissonSettings:
    """Error model of the completion; differences are of log depth, between neighbours of the working size."""

    # Standard deviation of a difference of the estimate: measured in each image at beams and floor, within
    # these limits; the middle one where too few of them are neighbours.
    step: tuple[float, float, float] = (0.004, 0.04, 0.2)
    per_jump: float = 0.3  # its growth with the difference itself: an edge of the estimate is less certain
    # Errors of neighbouring pixels of a plane sweep are alike. So many measurements count as one; and a
    # difference of two neighbours has this share of their sigma.
    alike: float = 10.0
    along: float = 0.2
    exact: float = 0.01  # measurements with a smaller sigma (beams, floor) count each, and are kept
    cauchy: float = 2.5  # residual in sigma at which the weight of a term is halved
    rounds: int = 2  # of reweighting


@dataclass(frozen=True)
class CompletedDepth:
    """A completed depth map. NaN where no measurement is connected by the estimate."""

    depth_m: np.ndarray  # float32 [h, w]
    sigma_log: np.ndarray  # float32 [h, w]: standard deviation of log depth


def complete(
    estimate: np.ndarray,  # float32 [h, w], NaN = unknown
    kind: Kind,
    measured_m: np.ndarray,  # float32 [h, w], NaN = none
    measured_sigma_log: np.ndarray,  # float32 [h, w]
    settings: PoissonSettings | None = None,
) -> CompletedDepth | None:
    """Return metric depth with the gradients of `estimate` and the level of the measurements.

    The estimate may be wrong by a factor, for the kind `disparity` also by a shift, that differs from region
    to region. Pixels without an estimate keep their measurement.

    Returns:
        None if fewer than `MIN_PAIRS` measurements are on pixels of the estimate, or if near and far of a
        disparity are swapped: then the estimate says nothing about this image. Also if the estimate repeats
        the exact measurements, as that of `stixel`: then they do not tell its error elsewhere.
    """
    settings = settings or PoissonSettings()
    with np.errstate(invalid="ignore", divide="ignore"):
        measured = (measured_m > 0.0) & (measured_sigma_log > 0.0) & np.isfinite(measured_sigma_log)
    shape = _log_shape(estimate, kind, np.where(measured, measured_m, np.nan))
    if shape is None:
        return None
    used = measured & np.isfinite(shape)
    if np.count_nonzero(used) < MIN_PAIRS:
        return None
    sigma = np.where(used, measured_sigma_log, 1.0).astype(np.float64)
    alike = np.where(sigma < settings.exact, 1.0, settings.alike)
    weight = np.where(used, 1.0 / (alike * sigma**2), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        datum = np.where(used, np.log(measured_m.astype(np.float64)) - shape, 0.0)
    exact = datum[used & (sigma < settings.exact)]
    if len(exact) >= MIN_PAIRS and np.median(np.abs(exact - np.median(exact))) < _COPIED:
        return None
    step = difference_sigma(np.where(used & (sigma < settings.exact), datum, np.nan), settings.step)
    right, down = _step_variance(shape, step, settings.per_jump)
    y, right, down = solve_robustly(
        weight,
        datum,
        (right, down),
        _measured_variance(np.where(used, sigma, np.inf), settings.along),
        settings,
    )

    variance = np.where(used, sigma**2, np.inf)
    kernels.path_variance(variance, right, down, _SWEEPS)
    with np.errstate(invalid="ignore"):
        depth = np.where(np.isfinite(variance), np.exp(np.minimum(y + shape, np.log(_MAX_DEPTH_M))), np.nan)
    keep = measured & (~np.isfinite(shape) | (measured_sigma_log < settings.exact))
    depth = np.where(keep, measured_m, depth).astype(np.float32)
    spread = np.where(keep, measured_sigma_log, np.sqrt(variance))
    return CompletedDepth(depth, np.where(np.isfinite(depth), spread, np.nan).astype(np.float32))


def estimate_at_size(values: np.ndarray, kind: Kind, width: int, height: int) -> np.ndarray:
    """Return a depth estimate [H, W], reduced to float32 [height, width]; NaN where a pixel is unknown.

    Averages are of log depth, for the kind `disparity` of the disparity.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        averaged = values if kind == "disparity" else np.where(values > 0.0, np.log(values), np.nan)
    small = cv2.resize(averaged.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return small if kind == "disparity" else np.exp(small)


def solve_robustly(
    weight: np.ndarray,  # float64 [h, w], 0 = not measured
    datum: np.ndarray,  # float64 [h, w]
    estimated: Grid,  # variances of the estimate's differences; inf = unknown
    measured: Grid,  # variances of the measurements' differences; inf = one of the two is not measured
    settings: PoissonSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the correction y [h, w], and the reweighted variances of the estimate's differences.

    Gross errors of measurements and of differences (edges that only one of the two has) lose weight by a
    Cauchy loss: weight / (1 + (residual / (cauchy sigma))^2). In a part without measurements, y has no
    meaning.
    """
    limit = settings.cauchy**2
    jumps = [_difference(datum, axis) for axis in (1, 0)]
    used, by_estimate, by_measurement = weight, list(estimated), list(measured)
    y = np.full(weight.shape, float(np.average(datum, weights=weight)) if weight.any() else 0.0)
    for number in range(settings.rounds + 1):
        pull = [1.0 / variance for variance in by_measurement]
        conductance = [1.0 / variance + c for variance, c in zip(by_estimate, pull)]
        source = used * datum - _divergence(pull[0] * jumps[0], pull[1] * jumps[1])
        y = solve(used, source, conductance[0], conductance[1], start=y)
        if number == settings.rounds:
            break
        used = weight / (1.0 + weight * (datum - y) ** 2 / limit)
        for k, axis in enumerate((1, 0)):
            change = _difference(y, axis)
            by_estimate[k] = estimated[k] + change**2 / limit
            by_measurement[k] = measured[k] + (change - jumps[k]) ** 2 / limit
    return y, by_estimate[0], by_estimate[1]


def solve(
    weight: np.ndarray, source: np.ndarray, right: np.ndarray, down: np.ndarray, start: np.ndarray,
    tolerance: float = _TOLERANCE, iterations: int = _ITERATIONS,
) -> np.ndarray:  # fmt: skip
    """Return y float64 [h, w] of the equation weight y + sum of conductance (y - neighbour's y) = source.

    Args:
        weight: float64 [h, w], >= 0.
        source: float64 [h, w], finite.
        right: conductance to the right neighbour, float64 [h, w], >= 0; the last column has no effect.
        down: conductance to the neighbour below; the last row has no effect.
        start: float64 [h, w], where the iteration starts; a part without weight keeps its level.
        tolerance: change of y in one step at which the iteration ends.
        iterations: steps after which it ends anyway.
    """
    h, w = weight.shape
    sizes = [(h, w)]
    while max(sizes[-1]) > _COARSEST:
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    heights, widths = (np.array(column, np.int64) for column in zip(*sizes))
    areas = (heights + 2) * (widths + 2)
    starts = np.concatenate([[0], np.cumsum(areas)[:-1]]).astype(np.int64)
    weights, rights, downs, diagonal, inverse = (np.zeros(int(areas.sum())) for _ in range(5))
    first = slice(0, int(areas[0]))
    for target, values in ((weights, weight), (rights, right), (downs, down)):
        target[first].reshape(h + 2, w + 2)[1:-1, 1:-1] = values
    rights[first].reshape(h + 2, w + 2)[:, w] = 0.0
    downs[first].reshape(h + 2, w + 2)[h] = 0.0
    kernels.build_levels(heights, widths, starts, weights, rights, downs, diagonal, inverse)
    b, y = np.pad(source, 1).ravel(), np.pad(start, 1).ravel()
    kernels.conjugate_gradients(
        heights, widths, starts, rights, downs, diagonal, inverse, b, tolerance, iterations, y
    )
    return y.reshape(h + 2, w + 2)[1:-1, 1:-1].copy()


def _difference(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the neighbour's value at the right (axis 1) or below (axis 0) minus the own, 0 at the border."""
    out = np.zeros_like(values)
    inside = (slice(None), slice(-1)) if axis == 1 else (slice(-1),)
    out[inside] = np.diff(values, axis=axis)
    return out


def _divergence(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return flow out of each pixel minus flow into it, of flows [h, w] to the right and down."""
    out = right + down
    out[:, 1:] -= right[:, :-1]
    out[1:] -= down[:-1]
    return out


def difference_sigma(error: np.ndarray, limits: tuple[float, float, float]) -> float:
    """Return the standard deviation of an estimate's error of the difference between neighbours.

    The error of log depth is taken as a random walk over the image: over n pixels it changes by the n-fold
    variance. If it changes smoothly instead, the longest of `_LAGS` has the largest quotient, which is used.

    Args:
        error: log error of the estimate at exact measurements, float64 [h, w], NaN = unknown.
        limits: smallest result, result for too few pairs, largest result.
    """
    quotients = []
    for lag in _LAGS:
        for change in (error[:, lag:] - error[:, :-lag], error[lag:] - error[:-lag]):
            known = np.abs(change[np.isfinite(change)])
            if len(known) >= _LEAST_CHANGES:
                # The median does not see edges that one of the two has alone.
                quotients.append(1.4826 * float(np.median(known)) / np.sqrt(lag))
    return float(np.clip(max(quotients), limits[0], limits[2])) if quotients else limits[1]


def _step_variance(shape: np.ndarray, step: float, per_jump: float) -> Grid:
    """Return the variances of the differences of a log shape [h, w] to the neighbours at the right and below.

    `step`, `per_jump` as in `PoissonSettings`. inf where one of the two pixels is unknown, and at the border.
    """
    right, down = np.full(shape.shape, np.inf), np.full(shape.shape, np.inf)
    across, along = np.diff(shape, axis=1), np.diff(shape, axis=0)
    for variance, difference in ((right[:, :-1], across), (down[:-1], along)):
        known = np.isfinite(difference)
        variance[known] = step**2 + (per_jump * difference[known]) ** 2
    return right, down


def _measured_variance(sigma: np.ndarray, along: float) -> Grid:
    """Return the variances of the differences of measurements with standard deviations `sigma` [h, w]."""
    right, down = np.full(sigma.shape, np.inf), np.full(sigma.shape, np.inf)
    right[:, :-1] = (along * np.maximum(sigma[:, :-1], sigma[:, 1:])) ** 2
    down[:-1] = (along * np.maximum(sigma[:-1], sigma[1:])) ** 2
    return right, down


def _log_shape(estimate: np.ndarray, kind: Kind, measured_m: np.ndarray) -> np.ndarray | None:
    """Return the log depth of the estimate up to a constant, float64 [h, w], NaN = unknown; None if it fails.

    Scale and shift of a disparity are fitted to the measurements: without its shift, its logarithm has
    another shape.
    """
    values = estimate.astype(np.float64)
    if kind == "disparity":
        usable = np.flatnonzero(np.isfinite(measured_m) & np.isfinite(estimate))
        if len(usable) < MIN_PAIRS:
            return None
        usable = usable[:: -(-len(usable) // _FIT_POINTS)]
        a, b, _ = robust_line(values.ravel()[usable], 1.0 / measured_m.ravel()[usable].astype(np.float64))
        if not a > 0.0:
            return None
        values = 1.0 / np.maximum(a * values + b, 1.0 / _MAX_DEPTH_M)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(values > 0.0, np.log(values), np.nan)
