"""Pairs of beam depth and estimated depth at the same pixel, and clustering of their ratios."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Pairs:
    """Beams with the value of the depth estimate at the pixel of each beam."""

    uv_px: np.ndarray  # float64 [N, 2]
    z_m: np.ndarray  # float64 [N]: optical z of the beam, not its range (l_j of the paper)
    estimate: np.ndarray  # float64 [N]: the dense estimate there (d_j of the paper)

    def __len__(self) -> int:
        return len(self.z_m)

    def take(self, keep: np.ndarray) -> Pairs:
        return Pairs(self.uv_px[keep], self.z_m[keep], self.estimate[keep])


def make_pairs(
    estimate: np.ndarray,  # float32 [H, W], NaN = unknown
    uv_px: np.ndarray,  # float64 [N, 2], inside the image
    z_m: np.ndarray,  # float64 [N]
    max_jump: float = 0.10,
) -> Pairs:
    """Return the pairs of beam depth and estimate, without pixels at depth edges of the estimate.

    A pixel is at an edge if the neighbours 2 px away differ by more than `max_jump` times its value.
    """
    h, w = estimate.shape
    u = np.clip(np.rint(uv_px[:, 0]).astype(int), 0, w - 1)
    v = np.clip(np.rint(uv_px[:, 1]).astype(int), 0, h - 1)
    here = estimate[v, u].astype(np.float64)
    low, high = here.copy(), here.copy()
    for dv, du in ((0, 2), (0, -2), (2, 0), (-2, 0)):
        near = estimate[np.clip(v + dv, 0, h - 1), np.clip(u + du, 0, w - 1)]
        low, high = np.fmin(low, near), np.fmax(high, near)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(here) & (here > 0.0) & (z_m > 0.0) & (high - low <= max_jump * here)
    return Pairs(uv_px[good], z_m[good], here[good])


def largest_cluster(values: np.ndarray, radius: float, least: int = 4) -> np.ndarray:
    """Return bool [N]: members of the largest cluster of the numbers [N] (DBSCAN in one dimension).

    A core value has at least `least` values (itself included) within `radius`; cores closer than `radius`
    form one cluster; values within `radius` of a core belong to its cluster. Without a core value, all are
    False. Complexity O(N log N).
    """
    count = len(values)
    member = np.zeros(count, dtype=bool)
    if count == 0:
        return member
    order = np.argsort(values, kind="stable")
    x = values[order]
    neighbours = np.searchsorted(x, x + radius, "right") - np.searchsorted(x, x - radius, "left")
    cores = np.flatnonzero(neighbours >= least)
    if len(cores) == 0:
        return member
    splits = np.flatnonzero(np.diff(x[cores]) > radius) + 1
    best: tuple[int, int, int] = (0, 0, 0)
    for group in np.split(cores, splits):
        first = int(np.searchsorted(x, x[group[0]] - radius, "left"))
        stop = int(np.searchsorted(x, x[group[-1]] + radius, "right"))
        if stop - first > best[0]:
            best = (stop - first, first, stop)
    member[order[best[1] : best[2]]] = True
    return member


def effective_count(residuals: np.ndarray) -> float:
    """Return the effective sample size of residuals [N] in scan order (first-order autocorrelation).

    Neighbouring beams hit the same surface, where the errors of the network are correlated; hence N beams are
    less than N independent samples.
    """
    count = len(residuals)
    if count < 4:
        return float(count)
    r = residuals - residuals.mean()
    power = float(r @ r)
    if power <= 0.0:
        return float(count)
    rho = min(max(float(r[:-1] @ r[1:]) / power, 0.0), 0.99)
    return max(count * (1.0 - rho) / (1.0 + rho), 1.0)
