"""Compiled kernels of the direct alignment of a rendered view to an image, and of the map loss.

The rendered view is a set of points with grey values: X = z K^-1 (u, v, 1) in the camera frame of the render.
They are transformed by T_now_render and projected into the image; the residual is the grey value of the image
minus the rendered grey value (after gain and offset).
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import kernel

UNKNOWN_COUNT = 8  # (rho, phi) of the left perturbation of T_now_render, log gain, offset


@kernel
def select_points(
    grey: np.ndarray,
    z_m: np.ndarray,
    alpha: np.ndarray,
    min_gradient: np.float32,
    min_alpha: np.float32,
    stride: int,
    out: np.ndarray,
) -> tuple[int, int]:
    """Write the rendered pixels that are used for alignment to `out`, float32 [N, 4]: u, v (px), z, grey.

    A pixel is suitable if its grey gradient is at least `min_gradient`, its depth is known (`z_m` > 0), and
    the map is opaque (alpha >= `min_alpha`) at the pixel and its four neighbours. Every `stride`-th suitable
    pixel is written, until `out` is full.

    Returns:
        The number of pixels written, and the number of suitable pixels. If the latter over `stride` exceeds
        N, call again with a larger stride.
    """
    height, width = grey.shape
    found, n = 0, 0
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            if alpha[v, u] < min_alpha or not z_m[v, u] > 0.0:
                continue
            dx = np.float32(0.5) * (grey[v, u + 1] - grey[v, u - 1])
            dy = np.float32(0.5) * (grey[v + 1, u] - grey[v - 1, u])
            if dx * dx + dy * dy < min_gradient * min_gradient:
                continue
            near = min(min(alpha[v, u - 1], alpha[v, u + 1]), min(alpha[v - 1, u], alpha[v + 1, u]))
            if near < min_alpha:
                continue
            found += 1
            if found % stride == 0 and n < len(out):
                out[n, 0], out[n, 1], out[n, 2], out[n, 3] = u, v, z_m[v, u], grey[v, u]
                n += 1
    return n, found


@kernel
def normal_equations(
    points: np.ndarray,
    count: int,
    camera: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
    image: np.ndarray,
    gradient_x: np.ndarray,
    gradient_y: np.ndarray,
    gain: float,
    offset: float,
    delta: float,
    H: np.ndarray,
    g: np.ndarray,
    residuals: np.ndarray,
) -> tuple[int, float]:
    """Compute the normal equations H = sum J^T w J [8, 8] and g = sum J^T w r [8] with Huber weights w.

    The unknowns are rho [3] and phi [3] of a left perturbation of T_now_render, log gain, and offset. Returns
    the number of points inside the image, and the sum of their Huber losses.

    Args:
        points: float32 [N, 4] of select_points. camera: float64 (fx, fy, cx, cy) of this level.
        R, t: rotation and translation of T_now_render.
        image, gradient_x, gradient_y: float32 [H, W], grey and its central differences per pixel.
        gain, offset: exposure, residual r = image - (gain grey + offset). delta: Huber threshold (grey).
        residuals: out float32 [N], NaN where a point falls outside the image.
    """
    height, width = image.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    H[:] = 0.0
    g[:] = 0.0
    J = np.empty(UNKNOWN_COUNT)
    used, cost = 0, 0.0
    for i in range(count):
        residuals[i] = np.nan
        z0 = float(points[i, 2])
        x0, y0 = (points[i, 0] - cx) / fx * z0, (points[i, 1] - cy) / fy * z0
        x = R[0, 0] * x0 + R[0, 1] * y0 + R[0, 2] * z0 + t[0]
        y = R[1, 0] * x0 + R[1, 1] * y0 + R[1, 2] * z0 + t[1]
        z = R[2, 0] * x0 + R[2, 1] * y0 + R[2, 2] * z0 + t[2]
        if z < 0.05:
            continue
        iz = 1.0 / z
        u, v = fx * x * iz + cx, fy * y * iz + cy
        if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
            continue
        c, r = int(u), int(v)
        a, b = u - c, v - r
        w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
        seen = w00 * image[r, c] + w01 * image[r, c + 1] + w10 * image[r + 1, c] + w11 * image[r + 1, c + 1]
        sx = (
            w00 * gradient_x[r, c]
            + w01 * gradient_x[r, c + 1]
            + w10 * gradient_x[r + 1, c]
            + w11 * gradient_x[r + 1, c + 1]
        )
        sy = (
            w00 * gradient_y[r, c]
            + w01 * gradient_y[r, c + 1]
            + w10 * gradient_y[r + 1, c]
            + w11 * gradient_y[r + 1, c + 1]
        )
        grey = float(points[i, 3])
        error = seen - (gain * grey + offset)
        residuals[i] = error
        size = abs(error)
        w = 1.0 if size <= delta else delta / size
        cost += 0.5 * error * error if size <= delta else delta * (size - 0.5 * delta)
        # d(u, v)/dX [I | -X^]: the analytic SE(3) Jacobian (Matsuki et al. 2024, eqs. 5 and 6).
        px, py = sx * fx * iz, sy * fy * iz
        pz = -(px * x + py * y) * iz
        J[0], J[1], J[2] = px, py, pz
        J[3], J[4], J[5] = y * pz - z * py, z * px - x * pz, x * py - y * px
        J[6], J[7] = -gain * grey, -1.0
        for row in range(UNKNOWN_COUNT):
            wj = w * J[row]
            g[row] += wj * error
            for column in range(row, UNKNOWN_COUNT):
                H[row, column] += wj * J[column]
        used += 1
    for row in range(UNKNOWN_COUNT):
        for column in range(row):
            H[row, column] = H[column, row]
    return used, cost


@kernel
def map_loss(
    image: np.ndarray,
    rgb: np.ndarray,
    z_m: np.ndarray,
    weight: np.ndarray,
    colour_scale: np.float32,
    depth_scale: np.float32,
    gradient: np.ndarray,
) -> float:
    """Return the L1 loss of a render against a keyframe; write its gradient with respect to the render.

    The colour term compares colour / alpha with `rgb`. The depth term is weight |D - z alpha|, where D is the
    accumulated depth: zero at the right depth for any opacity. Where the depth is known, a third term
    increases alpha towards one, so that gaps in the surface close.

    Args:
        image: float32 [5, H, W], the render: red, green, blue, accumulated depth, alpha.
        rgb: float32 [3, H, W] in [0, 1], image of the keyframe.
        z_m, weight: float32 [H, W], optical z of the keyframe (0 = unknown) and its weight.
        colour_scale, depth_scale: factors of the two terms, per pixel.
        gradient: out float32 [5, H, W].
    """
    height, width = z_m.shape
    total = 0.0
    for v in range(height):
        for u in range(width):
            alpha = max(image[4, v, u], np.float32(0.3))
            through = image[4, v, u] < np.float32(0.3)
            d_alpha = np.float32(0.0)
            for channel in range(3):
                shown = image[channel, v, u] / alpha
                error = shown - rgb[channel, v, u]
                slope = (colour_scale if error > 0.0 else -colour_scale) / alpha
                gradient[channel, v, u] = slope
                d_alpha -= np.float32(0.0) if through else slope * shown
                total += abs(error) * colour_scale
            if z_m[v, u] > 0.0:
                w = weight[v, u] * depth_scale
                error = image[3, v, u] - z_m[v, u] * image[4, v, u]
                slope = w if error > 0.0 else -w
                gradient[3, v, u] = slope
                gradient[4, v, u] = d_alpha - slope * z_m[v, u] - colour_scale
                total += w * abs(error) + colour_scale * (np.float32(1.0) - image[4, v, u])
            else:
                gradient[3, v, u] = np.float32(0.0)
                gradient[4, v, u] = d_alpha
    return total
