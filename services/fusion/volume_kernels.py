"""Numba kernels of the plane sweep: matching cost volume, priors, semi-global aggregation.

`volume_reference.py` has plain Python versions for the tests. Arrays are float32 unless stated; `h, w` is the
working size and `D` the number of depth labels, evenly spaced in log depth.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel

_BEST = 4  # lowest costs kept per label; the mean of the two lowest is used (robust to occlusion)


@kernel
def cost_volume(
    reference: np.ndarray,  # [h, w, 3] features of the image
    sources: np.ndarray,  # [S, h, w, 3] features of the other images
    R: np.ndarray,  # [S, 3, 3] rotation, image to source
    t: np.ndarray,  # [S, 3] translation, image to source
    K: np.ndarray,  # [4] fx, fy, cx, cy at this size
    z: np.ndarray,  # [D] label depths, increasing
    z_last: np.ndarray,  # [h, w] labels beyond this depth are impossible (below the floor)
    truncation: float,
    out: np.ndarray,  # [h, w, D]
) -> None:
    """Write, for each pixel and label, the mean absolute feature difference in the two best-matching views.

    A label outside all views gets the mean of the pixel's lowest and average cost. A pixel with
    less than 40 % of its labels inside the views gets a constant cost.
    """
    one = np.float32(1.0)
    cut = np.float32(truncation)
    S, h, w, D = sources.shape[0], reference.shape[0], reference.shape[1], z.shape[0]
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    best = np.empty((D, _BEST), np.float32)
    count = np.empty(D, np.int32)
    x_max, y_max = np.float32(w - 1.001), np.float32(h - 1.001)
    for v in range(h):
        for u in range(w):
            rx, ry = (np.float32(u) - cx) / fx, (np.float32(v) - cy) / fy
            g0, g1, g2 = reference[v, u, 0], reference[v, u, 1], reference[v, u, 2]
            last = 0
            while last < D and z[last] <= z_last[v, u]:
                last += 1
            for d in range(last):
                count[d] = 0
            for s in range(S):
                az = R[s, 2, 0] * rx + R[s, 2, 1] * ry + R[s, 2, 2]
                ax = fx * (R[s, 0, 0] * rx + R[s, 0, 1] * ry + R[s, 0, 2]) + cx * az
                ay = fy * (R[s, 1, 0] * rx + R[s, 1, 1] * ry + R[s, 1, 2]) + cy * az
                tz = t[s, 2]
                tx, ty = fx * t[s, 0] + cx * tz, fy * t[s, 1] + cy * tz
                for d in range(last):
                    depth = az * z[d] + tz
                    if depth < np.float32(0.05):
                        continue
                    inv = one / depth
                    x, y = (ax * z[d] + tx) * inv, (ay * z[d] + ty) * inv
                    if x < 0 or y < 0 or x > x_max or y > y_max:
                        continue
                    i, j = int(y), int(x)
                    b, a = y - np.float32(i), x - np.float32(j)
                    w11 = a * b
                    w01, w10 = a - w11, b - w11
                    w00 = one - a - w10
                    p, q = sources[s, i, j], sources[s, i, j + 1]
                    m, n = sources[s, i + 1, j], sources[s, i + 1, j + 1]
                    cost = abs(g0 - (p[0] * w00 + q[0] * w01 + m[0] * w10 + n[0] * w11))
                    cost += abs(g1 - (p[1] * w00 + q[1] * w01 + m[1] * w10 + n[1] * w11))
                    cost += abs(g2 - (p[2] * w00 + q[2] * w01 + m[2] * w10 + n[2] * w11))
                    cost = min(cost, cut)
                    k = count[d]
                    if k < _BEST:
                        count[d] = k + 1
                    else:
                        if cost >= best[d, _BEST - 1]:
                            continue
                        k = _BEST - 1
                    while k > 0 and best[d, k - 1] > cost:
                        best[d, k] = best[d, k - 1]
                        k -= 1
                    best[d, k] = cost
            _combine_views(best, count, last, cut, out[v, u])


@kernel
def _combine_views(best: np.ndarray, count: np.ndarray, last: int, cut: np.float32, out: np.ndarray) -> None:
    D = out.shape[0]
    lowest, total, seen = cut, np.float32(0.0), 0
    for d in range(last):
        if count[d] > 0:
            seen += 1
            total += best[d, 0]
            lowest = min(lowest, best[d, 0])
    if seen * 10 < last * 4:
        for d in range(last):
            out[d] = np.float32(0.5) * cut
    else:
        neutral = np.float32(0.5) * (lowest + total / np.float32(seen))
        for d in range(last):
            if count[d] == 0:
                out[d] = neutral
            elif count[d] == 1:
                out[d] = best[d, 0]
            else:
                out[d] = np.float32(0.5) * (best[d, 0] + best[d, 1])
    for d in range(last, D):
        out[d] = cut


@kernel
def box3(volume: np.ndarray, scale: float, out: np.ndarray) -> None:
    """Write the mean cost over 3 x 3 pixels (border repeated) for each label, multiplied by `scale`."""
    h, w, D = volume.shape
    gain = np.float32(scale / 9.0)
    row = np.empty((w, D), np.float32)
    for v in range(h):
        above, below = max(v - 1, 0), min(v + 1, h - 1)
        for u in range(w):
            for d in range(D):
                row[u, d] = volume[above, u, d] + volume[v, u, d] + volume[below, u, d]
        for u in range(w):
            left, right = max(u - 1, 0), min(u + 1, w - 1)
            for d in range(D):
                out[v, u, d] = gain * (row[left, d] + row[u, d] + row[right, d])


@kernel
def add_prior(
    volume: np.ndarray,  # [h, w, D], changed in place
    z: np.ndarray,  # [h, w] depth of the surface expected, NaN = none
    weight: np.ndarray,  # [h, w] depth of the Gaussian well
    log_z0: float,
    log_step: float,
    width: float,  # standard deviation of the well, in labels
) -> None:
    """Lower the cost near the depth of a candidate surface, in place, by a Gaussian of height `weight`.

    The Gaussian has the standard deviation `width`, in labels; NaN depth = no prior at this pixel.
    """
    h, w, D = volume.shape
    for v in range(h):
        for u in range(w):
            if not (z[v, u] > 0.0 and weight[v, u] > 0.0):
                continue
            centre = (np.log(z[v, u]) - log_z0) / log_step
            first = max(int(np.ceil(centre - 2.5 * width)), 0)
            stop = min(int(np.floor(centre + 2.5 * width)), D - 1) + 1
            for d in range(first, stop):
                e = (d - centre) / width
                volume[v, u, d] -= np.float32(weight[v, u] * np.exp(-0.5 * e * e))


@kernel
def aggregate(
    cost: np.ndarray,  # [h, w, D]
    guide: np.ndarray,  # [h, w] grey values
    dv: int,
    du: int,
    p1: float,  # penalty for one label up or down
    p2: float,  # penalty for a larger jump without a grey edge
    edge_grey: float,  # grey step at which p2 is halved
    total: np.ndarray,  # [h, w, D], added to
) -> None:
    """Add the path costs of one image direction to `total` (Hirschmueller 2008, eq. 13).

    The penalty `p2` of a depth jump is lower where the grey value changes.
    """
    h, w, D = cost.shape
    before, now = np.empty(D, np.float32), np.empty(D, np.float32)
    one_step, jump = np.float32(p1), np.float32(p2)
    lines = h if du != 0 else w
    for line in range(lines):
        v = line if du != 0 else (0 if dv > 0 else h - 1)
        u = line if du == 0 else (0 if du > 0 else w - 1)
        for d in range(D):
            before[d] = cost[v, u, d]
            total[v, u, d] += before[d]
        v, u = v + dv, u + du
        while 0 <= v < h and 0 <= u < w:
            lowest = before[0]
            for d in range(1, D):
                lowest = min(lowest, before[d])
            step = abs(guide[v, u] - guide[v - dv, u - du])
            limit = lowest + max(jump / (np.float32(1.0) + step / np.float32(edge_grey)), one_step * 1.5)
            for d in range(D):
                b = min(before[d], np.float32(limit))
                if d > 0:
                    b = min(b, before[d - 1] + one_step)
                if d < D - 1:
                    b = min(b, before[d + 1] + one_step)
                now[d] = cost[v, u, d] + b - lowest
            for d in range(D):
                total[v, u, d] += now[d]
                before[d] = now[d]
            v, u = v + dv, u + du


@kernel
def winner_takes_all(
    total: np.ndarray,  # [h, w, D]
    log_z: np.ndarray,  # [D] float64
    temperature: float,
    depth: np.ndarray,  # [h, w] out: depth of the cheapest label, between labels by a parabola
    spread: np.ndarray,  # [h, w] out: standard deviation of log depth about it
) -> None:
    """Write the depth of the label with the lowest cost, and the spread of the labels about this depth.

    The spread is the standard deviation of log depth under the distribution exp(-cost / temperature).
    """
    h, w, D = total.shape
    step = log_z[1] - log_z[0]
    for v in range(h):
        for u in range(w):
            row = total[v, u]
            b = 0
            for d in range(1, D):
                if row[d] < row[b]:
                    b = d
            centre = log_z[b]
            if 0 < b < D - 1:
                bend = row[b - 1] + row[b + 1] - 2.0 * row[b]
                if bend > 1e-9:
                    centre += 0.5 * (row[b - 1] - row[b + 1]) / bend * step
            depth[v, u] = np.exp(centre)
            mass, second = 0.0, 0.0
            for d in range(D):
                e = (row[d] - row[b]) / temperature
                if e < 12.0:
                    p = np.exp(-e)
                    mass += p
                    second += p * (log_z[d] - centre) ** 2
            spread[v, u] = np.sqrt(second / mass)


@kernel
def plane_gain(
    volume: np.ndarray,  # [h, w, D]
    rise: np.ndarray,  # [h, w]: upward part of the rays (z_camera = 1) in the body frame
    wall: np.ndarray,  # [h, w] depth of the vertical surface behind it, NaN = none
    camera_z_m: float,
    log_z0: float,
    log_step: float,
    heights_m: np.ndarray,  # [n]
    gain: np.ndarray,  # [n] out
) -> None:
    """Write, for each height, the summed cost of the walls minus that of a horizontal plane before them.

    A large positive value is evidence for a ceiling at this height.
    """
    h, w, D = volume.shape
    for k in range(heights_m.shape[0]):
        total = 0.0
        for v in range(h):
            for u in range(w):
                if rise[v, u] < 0.02 or not wall[v, u] > 0.0:
                    continue
                z = (heights_m[k] - camera_z_m) / rise[v, u]
                if not (0.0 < z < wall[v, u] * 0.93):
                    continue
                place = (np.log(z) - log_z0) / log_step
                i = int(np.floor(place))
                j = int(np.rint((np.log(wall[v, u]) - log_z0) / log_step))
                if i < 0 or i >= D - 1 or j < 1 or j >= D - 1:
                    continue
                # The wall gets the best of three labels, the plane exactly its own. Otherwise a plane that
                # is a little too low would gain as much as the right one.
                on_plane = volume[v, u, i] + (place - i) * (volume[v, u, i + 1] - volume[v, u, i])
                on_wall = min(volume[v, u, j], volume[v, u, j - 1], volume[v, u, j + 1])
                total += on_wall - on_plane
        gain[k] = total
