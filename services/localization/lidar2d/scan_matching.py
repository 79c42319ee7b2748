"""Scan-to-map matching: robust Gauss-Newton on surface elements from a given start pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import MatchTables

# Variance of a return along its tangent: it may belong to any nearby part of the surface.
TANGENT_VARIANCE_M2 = 0.3**2
# Cosine between the viewing directions of return and surface, times the consistency of the latter.
MIN_VIEW_COSINE = -0.3
ANNEAL_SCALES = (3.0, 2.0, 1.4)  # factors on the outlier scale in the first iterations; then 1


@dataclass(frozen=True)
class Match:
    """Pose of a scan in a map, with its information and quality.

    The target frame is the frame of the map: a submap or the global map.
    """

    pose_target_body: np.ndarray  # float64 [3]
    information: np.ndarray  # float64 [3, 3] of the scan alone; axes of the target frame, yaw about the body
    inlier_ratio: float  # returns on surfaces / returns in observed space
    overlap: float  # returns in observed space / all returns
    residual_m: float  # robust RMS distance to the surfaces
    full_information: np.ndarray | None = None  # before a reduction by observability.reduce_unobservable()


@kernel
def accumulate(
    points: np.ndarray,  # float64 [K, 5] body frame: x, y, tangent x, tangent y, half spacing
    origin: np.ndarray,  # float64 [2] lidar in the body frame
    pose: np.ndarray,  # float64 [3] pose_target_body
    nearest: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    views: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
    scale2: float,  # squared outlier scale, in units of the surface's standard deviation
    H: np.ndarray,  # out float64 [3, 3]
    g: np.ndarray,  # out float64 [3]
) -> tuple[float, float, float]:
    """Compute the normal equations of sum rho(d^T Omega d), d = pose * p - mean, with Geman-McClure weights.

    A return constrains the pose only across its own surface. Along its tangent (or, if that is unknown,
    within its spacing) its position is uncertain: S = s^2 t t^T or s^2 I, and Omega' = (Omega^-1 + S)^-1.
    Without S, a corridor would seem to constrain the motion along it. A surface that was observed from its
    other side is ignored, because walls are thin.

    Returns (sum of weights, number of associated returns, weighted sum of d^T Omega d).
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    ox, oy = pose[0] + c * origin[0] - s * origin[1], pose[1] + s * origin[0] + c * origin[1]
    H[:] = 0.0
    g[:] = 0.0
    weights = found = cost = 0.0
    inv = 1.0 / cell_m
    rows, cols = nearest.shape
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        rx, ry = c * px - s * py, s * px + c * py
        x, y = pose[0] + rx, pose[1] + ry
        r, q = math.floor(y * inv) - row0, math.floor(x * inv) - col0
        if r < 0 or q < 0 or r >= rows or q >= cols:
            continue
        k = nearest[r, q]
        if k < 0:
            continue
        vx, vy = ox - x, oy - y
        if vx * views[k, 0] + vy * views[k, 1] < MIN_VIEW_COSINE * math.sqrt(vx * vx + vy * vy):
            continue
        found += 1.0
        dx, dy = x - means[k, 0], y - means[k, 1]
        a, b, d = omegas[k, 0], omegas[k, 1], omegas[k, 2]
        if points[i, 2] != 0.0 or points[i, 3] != 0.0:
            tx, ty = c * points[i, 2] - s * points[i, 3], s * points[i, 2] + c * points[i, 3]
            vx, vy = a * tx + b * ty, b * tx + d * ty
            f = TANGENT_VARIANCE_M2 / (1.0 + TANGENT_VARIANCE_M2 * (tx * vx + ty * vy))
            a, b, d = a - f * vx * vx, b - f * vx * vy, d - f * vy * vy
        else:
            s2 = points[i, 4] * points[i, 4]
            det = a * d - b * b
            f = 1.0 / (1.0 + s2 * (a + d) + s2 * s2 * det)
            a, b, d = f * (a + s2 * det), f * b, f * (d + s2 * det)
        ux, uy = a * dx + b * dy, b * dx + d * dy
        e2 = dx * ux + dy * uy
        root = scale2 / (scale2 + e2)
        w = root * root
        weights += w
        cost += w * e2
        # Jacobian of pose * p: [I, (-ry, rx)]
        jx, jy = a * -ry + b * rx, b * -ry + d * rx
        H[0, 0] += w * a
        H[0, 1] += w * b
        H[1, 1] += w * d
        H[0, 2] += w * jx
        H[1, 2] += w * jy
        H[2, 2] += w * (-ry * jx + rx * jy)
        g[0] += w * ux
        g[1] += w * uy
        g[2] += w * (-ry * ux + rx * uy)
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    return weights, found, cost


@kernel
def solve3(A: np.ndarray, b: np.ndarray, x: np.ndarray) -> bool:
    """Solve A x = b for symmetric A [3, 3] by Cholesky; return False if A is not positive definite."""
    l00 = A[0, 0]
    if not l00 > 0.0:
        return False
    l00 = math.sqrt(l00)
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = A[1, 1] - l10 * l10
    if not l11 > 1e-12 * A[1, 1]:
        return False
    l11 = math.sqrt(l11)
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = A[2, 2] - l20 * l20 - l21 * l21
    if not l22 > 1e-12 * A[2, 2]:
        return False
    l22 = math.sqrt(l22)
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    x[2] = y2 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return True


@kernel
def gauss_newton(
    points: np.ndarray,
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
    outlier: float,  # units of the surface's standard deviation
    returns_per_measurement: float,  # number of returns per independent measurement
    anneal: np.ndarray,  # float64 [A]
    iterations: int,
    pose: np.ndarray,  # out float64 [3]
    H: np.ndarray,  # out float64 [3, 3] information of the scan alone
) -> tuple[float, float, float]:
    """Optimise the pose of a scan by iteratively reweighted Gauss-Newton with a robust prior on the pose.

    Damping limits the steps in unobservable directions.

    Returns (sum of weights, number of associated returns, weighted cost) at the final pose.
    """
    g, A, b, step, e = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    pose[:] = start_pose
    weights = found = cost = 0.0
    for it in range(iterations):
        scale = outlier * (anneal[it] if it < anneal.shape[0] else 1.0)
        weights, found, cost = accumulate(
            points, origin, pose, nearest, means, omegas, views, row0, col0, cell_m, scale * scale, H, g
        )
        e[0], e[1], e[2] = pose[0] - prior_pose[0], pose[1] - prior_pose[1], se2.wrap(pose[2] - prior_pose[2])
        m2 = 0.0
        for i in range(3):
            for j in range(3):
                m2 += e[i] * prior_information[i, j] * e[j]
        w = 1.0 / (1.0 + m2 / 9.0)  # Cauchy weight: 0.5 at three sigma
        for i in range(3):
            b[i] = -g[i] / returns_per_measurement
            for j in range(3):
                A[i, j] = H[i, j] / returns_per_measurement + w * prior_information[i, j]
                b[i] -= w * prior_information[i, j] * e[j]
        # Damping of (1 m)^-2 and (0.3 rad)^-2; it matters only in unobservable directions.
        A[0, 0] += 1.0
        A[1, 1] += 1.0
        A[2, 2] += 10.0
        if not solve3(A, b, step):
            break
        pose[0] += step[0]
        pose[1] += step[1]
        pose[2] = se2.wrap(pose[2] + step[2])
        if it >= anneal.shape[0] and step[0] ** 2 + step[1] ** 2 < 1e-8 and abs(step[2]) < 2e-5:
            break
    weights, found, cost = accumulate(
        points, origin, pose, nearest, means, omegas, views, row0, col0, cell_m, outlier * outlier, H, g
    )
    H /= returns_per_measurement
    return weights, found, cost


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


def refine(
    points: np.ndarray,  # float64 [K, 5], PreparedScan.features()
    origin: np.ndarray,  # float64 [2]
    start_pose: np.ndarray,
    tables: MatchTables,
    settings: LidarSlamSettings,
    prior_pose: np.ndarray | None = None,
    prior_information: np.ndarray | None = None,
    iterations: int = 15,
    anneal: tuple[float, ...] = ANNEAL_SCALES,
) -> Match:
    """Return the match of a scan, refined by Gauss-Newton from `start_pose` [3]."""
    pose, H = np.empty(3), np.empty((3, 3))
    sigma_m = math.hypot(settings.range_sigma_m, settings.map_sigma_m)
    if prior_pose is None or prior_information is None:
        prior_pose, prior_information = start_pose, np.zeros((3, 3))
    weights, _, cost = gauss_newton(
        points,
        origin,
        start_pose,
        tables.nearest,
        tables.means,
        tables.omegas,
        tables.views,
        tables.row0,
        tables.col0,
        tables.cell_m,
        prior_pose,
        prior_information,
        settings.outlier_m / sigma_m,
        settings.returns_per_measurement,
        np.array(anneal),
        iterations,
        pose,
        H,
    )
    n = max(len(points), 1)
    overlapping = count_overlapping_returns(
        points, pose, tables.nearest, tables.misses, tables.row0, tables.col0, tables.cell_m
    )
    residual = sigma_m * math.sqrt(max(cost, 0.0) / weights) if weights > 0 else math.inf
    return Match(pose, H, weights / max(overlapping, 1), overlapping / n, residual)
