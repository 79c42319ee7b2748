"""The network's estimate as a candidate: brought to metres along the scan line, and how far to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.services.fusion.pairs import make_pairs
from beamsplat.services.fusion.scaling import Kind, affine, as_depth

_COLUMNS = 64
_BAND = 0.10  # of the image's width: how far a beam's ratio reaches sideways


@dataclass(frozen=True)
class MetricEstimate:
    """A network's depth after correction by columns."""

    estimate: np.ndarray  # float32 [H, W] before it
    log_factor: np.ndarray  # float64 [W]
    spread: float  # median |log ratio| at beams that were left out of the correction of their columns
    pairs: int

    @property
    def depth_m(self) -> np.ndarray:
        """float32 [H, W]."""
        return self.estimate * np.exp(self.log_factor).astype(np.float32)

    def at_size(self, width: int, height: int) -> np.ndarray:
        """float32 [height, width]: the depth at the nearest pixels."""
        small = cv2.resize(self.estimate, (width, height), interpolation=cv2.INTER_NEAREST)
        columns = (np.arange(width) * self.estimate.shape[1]) // width
        return small * np.exp(self.log_factor[columns]).astype(np.float32)


def metric_estimate(
    values: np.ndarray, kind: Kind, uv_px: np.ndarray, z_m: np.ndarray
) -> MetricEstimate | None:
    """The estimate times a factor that varies smoothly over the columns; None if too few beams meet it.

    The spread is measured at each beam with a correction made without its neighbours: what the estimate
    would be worth away from the scan line, seen from what it is worth along it.
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
    """Gaussian kernel means [M], samples nearer than `exclude` left out, drawn to the median of all."""
    distance = np.abs(at[:, None] - u[None])
    weight = np.exp(-0.5 * (distance / band) ** 2) * (distance >= exclude)
    centre = float(np.median(values))
    clipped = np.clip(values, centre - 0.7, centre + 0.7)
    return (weight @ clipped + 0.5 * centre) / (weight.sum(axis=1) + 0.5)
