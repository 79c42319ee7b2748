"""The depth source's estimate, scaled to metres with the beams of the scan line, and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.services.fusion.pairs import make_pairs
from beamsplat.services.fusion.scaling import Kind, affine, as_depth

_COLUMNS = 64  # at which the factor is evaluated; it is interpolated between them
_BAND = 0.10  # of the image width: standard deviation of the smoothing kernel


@dataclass(frozen=True)
class MetricEstimate:
    """A depth estimate with one scale factor per image column that converts the values to metres."""

    estimate: np.ndarray  # float32 [H, W], uncorrected
    log_factor: np.ndarray  # float64 [W]
    spread: float  # median |log ratio| at beams, each with a correction that excludes its neighbours
    pairs: int

    @property
    def depth_m(self) -> np.ndarray:
        """Return the scaled depth float32 [H, W], m."""
        return self.estimate * np.exp(self.log_factor).astype(np.float32)

    def at_size(self, width: int, height: int) -> np.ndarray:
        """Return the scaled depth (m), float32 [height, width], sampled at the nearest pixels."""
        small = cv2.resize(self.estimate, (width, height), interpolation=cv2.INTER_NEAREST)
        columns = (np.arange(width) * self.estimate.shape[1]) // width
        return small * np.exp(self.log_factor[columns]).astype(np.float32)


def metric_estimate(
    values: np.ndarray, kind: Kind, uv_px: np.ndarray, z_m: np.ndarray
) -> MetricEstimate | None:
    """Return the estimate with a smooth scale factor per column; None for fewer than 12 pairs.

    `spread` is the error at each beam when the beam and its neighbours are left out of the fit; the same
    error is assumed for pixels away from the scan line. Arguments as in `scaling.ratio`.
    """
    if kind == "disparity":
        fitted = affine(values, kind, uv_px, z_m)
        estimate = fitted.depth_m if fitted.ok else as_depth(values, kind)
    else:
        estimate = values
    pairs = make_pairs(estimate, uv_px, z_m)
    if len(pairs) < 12:
        return None
    log_ratio = np.log(pairs.z_m / pairs.estimate)
    u = pairs.uv_px[:, 0]
    band = _BAND * values.shape[1]
    columns = np.arange(values.shape[1], dtype=np.float64)
    some = np.linspace(0.0, columns[-1], _COLUMNS)  # the factor is smooth
    factor = np.interp(columns, some, _smooth(some, u, log_ratio, band, exclude=0.0))
    left_out = _smooth(u, u, log_ratio, band, exclude=0.5 * band)
    spread = float(np.median(np.abs(log_ratio - left_out)))
    return MetricEstimate(estimate, factor, spread, len(pairs))


def _smooth(at: np.ndarray, u: np.ndarray, values: np.ndarray, band: float, exclude: float) -> np.ndarray:
    """Return weighted means [M] of `values` at the columns `at`, shrunk towards the median of all values.

    Weights fall with the distance of the sample's column `u` (width `band`, px); samples nearer than
    `exclude` (px) are not used.
    """
    distance = np.abs(at[:, None] - u[None])
    weight = np.exp(-0.5 * (distance / band) ** 2) * (distance >= exclude)
    centre = float(np.median(values))
    clipped = np.clip(values, centre - 0.7, centre + 0.7)
    return (weight @ clipped + 0.5 * centre) / (weight.sum(axis=1) + 0.5)
