"""Numba kernels of the learned aggregation: quantised costs, network input, depth from the network output.

The tests compare them with plain NumPy and with the network of the training in PyTorch. `h, w` is the working
size, `D` the number of depth labels, `K` the number of candidate surfaces.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel

COST_STEP = 8.0 / 255.0  # cost per unit of a quantised matching cost
ENERGY_STEP = 12.75 / 255.0  # -log probability per unit of a quantised energy
_REACH = 2  # labels on each side of the median whose probabilities refine the depth


@kernel
def quantised_cost(volume: np.ndarray) -> np.ndarray:
    """Return the matching costs [h, w, D] in units of `COST_STEP`, rounded, uint8; 255 = 8 or more."""
    out = np.empty(volume.shape, np.uint8)
    h, w, D = volume.shape
    for v in range(h):
        for u in range(w):
            for d in range(D):
                value = volume[v, u, d] * np.float32(1.0 / COST_STEP) + np.float32(0.5)
                out[v, u, d] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))
    return out


@kernel
def quantised_energy(total: np.ndarray, temperature: float) -> np.ndarray:
    """Return the energies of the labels in units of `ENERGY_STEP`, rounded, uint8 [h, w, D].

    Energy is (cost - lowest cost of the pixel) / temperature: -log of the unnormalised probability. 255 is an
    energy of 12.75 or more.
    """
    out = np.empty(total.shape, np.uint8)
    h, w, D = total.shape
    gain = np.float32(1.0 / (temperature * ENERGY_STEP))
    for v in range(h):
        for u in range(w):
            lowest = total[v, u, 0]
            for d in range(1, D):
                lowest = min(lowest, total[v, u, d])
            for d in range(D):
                value = (total[v, u, d] - lowest) * gain + np.float32(0.5)
                out[v, u, d] = np.uint8(min(value, np.float32(255.0)))
    return out


@kernel
def fill_features(
    cost: np.ndarray,  # uint8 [h, w, D] quantised matching cost
    energy: np.ndarray,  # uint8 [h, w, D] quantised energy of semi-global matching
    place: np.ndarray,  # float32 [K, h, w]: label (with fraction) of each candidate surface, NaN = none
    scalars: np.ndarray,  # float32 [S, h, w]
    out: np.ndarray,  # float32 [2 D + 3 K + S, H, W], H >= h, W >= w
) -> None:
    """Write the network input, one channel after another.

    The channels: matching cost in [-1, 1], 4th root of the label probabilities by semi-global matching, then
    position, existence and matching cost of each candidate surface (0 where there is none), and `scalars`.
    """
    h, w, D = cost.shape
    K, S = place.shape[0], scalars.shape[0]
    of_cost, of_energy = np.empty(256, np.float32), np.empty(256, np.float32)
    for i in range(256):
        of_cost[i] = 0.25 * COST_STEP * i - 1.0
        of_energy[i] = np.exp(-0.25 * ENERGY_STEP * i)
    per_label = np.float32(2.0 / D)
    for v in range(h):
        for d in range(D):
            for u in range(w):
                out[d, v, u] = of_cost[cost[v, u, d]]
                out[D + d, v, u] = of_energy[energy[v, u, d]]
        for k in range(K):
            for u in range(w):
                at = place[k, v, u]
                position, exists, matched = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                if np.isfinite(at):
                    i = min(int(at), D - 2)
                    a = at - np.float32(i)
                    first, second = of_cost[cost[v, u, i]], of_cost[cost[v, u, i + 1]]
                    position, exists = at * per_label - np.float32(1.0), np.float32(1.0)
                    matched = first + a * (second - first)
                out[2 * D + k, v, u] = position
                out[2 * D + K + k, v, u] = exists
                out[2 * D + 2 * K + k, v, u] = matched
        for s in range(S):
            for u in range(w):
                out[2 * D + 3 * K + s, v, u] = scalars[s, v, u]


@kernel
def decode_depth(
    output: np.ndarray,  # float32 [D + K + 2, H, W]: residuals, gates of candidates, gains of energy, cost
    cost: np.ndarray,  # uint8 [h, w, D]
    energy: np.ndarray,  # uint8 [h, w, D]
    place: np.ndarray,  # float32 [K, h, w], NaN = none
    log_z0: float,
    log_step: float,
    depth: np.ndarray,  # float32 [h, w] out, m
    spread: np.ndarray,  # float32 [h, w] out: standard deviation of log depth
) -> None:
    """Write depth and spread of the label distribution that the network output defines.

    logit = residual - gain * energy - gain * cost, plus the gate of each candidate at its two nearest labels.
    The depth is the median label, refined by the mean over the probabilities near it.
    """
    h, w, D = cost.shape
    K = place.shape[0]
    rows = np.empty((w, D), np.float32)
    energy_step, cost_step = np.float32(ENERGY_STEP), np.float32(COST_STEP)
    for v in range(h):
        for d in range(D):
            for u in range(w):
                rows[u, d] = output[d, v, u]
        for u in range(w):
            row = rows[u]
            of_energy, of_cost = output[D + K, v, u] * energy_step, output[D + K + 1, v, u] * cost_step
            for d in range(D):
                row[d] -= of_energy * np.float32(energy[v, u, d]) + of_cost * np.float32(cost[v, u, d])
            for k in range(K):
                at = place[k, v, u]
                if np.isfinite(at):
                    i = min(int(at), D - 2)
                    a = at - np.float32(i)
                    gate = output[D + k, v, u]
                    row[i] += gate * (np.float32(1.0) - a)
                    row[i + 1] += gate * a
            depth[v, u], spread[v, u] = _decode_pixel(row, log_z0, log_step)


@kernel
def _decode_pixel(row: np.ndarray, log_z0: float, log_step: float) -> tuple[np.float32, np.float32]:
    """Return depth and spread of the logits [D]; `row` becomes the unnormalised probabilities."""
    D = row.shape[0]
    highest = row[0]
    for d in range(1, D):
        highest = max(highest, row[d])
    total = 0.0
    for d in range(D):
        row[d] = np.exp(row[d] - highest)
        total += row[d]
    below, median = 0.0, 0
    while median < D - 1 and below + row[median] < 0.5 * total:
        below += row[median]
        median += 1
    mass, first = 0.0, 0.0
    for d in range(max(median - _REACH, 0), min(median + _REACH, D - 1) + 1):
        mass += row[d]
        first += row[d] * d
    centre = first / mass
    second = 0.0
    for d in range(D):
        second += row[d] * (d - centre) ** 2
    return np.float32(np.exp(log_z0 + centre * log_step)), np.float32(np.sqrt(second / total) * log_step)
