"""Plain Python versions of the kernels in `volume_kernels.py`, as the reference of their tests."""

from __future__ import annotations

import numpy as np


def sample(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Return the bilinear interpolation [C] of an image [h, w, C] at pixel (x, y)."""
    j, i = int(x), int(y)
    a, b = x - j, y - i
    top = (1 - a) * image[i, j] + a * image[i, j + 1]
    return (1 - b) * top + b * ((1 - a) * image[i + 1, j] + a * image[i + 1, j + 1])


def cost_volume(
    reference: np.ndarray, sources: np.ndarray, R: np.ndarray, t: np.ndarray, K: np.ndarray,
    z: np.ndarray, z_last: np.ndarray, truncation: float,
) -> np.ndarray:  # fmt: skip
    """Return the matching cost float64 [h, w, D]; arguments as in the kernel."""
    fx, fy, cx, cy = K
    h, w, _ = reference.shape
    out = np.full((h, w, len(z)), truncation, dtype=np.float64)
    for v in range(h):
        for u in range(w):
            ray = np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
            labels = [d for d in range(len(z)) if z[d] <= z_last[v, u]]
            costs: dict[int, list[float]] = {}
            for d in labels:
                for s in range(len(sources)):
                    X, Y, Z = R[s] @ ray * z[d] + t[s]
                    if Z < 0.05:
                        continue
                    x, y = fx * X / Z + cx, fy * Y / Z + cy
                    if 0 <= x <= w - 1.001 and 0 <= y <= h - 1.001:
                        error = float(np.abs(reference[v, u] - sample(sources[s], x, y)).sum())
                        costs.setdefault(d, []).append(min(error, truncation))
            if len(costs) * 10 < len(labels) * 4:
                out[v, u] = 0.5 * truncation
                out[v, u, len(labels) :] = truncation
                continue
            best = {d: sorted(c) for d, c in costs.items()}
            first = [c[0] for c in best.values()]
            neutral = 0.5 * (min([*first, truncation]) + sum(first) / len(first))
            for d in labels:
                out[v, u, d] = np.mean(best[d][:2]) if d in best else neutral
    return out


def box3(volume: np.ndarray, scale: float) -> np.ndarray:
    """Return the mean over 3 x 3 pixels with edges repeated, times `scale`."""
    padded = np.pad(volume, ((1, 1), (1, 1), (0, 0)), mode="edge")
    h, w, _ = volume.shape
    total = np.zeros_like(padded[:h, :w])
    for i in range(3):
        for j in range(3):
            total = total + padded[i : i + h, j : j + w]
    return scale * total / 9.0


def aggregate(
    cost: np.ndarray, guide: np.ndarray, dv: int, du: int, p1: float, p2: float, edge_grey: float
) -> np.ndarray:
    """Return the path costs float64 [h, w, D] of one direction (Hirschmueller 2008, eq. 13)."""
    h, w, D = cost.shape
    out = cost.astype(np.float64).copy()
    rows = range(h) if dv >= 0 else range(h - 1, -1, -1)
    columns = range(w) if du >= 0 else range(w - 1, -1, -1)
    for v in rows:
        for u in columns:
            if not (0 <= v - dv < h and 0 <= u - du < w):
                continue
            before = out[v - dv, u - du]
            step = abs(float(guide[v, u]) - float(guide[v - dv, u - du]))
            limit = before.min() + max(p2 / (1.0 + step / edge_grey), 1.5 * p1)
            up = np.concatenate([[np.inf], before[:-1]]) + p1
            down = np.concatenate([before[1:], [np.inf]]) + p1
            out[v, u] = cost[v, u] + np.minimum.reduce([before, up, down, np.full(D, limit)]) - before.min()
    return out
