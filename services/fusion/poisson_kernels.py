"""Kernels of the Poisson completion: a weighted Laplace equation on a pixel grid, and its error bound.

The equation is (W + L) y = b: W has the weight of the measurement of each pixel, and L is the graph Laplacian
of the conductances between neighbours. Conjugate gradients solve it, preconditioned by one V-cycle of
multigrid with aggregates of 2x2 pixels. Sums of weights and conductances over an aggregate have the same form
again, so each level is such an equation, with a fourth of the unknowns.

All levels lie in flat arrays: level k has `heights[k]` x `widths[k]` pixels with a border of one pixel, row
by row from `starts[k]` on. `right` and `down` are the conductances to the neighbours at the right and below.
They are 0 at and in the border, so that no kernel has to ask where it is.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel

# The correction from aggregates is too small by up to a factor of 2, because it is constant on an aggregate
# (Braess 1995, Computing 55, 379-393).
_OVERCORRECTION = 1.7


@kernel
def build_levels(
    heights: np.ndarray, widths: np.ndarray, starts: np.ndarray,  # int64 [levels]
    weight: np.ndarray, right: np.ndarray, down: np.ndarray,  # float64 [all], 0 beyond level 0
    diagonal: np.ndarray, inverse: np.ndarray,  # float64 [all]: out, 0 where a pixel has no equation
) -> None:  # fmt: skip
    """Write the coarser levels of the equation, and for each level the diagonal of its matrix."""
    for k in range(1, len(heights)):
        stride, start = widths[k - 1] + 2, starts[k - 1]
        for i in range(heights[k - 1]):
            for j in range(widths[k - 1]):
                f = start + (i + 1) * stride + j + 1
                c = starts[k] + (i // 2 + 1) * (widths[k] + 2) + j // 2 + 1
                weight[c] += weight[f]
                if j % 2 == 1:  # to the next aggregate; others are inside one
                    right[c] += right[f]
                if i % 2 == 1:
                    down[c] += down[f]
    for k in range(len(heights)):
        stride = widths[k] + 2
        for i in range(1, heights[k] + 1):
            for p in range(starts[k] + i * stride + 1, starts[k] + i * stride + widths[k] + 1):
                total = weight[p] + right[p] + down[p] + right[p - 1] + down[p - stride]
                diagonal[p] = total
                inverse[p] = 1.0 / total if total > 0.0 else 0.0


@kernel
def v_cycle(
    heights: np.ndarray, widths: np.ndarray, starts: np.ndarray,
    right: np.ndarray, down: np.ndarray, inverse: np.ndarray,
    rhs: np.ndarray, y: np.ndarray,  # float64 [all]: level 0 of `rhs` is given, level 0 of `y` is the result
) -> None:  # fmt: skip
    """Apply one V-cycle: a symmetric approximation of the inverse of the matrix of level 0."""
    last = len(heights) - 1
    for k in range(last + 1):
        h, w, start, stride = heights[k], widths[k], starts[k], widths[k] + 2
        for i in range(1, h + 1):  # forward Gauss-Seidel from 0: later neighbours are still 0
            for p in range(start + i * stride + 1, start + i * stride + w + 1):
                y[p] = (rhs[p] + right[p - 1] * y[p - 1] + down[p - stride] * y[p - stride]) * inverse[p]
        if k == last:
            break
        # What the later neighbours change is the residual; its sums over aggregates are the next right side.
        for i in range(1, heights[k + 1] + 1):
            c = starts[k + 1] + i * (widths[k + 1] + 2) + 1
            for j in range(widths[k + 1]):
                p = start + (2 * i - 1) * stride + 2 * j + 1
                q = p + stride
                rhs[c + j] = right[p] * y[p + 1] + down[p] * y[q] + right[p + 1] * y[p + 2]
                rhs[c + j] += down[p + 1] * y[q + 1] + right[q] * y[q + 1] + right[q + 1] * y[q + 2]
                if 2 * i < h + 1:
                    rhs[c + j] += down[q] * y[q + stride] + down[q + 1] * y[q + 1 + stride]
    for k in range(last, -1, -1):
        h, w, start, stride = heights[k], widths[k], starts[k], widths[k] + 2
        if k < last:
            for i in range(1, h + 1):
                c = starts[k + 1] + ((i + 1) // 2) * (widths[k + 1] + 2) + 1
                p = start + i * stride + 1
                for j in range(w):
                    y[p + j] += _OVERCORRECTION * y[c + j // 2]
        for i in range(h, 0, -1):  # backward, so that the whole cycle is symmetric
            for p in range(start + i * stride + w, start + i * stride, -1):
                near = right[p - 1] * y[p - 1] + right[p] * y[p + 1]
                near += down[p - stride] * y[p - stride] + down[p] * y[p + stride]
                y[p] = (rhs[p] + near) * inverse[p]


@kernel
def _product(
    h: int, w: int, right: np.ndarray, down: np.ndarray, diagonal: np.ndarray, y: np.ndarray, out: np.ndarray
) -> None:
    """Write (W + L) y of level 0."""
    stride = w + 2
    for i in range(1, h + 1):
        for p in range(i * stride + 1, i * stride + w + 1):
            near = right[p - 1] * y[p - 1] + right[p] * y[p + 1]
            near += down[p - stride] * y[p - stride] + down[p] * y[p + stride]
            out[p] = diagonal[p] * y[p] - near


@kernel
def conjugate_gradients(
    heights: np.ndarray, widths: np.ndarray, starts: np.ndarray,
    right: np.ndarray, down: np.ndarray, diagonal: np.ndarray, inverse: np.ndarray,
    b: np.ndarray,  # float64 [(h + 2) (w + 2)], 0 in the border
    tolerance: float, most: int,
    y: np.ndarray,  # float64 [(h + 2) (w + 2)], 0 in the border; in: start; out: solution
) -> int:  # fmt: skip
    """Solve the equation of level 0 until a step changes no y by more than `tolerance`; return the steps."""
    h, w = heights[0], widths[0]
    n = (h + 2) * (w + 2)
    rhs, z = np.zeros(len(right)), np.zeros(len(right))
    residual, direction, image = np.zeros(n), np.zeros(n), np.zeros(n)
    _product(h, w, right, down, diagonal, y, image)
    for p in range(n):
        residual[p] = b[p] - image[p]
    rho_before = 1.0
    for step in range(most):
        rhs[:n] = residual
        v_cycle(heights, widths, starts, right, down, inverse, rhs, z)
        rho = 0.0
        for p in range(n):
            rho += residual[p] * z[p]
        if rho <= 0.0:
            return step
        beta = rho / rho_before if step > 0 else 0.0
        for p in range(n):
            direction[p] = z[p] + beta * direction[p]
        _product(h, w, right, down, diagonal, direction, image)
        curvature = 0.0
        for p in range(n):
            curvature += direction[p] * image[p]
        if curvature <= 0.0:
            return step
        alpha = rho / curvature
        largest = 0.0
        for p in range(n):
            change = alpha * direction[p]
            y[p] += change
            residual[p] -= alpha * image[p]
            largest = max(largest, abs(change))
        if largest <= tolerance:
            return step + 1
        rho_before = rho
    return most


@kernel
def path_variance(
    variance: np.ndarray,  # float64 [h, w]: in: of the own measurement, inf = none; out: the bound
    right: np.ndarray,  # float64 [h, w]: variance of the step to the right neighbour, inf = none
    down: np.ndarray,  # float64 [h, w]: of the step to the neighbour below
    most: int,
) -> int:
    """Replace each variance by the least sum of a measurement's and of the steps from it; return the sweeps.

    The variances are the resistances of an electric network. The variance of y, given all measurements, is
    the effective resistance between the pixel and their common pole. It is at most that of any single path
    (Rayleigh's monotonicity; Doyle and Snell 1984).
    """
    h, w = variance.shape
    for sweep in range(most):
        changed = False
        for i in range(h):
            for j in range(w):
                least = variance[i, j]
                if j > 0:
                    least = min(least, variance[i, j - 1] + right[i, j - 1])
                if i > 0:
                    least = min(least, variance[i - 1, j] + down[i - 1, j])
                if least < variance[i, j]:
                    variance[i, j], changed = least, True
        for i in range(h - 1, -1, -1):
            for j in range(w - 1, -1, -1):
                least = variance[i, j]
                if j < w - 1:
                    least = min(least, variance[i, j + 1] + right[i, j])
                if i < h - 1:
                    least = min(least, variance[i + 1, j] + down[i, j])
                if least < variance[i, j]:
                    variance[i, j], changed = least, True
        if not changed:
            return sweep + 1
    return most
