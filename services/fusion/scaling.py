"""One correction for a whole image: a scale factor (the paper's ratio), or scale and shift of 1/z."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from beamsplat.services.fusion.pairs import effective_count, largest_cluster, make_pairs
from beamsplat.services.fusion.result import FusionResult, rejected

Kind = Literal["metric", "relative", "disparity", "none"]

MIN_PAIRS = 12
MIN_INLIER_SHARE = 0.3
# Cluster radius of log ratios: along one image row a small network errs by tens of per cent; larger
# differences come from objects that it does not see.
_RADIUS = 0.2
_MAX_DEPTH_M = 30.0
# The scan line shows one row of the image. The scale of the whole image differs from that of the row by this
# share of the spread of the row, and by at least so much (relative). RMS with fastdepth and stixel on house_a
# and a simulated drive of seed 101.
_OFF_LINE, _OFF_LINE_LEAST = 0.8, 0.04


def as_depth(values: np.ndarray, kind: Kind) -> np.ndarray:
    """Return values proportional to depth, float32 [H, W]; disparity is inverted, its shift taken as 0."""
    if kind != "disparity":
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values > 1e-6, 1.0 / values, np.nan).astype(np.float32)


def ratio(values: np.ndarray, kind: Kind, uv_px: np.ndarray, z_m: np.ndarray) -> FusionResult:
    """Return the estimate D times alpha = sum(l_j) / sum(d_j) over the largest cluster of ratios l_j / d_j.

    This is the paper's method. d_j is the value of D at the pixel of beam j.

    Args:
        values: float32 [H, W], the dense estimate.
        kind: meaning of the values: metric, relative or disparity.
        uv_px: float64 [N, 2], the beams' pixels.
        z_m: float64 [N], the beams' optical z (l_j).
    """
    estimate = as_depth(values, kind)
    found = fit_scale(estimate, uv_px, z_m)
    if isinstance(found, str):
        return rejected(values.shape, found)
    depth = (found.alpha * estimate).astype(np.float32)
    sigma = depth * np.float32(np.hypot(found.spread, found.sigma / found.alpha))
    return FusionResult(
        depth, sigma, scale=found.alpha, scale_sigma=found.image_sigma, inlier_share=found.inlier_share,
        residual_m=found.residual_m, pairs=found.pairs,
    )  # fmt: skip


@dataclass(frozen=True)
class ScaleFit:
    """The scale alpha (metres per unit of the estimate), its standard error, and the agreement of pairs."""

    alpha: float
    sigma: float  # at the beams
    spread: float  # standard deviation of the log ratios of all pairs about alpha
    inlier_share: float
    residual_m: float
    pairs: int

    @property
    def image_sigma(self) -> float:
        """Return the standard deviation of alpha as the scale of the whole image."""
        return float(np.linalg.norm([self.sigma, self.alpha * off_line_sigma(self.spread)]))


def off_line_sigma(spread: float) -> float:
    """Return the standard deviation of the log ratio of the scale of an image to that of its scan line.

    `spread` is the standard deviation of the log ratios along the scan line.
    """
    return float(np.hypot(_OFF_LINE * spread, _OFF_LINE_LEAST))


def fit_scale(estimate: np.ndarray, uv_px: np.ndarray, z_m: np.ndarray) -> ScaleFit | str:
    """Return the scale fit of an estimate float32 [H, W] proportional to depth; a sentence (str) if it fails.

    `uv_px`, `z_m` as in `ratio`.
    """
    pairs = make_pairs(estimate, uv_px, z_m)
    if len(pairs) < MIN_PAIRS:
        return _too_few(len(uv_px), len(pairs))
    inlier = largest_cluster(np.log(pairs.z_m / pairs.estimate), _RADIUS)
    used = pairs.take(inlier)
    if len(used) < MIN_PAIRS or inlier.mean() < MIN_INLIER_SHARE:
        return f"beams and depth estimate do not agree on one scale ({len(used)} of {len(pairs)} pairs)"
    alpha = float(used.z_m.sum() / used.estimate.sum())
    residual = used.z_m - alpha * used.estimate
    n_eff = effective_count(residual)
    # Standard error of a ratio estimator (Cochran, Sampling Techniques, 2.41), with n_eff for n.
    error = float(np.sqrt(np.mean(residual**2) / max(n_eff - 1.0, 1.0)) / used.estimate.mean())
    spread = float(np.std(np.log(pairs.z_m / (alpha * pairs.estimate))))
    return ScaleFit(
        alpha, error, spread, float(inlier.mean()), float(np.median(np.abs(residual))), len(pairs)
    )


def affine(values: np.ndarray, kind: Kind, uv_px: np.ndarray, z_m: np.ndarray) -> FusionResult:
    """Return metric depth z from 1/z = a q + b, where q is the estimate as inverse depth.

    Robust fit: median of slopes (Theil-Sen over fixed pairs of points), then reweighted least squares
    (Tukey). If the values q differ too little, the shift b is not observable and stays 0. Arguments as in
    `ratio`.
    """
    pairs = make_pairs(as_depth(values, kind), uv_px, z_m)
    if len(pairs) < MIN_PAIRS:
        return rejected(values.shape, _too_few(len(uv_px), len(pairs)))
    q, y = 1.0 / pairs.estimate, 1.0 / pairs.z_m
    a, b, weight = robust_line(q, y)
    if not a > 0.0:
        return rejected(
            values.shape,
            "nearer in the depth estimate is farther for the beams: the network or the beams are wrong",
        )
    inlier = weight > 0.0
    if inlier.mean() < MIN_INLIER_SHARE:
        return rejected(
            values.shape,
            f"beams and depth estimate do not fit one line ({inlier.sum()} of {len(pairs)} pairs)",
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        q_all = values if kind == "disparity" else 1.0 / values
        inverse = np.maximum(a * q_all + b, 1.0 / _MAX_DEPTH_M)
        depth = np.where(np.isfinite(q_all), 1.0 / inverse, np.nan).astype(np.float32)
    residual = y - (a * q + b)
    spread = 1.4826 * float(np.median(np.abs(residual)))
    n_eff = effective_count(residual[inlier])
    error = spread / np.sqrt(max(n_eff - 2.0, 1.0)) / max(float(np.std(q[inlier])), 1e-9)
    fitted = 1.0 / np.maximum(a * q + b, 1.0 / _MAX_DEPTH_M)
    sigma = (depth**2 * np.float32(max(spread, 1e-4))).astype(np.float32)
    return FusionResult(
        depth, sigma, scale=1.0 / a, scale_sigma=error / a**2, inlier_share=float(inlier.mean()),
        residual_m=float(np.median(np.abs(fitted - pairs.z_m)[inlier])), pairs=len(pairs),
    )  # fmt: skip


def robust_line(q: np.ndarray, y: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return (a, b, weights [N]) of the robust fit y = a q + b."""
    order = np.argsort(q, kind="stable")
    half = len(q) // 2
    low, high = order[:half], order[-half:]
    run = q[high] - q[low]
    wide = run > 0.02 * np.median(q)
    if wide.sum() >= MIN_PAIRS // 2 and np.std(q) > 0.03 * np.mean(q):
        a = float(np.median((y[high] - y[low])[wide] / run[wide]))
        b = float(np.median(y - a * q))
        free = True
    else:
        a, b, free = float(np.median(y / q)), 0.0, False
    weight = np.ones(len(q))
    for _ in range(10):
        residual = y - a * q - b
        scale = 4.685 * max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
        weight = np.where(np.abs(residual) < scale, (1.0 - (residual / scale) ** 2) ** 2, 0.0)
        if free:
            mean_q, mean_y = np.average(q, weights=weight), np.average(y, weights=weight)
            spread = float(weight @ (q - mean_q) ** 2)
            if spread <= 0.0:
                break
            a = float(weight @ ((q - mean_q) * (y - mean_y))) / spread
            b = float(mean_y - a * mean_q)
        else:
            a = float(weight @ (q * y) / (weight @ q**2))
    return a, b, weight


def _too_few(beams: int, pairs: int) -> str:
    if beams == 0:
        return "no beams in view"
    return (
        f"only {pairs} of {beams} beams in view fall on pixels with estimated depth; {MIN_PAIRS} are needed"
    )
