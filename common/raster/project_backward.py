"""Backward pass of `project`: from sums per splat on the image to gradients of parameters and camera pose.

The kernels work on `LANES` splats at a time. `c` is the camera of `RasterCamera.packed`; matrices are tuples
of vectors by rows; J is the tuple that `screen_covariance` returns last.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import inner, kernel
from beamsplat.common.raster.layout import (
    BATCHES,
    COLOUR,
    GRADIENTS,
    OPACITY,
    QUAT,
    SCALE,
    SCREEN_GRADIENT,
    SLOT,
    WEIGHT,
)  # fmt: skip
from beamsplat.common.raster.project import axes, batch_size, camera_point, rotation, screen_covariance
from beamsplat.common.raster.simd import LANES, any_lane, broadcast, sqrt, where
from beamsplat.common.raster.simd_math import sigmoid_lanes
from beamsplat.common.raster.simd_memory import (
    aligned_floats,
    atomic_next,
    gather,
    load,
    prefetch,
    store,
    store_sums4,
)
from beamsplat.common.raster.simd_types import Vector, Vectors

_PREFETCH = 24  # slots are prefetched this many pairs ahead


@kernel
def _gather_sums(
    slots: np.ndarray,
    list_row: np.ndarray,
    first_pair: np.ndarray,
    pair_count: np.ndarray,
    splat: int,
    stop: int,
    sums: np.ndarray,
) -> None:
    """Add up the slots of each splat of a group into sums[lane * SLOT ...]. A slot is a cache line."""
    for lane in range(LANES):
        at = lane * SLOT
        for k in range(0, SLOT, LANES):
            store(sums, at + k, broadcast(np.float32(0.0)))
        if splat + lane < stop:
            first = first_pair[splat + lane]
            for pair in range(first, first + pair_count[splat + lane]):
                slot = list_row[pair] * SLOT
                prefetch(slots, list_row[pair + _PREFETCH] * SLOT)
                for k in range(0, SLOT, LANES):
                    store(sums, at + k, load(sums, at + k) + load(slots, slot + k))


@inner
def _screen_to_axes(
    sums: np.ndarray, lane_at: np.ndarray, cov: Vectors, V0: Vectors, V1: Vectors
) -> tuple[Vector, Vector, Vectors, Vectors]:
    """Return the gradients of the centre (px) and of the rows of V = J M from the moments of v."""
    v_x, v_y = gather(sums, 1, lane_at, 0), gather(sums, 2, lane_at, 0)
    v_xx, v_xy, v_yy = gather(sums, 3, lane_at, 0), gather(sums, 4, lane_at, 0), gather(sums, 5, lane_at, 0)
    k = 1.0 / (cov[0] * cov[2] - cov[1] * cov[1])
    a, b, c = cov[2] * k, -(cov[1] * k), cov[0] * k  # the conic: sigma = (a dx^2 + 2 b dx dy + c dy^2) / 2
    g_u, g_v = a * v_x + b * v_y, b * v_x + c * v_y
    # dL/dcov = -K G K with G = -1/2 [[vxx, vxy], [vxy, vyy]], and dL/dV = 2 dL/dcov V.
    p00, p01 = a * v_xx + b * v_xy, a * v_xy + b * v_yy
    p10, p11 = b * v_xx + c * v_xy, b * v_xy + c * v_yy
    h00, h01, h11 = p00 * a + p01 * b, p00 * b + p01 * c, p10 * b + p11 * c
    dV0 = (h00 * V0[0] + h01 * V1[0], h00 * V0[1] + h01 * V1[1], h00 * V0[2] + h01 * V1[2])
    dV1 = (h01 * V0[0] + h11 * V1[0], h01 * V0[1] + h11 * V1[1], h01 * V0[2] + h11 * V1[2])
    return g_u, g_v, dV0, dV1


@inner
def _point_gradient(
    g_u: Vector,
    g_v: Vector,
    g_depth: Vector,
    dV0: Vectors,
    dV1: Vectors,
    M: Vectors,
    xc: Vector,
    yc: Vector,
    J: Vectors,
    c: np.ndarray,
) -> tuple[Vector, Vector, Vector]:
    """Return dL/d(centre in the camera frame), through the pixel, the depth and the Jacobian J."""
    inverse, ux, uy = J[0], J[1], J[2]
    d_j00 = dV0[0] * M[0] + dV0[1] * M[1] + dV0[2] * M[2]
    d_j02 = dV0[0] * M[6] + dV0[1] * M[7] + dV0[2] * M[8]
    d_j11 = dV1[0] * M[3] + dV1[1] * M[4] + dV1[2] * M[5]
    d_j12 = dV1[0] * M[6] + dV1[1] * M[7] + dV1[2] * M[8]
    square = inverse * inverse
    gx, gy = g_u * J[3], g_v * J[5]
    gz = g_depth - (gx * xc + gy * yc) * inverse
    gz = gz - square * (d_j00 * c[12] + d_j11 * c[13]) + square * (d_j02 * ux * c[12] + d_j12 * uy * c[13])
    slope_x, slope_y = xc * inverse, yc * inverse
    free_x, free_y = (slope_x > c[16]) & (slope_x < c[17]), (slope_y > c[18]) & (slope_y < c[19])
    g_ux, g_uy = where(free_x, d_j02 * inverse * -c[12], 0.0), where(free_y, d_j12 * inverse * -c[13], 0.0)
    gx, gy = gx + g_ux * inverse, gy + g_uy * inverse
    return gx, gy, gz - (g_ux * slope_x + g_uy * slope_y) * inverse


@inner
def _quat_gradient(q: Vectors, N: Vectors) -> Vectors:
    """Return dL/d(unnormalised quaternion) from N = dL/dR_q (nine vectors by rows)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    gw = 2.0 * (x * (N[7] - N[5]) + y * (N[2] - N[6]) + z * (N[3] - N[1]))
    gx = 2.0 * (w * (N[7] - N[5]) + y * (N[1] + N[3]) + z * (N[2] + N[6]) - 2.0 * (x * (N[4] + N[8])))
    gy = 2.0 * (w * (N[2] - N[6]) + x * (N[1] + N[3]) + z * (N[5] + N[7]) - 2.0 * (y * (N[0] + N[8])))
    gz = 2.0 * (w * (N[3] - N[1]) + x * (N[2] + N[6]) + y * (N[5] + N[7]) - 2.0 * (z * (N[0] + N[4])))
    along = w * gw + x * gx + y * gy + z * gz
    return (gw - w * along) * q[4], (gx - x * along) * q[4], (gy - y * along) * q[4], (gz - z * along) * q[4]


@inner
def _write_shape(
    out: np.ndarray, at: int, wide: int, c: np.ndarray, q: Vectors, M: Vectors, dM: Vectors, s: Vectors
) -> None:
    """Write the gradients of log scales and quaternion; columns of dL/dM belong to the ellipsoid's axes."""
    store(out, SCALE * wide + at, M[0] * dM[0] + M[3] * dM[3] + M[6] * dM[6])
    store(out, (SCALE + 1) * wide + at, M[1] * dM[1] + M[4] * dM[4] + M[7] * dM[7])
    store(out, (SCALE + 2) * wide + at, M[2] * dM[2] + M[5] * dM[5] + M[8] * dM[8])
    N = (  # dL/dR_q = R_camera_map^T dL/dM diag(s)
        (dM[0] * c[0] + dM[3] * c[3] + dM[6] * c[6]) * s[0],
        (dM[1] * c[0] + dM[4] * c[3] + dM[7] * c[6]) * s[1],
        (dM[2] * c[0] + dM[5] * c[3] + dM[8] * c[6]) * s[2],
        (dM[0] * c[1] + dM[3] * c[4] + dM[6] * c[7]) * s[0],
        (dM[1] * c[1] + dM[4] * c[4] + dM[7] * c[7]) * s[1],
        (dM[2] * c[1] + dM[5] * c[4] + dM[8] * c[7]) * s[2],
        (dM[0] * c[2] + dM[3] * c[5] + dM[6] * c[8]) * s[0],
        (dM[1] * c[2] + dM[4] * c[5] + dM[7] * c[8]) * s[1],
        (dM[2] * c[2] + dM[5] * c[5] + dM[8] * c[8]) * s[2],
    )  # fmt: skip
    g = _quat_gradient(q, N)
    store(out, QUAT * wide + at, g[0])
    store(out, (QUAT + 1) * wide + at, g[1])
    store(out, (QUAT + 2) * wide + at, g[2])
    store(out, (QUAT + 3) * wide + at, g[3])


@kernel
def _project_backward_group(
    params: np.ndarray,
    stride: int,
    index: np.ndarray,
    first: int,
    c: np.ndarray,
    sums: np.ndarray,
    lane_at: np.ndarray,
    out: np.ndarray,
    wide: int,
    pose: np.ndarray,
) -> None:
    """Write the gradients of a group of splats to out[row * wide + first], their pose sums to pose[8]."""
    xc, yc, zc = camera_point(params, stride, index, first, c)
    q, Rq = rotation(params, stride, index, first)
    M, s = axes(params, stride, index, first, c, Rq)
    V0, V1, cov, J = screen_covariance(M, xc, yc, zc, c)
    g_u, g_v, dV0, dV1 = _screen_to_axes(sums, lane_at, cov, V0, V1)
    gx, gy, gz = _point_gradient(g_u, g_v, gather(sums, 9, lane_at, 0), dV0, dV1, M, xc, yc, J, c)
    dM = (  # J^T dL/dV
        J[3] * dV0[0], J[3] * dV0[1], J[3] * dV0[2], J[5] * dV1[0], J[5] * dV1[1], J[5] * dV1[2],
        J[4] * dV0[0] + J[6] * dV1[0], J[4] * dV0[1] + J[6] * dV1[1], J[4] * dV0[2] + J[6] * dV1[2],
    )  # fmt: skip
    store(out, first, gx * c[0] + gy * c[3] + gz * c[6])
    store(out, wide + first, gx * c[1] + gy * c[4] + gz * c[7])
    store(out, 2 * wide + first, gx * c[2] + gy * c[5] + gz * c[8])
    _write_shape(out, first, wide, c, q, M, dM, s)
    opacity = sigmoid_lanes(gather(params, OPACITY * stride, index, first))
    store(out, OPACITY * wide + first, gather(sums, 0, lane_at, 0) * (1.0 - opacity))
    store(out, COLOUR * wide + first, gather(sums, 6, lane_at, 0))
    store(out, (COLOUR + 1) * wide + first, gather(sums, 7, lane_at, 0))
    store(out, (COLOUR + 2) * wide + first, gather(sums, 8, lane_at, 0))
    store(out, SCREEN_GRADIENT * wide + first, sqrt(g_u * g_u + g_v * g_v))
    store(out, WEIGHT * wide + first, gather(sums, 10, lane_at, 0))
    # exp(phi) rotates the centre p and the axes M_k: dL/dphi = p x dL/dp + sum over axes M_k x dL/dM_k.
    turn_x, turn_y, turn_z = yc * gz - zc * gy, zc * gx - xc * gz, xc * gy - yc * gx
    turn_x = (
        turn_x + (M[3] * dM[6] - M[6] * dM[3]) + (M[4] * dM[7] - M[7] * dM[4]) + (M[5] * dM[8] - M[8] * dM[5])
    )
    turn_y = (
        turn_y + (M[6] * dM[0] - M[0] * dM[6]) + (M[7] * dM[1] - M[1] * dM[7]) + (M[8] * dM[2] - M[2] * dM[8])
    )
    turn_z = (
        turn_z + (M[0] * dM[3] - M[3] * dM[0]) + (M[1] * dM[4] - M[4] * dM[1]) + (M[2] * dM[5] - M[5] * dM[2])
    )
    store_sums4(pose, 0, gx, gy, gz, turn_x)
    store_sums4(pose, 4, turn_y, turn_z, gx, gx)


@kernel
def project_backward(
    counter: np.ndarray,
    params: np.ndarray,
    stride: int,
    index: np.ndarray,
    visible: int,
    camera: np.ndarray,
    slots: np.ndarray,
    list_row: np.ndarray,
    first_pair: np.ndarray,
    pair_count: np.ndarray,
    out: np.ndarray,
    pose_sums: np.ndarray,
) -> None:
    """Write the gradients of visible splats to `out` float32 [GRADIENTS, wide], of the pose to `pose_sums`.

    The pose gradient is summed in float64 per batch, `pose_sums` [BATCHES, 6], so that the result does not
    depend on the number of threads.
    """
    wide = out.shape[1]
    flat = out.reshape(-1)
    sums, pose = aligned_floats(SLOT * LANES), aligned_floats(8)
    lane_at = np.arange(LANES, dtype=np.int32) * np.int32(SLOT)
    size = batch_size(visible)
    while True:
        batch = atomic_next(counter, 0)
        if batch >= BATCHES:
            return
        pose_sums[batch, :] = 0.0
        stop = min(visible, (batch + 1) * size)
        for first in range(batch * size, stop, LANES):
            _gather_sums(slots, list_row, first_pair, pair_count, first, stop, sums)
            if not any_lane(gather(sums, 10, lane_at, 0) > 0.0):  # all occluded: the gradients are zero
                for row in range(GRADIENTS):
                    store(flat, row * wide + first, broadcast(np.float32(0.0)))
                continue
            _project_backward_group(params, stride, index, first, camera, sums, lane_at, flat, wide, pose)
            for k in range(6):
                pose_sums[batch, k] += pose[k]
