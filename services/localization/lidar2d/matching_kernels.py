"""Kernels of scan-to-map matching: association of returns with surfaces, and robust Gauss-Newton."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.cholesky import solve

# Variance of a return along its tangent: it may belong to any nearby part of the surface.
TANGENT_VARIANCE_M2 = 0.3**2
# Cosine between the viewing directions of return and surface, times the consistency of the latter.
MIN_VIEW_COSINE = -0.3


@kernel
def associate(
    x: float,
    y: float,
    tx: float,  # tangent in the target frame, (0, 0) if unknown
    ty: float,
    half_spacing_m: float,
    ox: float,  # position of the lidar
    oy: float,
    nearest: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    views: np.ndarray,
    row0: int,
    col0: int,
    inv_cell: float,
) -> tuple[bool, float, float, float, float, float]:
    """Find the surface of a return at (x, y) in the target frame.

    A return constrains the pose only across its own surface. Along its tangent (or, if that is unknown,
    within its spacing) its position is uncertain: S = s^2 t t^T or s^2 I, and Omega' = (Omega^-1 + S)^-1.
    Without S, a corridor would seem to constrain the motion along it. A surface that was observed from its
    other side is ignored, because walls are thin.

    Returns (found, difference x, y to the mean of the surface, Omega' xx, xy, yy).
    """
    r, q = math.floor(y * inv_cell) - row0, math.floor(x * inv_cell) - col0
    if r < 0 or q < 0 or r >= nearest.shape[0] or q >= nearest.shape[1]:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    k = nearest[r, q]
    if k < 0:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    vx, vy = ox - x, oy - y
    if vx * views[k, 0] + vy * views[k, 1] < MIN_VIEW_COSINE * math.sqrt(vx * vx + vy * vy):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    a, b, d = omegas[k, 0], omegas[k, 1], omegas[k, 2]
    if tx != 0.0 or ty != 0.0:
        ux, uy = a * tx + b * ty, b * tx + d * ty
        f = TANGENT_VARIANCE_M2 / (1.0 + TANGENT_VARIANCE_M2 * (tx * ux + ty * uy))
        a, b, d = a - f * ux * ux, b - f * ux * uy, d - f * uy * uy
    else:
        s2 = half_spacing_m * half_spacing_m
        det = a * d - b * b
        f = 1.0 / (1.0 + s2 * (a + d) + s2 * s2 * det)
        a, b, d = f * (a + s2 * det), f * b, f * (d + s2 * det)
    return True, x - means[k, 0], y - means[k, 1], a, b, d


@kernel
def accumulate(
    points: np.ndarray,  # float64 [K, 5] body frame: x, y, tangent x, tangent y, half spacing
    times_s: np.ndarray,  # float64 [K] after the stamp; not read if H is [3, 3]
    origin: np.ndarray,  # float64 [2] lidar in the body frame
    pose: np.ndarray,  # float64 [3] pose_target_body
    twist: np.ndarray,  # float64 [3] in the axes of the target, added to that of the deskewing
    nearest: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    views: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
    scale2: float,  # squared outlier scale, in units of the surface's standard deviation
    H: np.ndarray,  # out float64 [N, N], N = 3: pose, N = 6: pose and twist
    g: np.ndarray,  # out float64 [N]
) -> tuple[float, float, float]:
    """Compute the normal equations of sum rho(d^T Omega d), d = pose * p - mean, with Geman-McClure weights.

    With a twist, the return measured t seconds after the stamp is moved by t * twist, to first order.

    Returns (sum of weights, number of associated returns, weighted sum of d^T Omega d).
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    ox, oy = pose[0] + c * origin[0] - s * origin[1], pose[1] + s * origin[0] + c * origin[1]
    H[:] = 0.0
    g[:] = 0.0
    weights = found = cost = 0.0
    inv = 1.0 / cell_m
    swept = H.shape[0] == 6
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        rx, ry = c * px - s * py, s * px + c * py
        x, y = pose[0] + rx, pose[1] + ry
        if swept:
            t = times_s[i]
            x += t * (twist[0] - twist[2] * ry)
            y += t * (twist[1] + twist[2] * rx)
        tx, ty = c * points[i, 2] - s * points[i, 3], s * points[i, 2] + c * points[i, 3]
        hit, dx, dy, a, b, d = associate(
            x, y, tx, ty, points[i, 4], ox, oy, nearest, means, omegas, views, row0, col0, inv
        )
        if not hit:
            continue
        found += 1.0
        ux, uy = a * dx + b * dy, b * dx + d * dy
        e2 = dx * ux + dy * uy
        root = scale2 / (scale2 + e2)
        w = root * root
        weights += w
        cost += w * e2
        # Jacobian of pose * p: [I, (-ry, rx)]; that of the twist is t times as large.
        jx, jy = a * -ry + b * rx, b * -ry + d * rx
        h00, h01, h11 = w * a, w * b, w * d
        h02, h12, h22 = w * jx, w * jy, w * (-ry * jx + rx * jy)
        g0, g1, g2 = w * ux, w * uy, w * (-ry * ux + rx * uy)
        H[0, 0] += h00
        H[0, 1] += h01
        H[1, 1] += h11
        H[0, 2] += h02
        H[1, 2] += h12
        H[2, 2] += h22
        g[0] += g0
        g[1] += g1
        g[2] += g2
        if swept:
            H[0, 3] += t * h00
            H[0, 4] += t * h01
            H[1, 4] += t * h11
            H[0, 5] += t * h02
            H[1, 5] += t * h12
            H[2, 5] += t * h22
            t2 = t * t
            H[3, 3] += t2 * h00
            H[3, 4] += t2 * h01
            H[4, 4] += t2 * h11
            H[3, 5] += t2 * h02
            H[4, 5] += t2 * h12
            H[5, 5] += t2 * h22
            g[3] += t * g0
            g[4] += t * g1
            g[5] += t * g2
    if swept:
        H[1, 3], H[2, 3], H[2, 4] = H[0, 4], H[0, 5], H[1, 5]
    for i in range(H.shape[0]):
        for j in range(i):
            H[i, j] = H[j, i]
    return weights, found, cost


@kernel
def gauss_newton(
    points: np.ndarray,
    times_s: np.ndarray,
    origin: np.ndarray,
    start_pose: np.ndarray,
    nearest: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    views: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
    prior_pose: np.ndarray,  # float64 [3]
    prior_information: np.ndarray,  # float64 [3, 3], zeros = no prior
    prior_twist: np.ndarray,  # float64 [3] in the axes of the target
    twist_information: np.ndarray,  # float64 [3], diagonal; empty: the twist is not estimated
    outlier: float,  # units of the surface's standard deviation
    returns_per_measurement: float,  # number of returns per independent measurement
    anneal: np.ndarray,  # float64 [A]
    iterations: int,
    pose: np.ndarray,  # out float64 [3]
    twist: np.ndarray,  # out float64 [3] in the axes of the target
    information: np.ndarray,  # out float64 [3, 3] of the pose, by the scan alone, twist marginalised
) -> tuple[float, float, float]:
    """Optimise the pose of a scan by iteratively reweighted Gauss-Newton with a robust prior on the pose.

    The twist during the scan is estimated together with the pose (continuous-time matching, Dellenbach et
    al. 2022), because otherwise an acceleration distorts the scan: 1 rad/s^2 acts like a yaw error of 4 mrad
    at 10 Hz. Damping limits the steps in unobservable directions.

    Returns (sum of weights, number of associated returns, weighted cost) at the final pose.
    """
    n = 3 + twist_information.shape[0]
    H, A = np.empty((n, n)), np.empty((n, n))
    g, b, step, e = np.empty(n), np.empty(n), np.empty(n), np.empty(3)
    pose[:] = start_pose
    twist[:] = prior_twist
    weights = found = cost = 0.0
    for it in range(iterations):
        scale = outlier * (anneal[it] if it < anneal.shape[0] else 1.0)
        weights, found, cost = accumulate(
            points, times_s, origin, pose, twist, nearest, means, omegas, views, row0, col0, cell_m,
            scale * scale, H, g,
        )  # fmt: skip
        e[0], e[1], e[2] = pose[0] - prior_pose[0], pose[1] - prior_pose[1], se2.wrap(pose[2] - prior_pose[2])
        m2 = 0.0
        for i in range(3):
            for j in range(3):
                m2 += e[i] * prior_information[i, j] * e[j]
        w = 1.0 / (1.0 + m2 / 9.0)  # Cauchy weight: 0.5 at three sigma
        for i in range(n):
            b[i] = -g[i] / returns_per_measurement
            for j in range(n):
                A[i, j] = H[i, j] / returns_per_measurement
        for i in range(3):
            for j in range(3):
                A[i, j] += w * prior_information[i, j]
                b[i] -= w * prior_information[i, j] * e[j]
        for i in range(n - 3):
            A[3 + i, 3 + i] += twist_information[i]
            b[3 + i] -= twist_information[i] * (twist[i] - prior_twist[i])
        # Damping of (1 m)^-2 and (0.3 rad)^-2; it matters only in unobservable directions.
        A[0, 0] += 1.0
        A[1, 1] += 1.0
        A[2, 2] += 10.0
        if not solve(A, b, step):
            break
        pose[0] += step[0]
        pose[1] += step[1]
        pose[2] = se2.wrap(pose[2] + step[2])
        for i in range(n - 3):
            twist[i] += step[3 + i]
        if it >= anneal.shape[0] and step[0] ** 2 + step[1] ** 2 < 1e-8 and abs(step[2]) < 2e-5:
            break
    weights, found, cost = accumulate(
        points, times_s, origin, pose, twist, nearest, means, omegas, views, row0, col0, cell_m,
        outlier * outlier, H, g,
    )  # fmt: skip
    H /= returns_per_measurement
    _marginalise_twist(H, twist_information, information)
    return weights, found, cost


@kernel
def _marginalise_twist(H: np.ndarray, twist_information: np.ndarray, out: np.ndarray) -> None:
    """Write the information [3, 3] of the pose to `out`: the Schur complement of the twist in H."""
    for i in range(3):
        for j in range(3):
            out[i, j] = H[i, j]
    if H.shape[0] == 3:
        return
    A, x, column = np.empty((3, 3)), np.empty(3), np.empty(3)
    for j in range(3):
        for i in range(3):
            column[i] = H[3 + i, j]
            for k in range(3):
                A[i, k] = H[3 + i, 3 + k]
            A[i, i] += twist_information[i]
        if not solve(A, column, x):
            return
        for i in range(3):
            for k in range(3):
                out[i, j] -= H[i, 3 + k] * x[k]


@kernel
def count_overlapping_returns(
    points: np.ndarray,
    pose: np.ndarray,
    nearest: np.ndarray,
    misses: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
) -> int:
    """Return the number of returns in observed space: near a surface, or in a cell that a beam crossed."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = 0
    for i in range(points.shape[0]):
        x, y = pose[0] + c * points[i, 0] - s * points[i, 1], pose[1] + s * points[i, 0] + c * points[i, 1]
        r, q = math.floor(y / cell_m) - row0, math.floor(x / cell_m) - col0
        inside = 0 <= r < nearest.shape[0] and 0 <= q < nearest.shape[1]
        if inside and (nearest[r, q] >= 0 or misses[r, q] > 0):
            n += 1
    return n
