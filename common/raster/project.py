"""Projection of Gaussians to splats on the image, and the list of tiles that each splat overlaps.

EWA splatting (Zwicker et al. 2001) as in 3DGS: V = J R_camera_map R_q diag(s), covariance V V^T + blur. The
kernels process `LANES` Gaussians at a time; `c` is the camera of `RasterCamera.packed`, matrices are tuples
of vectors by rows.
"""

from __future__ import annotations

import numpy as np

from beamsplat.common.compiled import inner, kernel
from beamsplat.common.raster.culling import sort_by_depth
from beamsplat.common.raster.layout import (
    BATCHES,
    BLUR_PX2,
    COLOUR,
    OPACITY,
    QUAT,
    RECORD,
    ROWS,
    SCALE,
    TILE_H,
    TILE_W,
)
from beamsplat.common.raster.simd import LANES, fma, maximum, minimum, sqrt
from beamsplat.common.raster.simd_math import LOG2_E, exp_lanes, log2_lanes, sigmoid_lanes
from beamsplat.common.raster.simd_memory import aligned_floats, atomic_next, gather, store
from beamsplat.common.raster.simd_types import Vector, Vectors

_LN_255 = float(np.log(255.0))
_SHIFT_W, _SHIFT_H = TILE_W.bit_length() - 1, TILE_H.bit_length() - 1


@inner
def camera_point(
    params: np.ndarray, stride: int, index: np.ndarray, at: int, c: np.ndarray
) -> tuple[Vector, Vector, Vector]:
    """Return the centres of Gaussians index[at : at + LANES] in the camera frame: vectors x, y, z (m)."""
    x, y, z = (
        gather(params, 0, index, at),
        gather(params, stride, index, at),
        gather(params, 2 * stride, index, at),
    )
    xc = fma(x, c[0], fma(y, c[1], fma(z, c[2], c[9])))
    yc = fma(x, c[3], fma(y, c[4], fma(z, c[5], c[10])))
    zc = fma(x, c[6], fma(y, c[7], fma(z, c[8], c[11])))
    return xc, yc, zc


@inner
def rotation(params: np.ndarray, stride: int, index: np.ndarray, at: int) -> tuple[Vectors, Vectors]:
    """Return the rotations of Gaussians index[at : at + LANES], as quaternions and as matrices.

    The first result is (w, x, y, z, n): the unit quaternion, and n = 1 / norm of the stored quaternion. The
    second result is the rotation matrix R by rows (nine vectors).
    """
    w, x = gather(params, QUAT * stride, index, at), gather(params, (QUAT + 1) * stride, index, at)
    y, z = gather(params, (QUAT + 2) * stride, index, at), gather(params, (QUAT + 3) * stride, index, at)
    n = 1.0 / sqrt(maximum(w * w + x * x + y * y + z * z, 1e-24))
    w, x, y, z = w * n, x * n, y * n, z * n
    q = (w, x, y, z, n)
    R = (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip
    return q, R


@inner
def axes(
    params: np.ndarray, stride: int, index: np.ndarray, at: int, c: np.ndarray, R: Vectors
) -> tuple[Vectors, Vectors]:
    """Return M = R_camera_map R_q diag(s), nine vectors by rows, and the three scales s (m)."""
    s0 = exp_lanes(gather(params, SCALE * stride, index, at))
    s1 = exp_lanes(gather(params, (SCALE + 1) * stride, index, at))
    s2 = exp_lanes(gather(params, (SCALE + 2) * stride, index, at))
    M = (
        (R[0] * c[0] + R[3] * c[1] + R[6] * c[2]) * s0,
        (R[1] * c[0] + R[4] * c[1] + R[7] * c[2]) * s1,
        (R[2] * c[0] + R[5] * c[1] + R[8] * c[2]) * s2,
        (R[0] * c[3] + R[3] * c[4] + R[6] * c[5]) * s0,
        (R[1] * c[3] + R[4] * c[4] + R[7] * c[5]) * s1,
        (R[2] * c[3] + R[5] * c[4] + R[8] * c[5]) * s2,
        (R[0] * c[6] + R[3] * c[7] + R[6] * c[8]) * s0,
        (R[1] * c[6] + R[4] * c[7] + R[7] * c[8]) * s1,
        (R[2] * c[6] + R[5] * c[7] + R[8] * c[8]) * s2,
    )
    return M, (s0, s1, s2)


@inner
def screen_covariance(
    M: Vectors, xc: Vector, yc: Vector, zc: Vector, c: np.ndarray
) -> tuple[Vectors, Vectors, Vectors, Vectors]:
    """Return the rows V0, V1 of V = J M, the covariance (a, b, d) in px^2 with blur, and the terms of J.

    The terms of J are (1/z, x/z and y/z clamped to the slope limits, J00, J02, J11, J12).
    """
    inverse = 1.0 / zc
    ux = minimum(maximum(xc * inverse, c[16]), c[17])
    uy = minimum(maximum(yc * inverse, c[18]), c[19])
    j00, j02 = inverse * c[12], -(ux * inverse) * c[12]
    j11, j12 = inverse * c[13], -(uy * inverse) * c[13]
    V0 = (fma(j00, M[0], j02 * M[6]), fma(j00, M[1], j02 * M[7]), fma(j00, M[2], j02 * M[8]))
    V1 = (fma(j11, M[3], j12 * M[6]), fma(j11, M[4], j12 * M[7]), fma(j11, M[5], j12 * M[8]))
    a = V0[0] * V0[0] + V0[1] * V0[1] + V0[2] * V0[2] + BLUR_PX2
    b = V0[0] * V1[0] + V0[1] * V1[1] + V0[2] * V1[2]
    d = V1[0] * V1[0] + V1[1] * V1[1] + V1[2] * V1[2] + BLUR_PX2
    return V0, V1, (a, b, d), (inverse, ux, uy, j00, j02, j11, j12)


@kernel
def _write_records(
    params: np.ndarray,
    stride: int,
    index: np.ndarray,
    first: int,
    c: np.ndarray,
    records: np.ndarray,
    lanes: np.ndarray,
) -> None:
    """Project Gaussians index[first ... first + LANES) to their records at records[first * RECORD ...]."""
    xc, yc, zc = camera_point(params, stride, index, first, c)
    _, R = rotation(params, stride, index, first)
    M, _ = axes(params, stride, index, first, c, R)
    _, _, cov, _ = screen_covariance(M, xc, yc, zc, c)
    inverse = 1.0 / zc
    k = 1.0 / maximum(cov[0] * cov[2] - cov[1] * cov[1], 1e-12)
    log_opacity = log2_lanes(maximum(sigmoid_lanes(gather(params, OPACITY * stride, index, first)), 1e-30))
    reach = 2.0 * fma(log_opacity, 1.0 / LOG2_E, _LN_255)  # d^T cov^-1 d of the ellipse where alpha is 1/255
    store(lanes, 0, fma(xc * inverse, c[12], c[14]))
    store(lanes, LANES, fma(yc * inverse, c[13], c[15]))
    store(lanes, 2 * LANES, cov[2] * k * (-0.5 * LOG2_E))
    store(lanes, 3 * LANES, cov[1] * k * LOG2_E)
    store(lanes, 4 * LANES, cov[0] * k * (-0.5 * LOG2_E))
    store(lanes, 5 * LANES, log_opacity)
    store(lanes, 6 * LANES, gather(params, COLOUR * stride, index, first))
    store(lanes, 7 * LANES, gather(params, (COLOUR + 1) * stride, index, first))
    store(lanes, 8 * LANES, gather(params, (COLOUR + 2) * stride, index, first))
    store(lanes, 9 * LANES, zc)
    store(lanes, 10 * LANES, reach)
    store(lanes, 11 * LANES, sqrt(maximum(reach * cov[0], 0.0)))  # half width of the ellipse
    store(lanes, 12 * LANES, sqrt(maximum(reach * cov[2], 0.0)))  # half height
    store(lanes, 13 * LANES, sqrt(maximum(reach / cov[2], 0.0)) * cov[1])  # x of its top point
    # B^2 - 4 A C, and 4 C level with level = -log2(e) reach / 2: terms of the ellipse equation in `_emit`.
    store(lanes, 14 * LANES, -(k * (LOG2_E * LOG2_E)))
    store(lanes, 15 * LANES, cov[0] * k * reach * (LOG2_E * LOG2_E))
    for lane in range(LANES):
        at = (first + lane) * RECORD
        for field in range(RECORD):
            records[at + field] = lanes[field * LANES + lane]


@kernel
def _emit(
    begin: int,
    stop: int,
    records: np.ndarray,
    width: int,
    height: int,
    tiles_x: int,
    first_pair: np.ndarray,
    pair_count: np.ndarray,
    tiles: np.ndarray,
    rows: np.ndarray,
    at: int,
    limit: int,
) -> int:
    """Write the (tile, rows) pairs of splats begin ... stop from index `at` on, and return the end index.

    `rows` contains the first and the last vector of rows that the splat overlaps in the tile. The overlap is
    exact per column of tiles: the minimum and maximum y of the ellipse over the column's eight pixels,
    y = (-B x -+ sqrt(B^2 x^2 - 4 C (A x^2 - level))) / 2 C. From index `limit` on, pairs are only counted.
    The loop over splats is in here because each call costs atomic reference counting of the arrays.
    """
    zero, right_edge, bottom = np.float32(0.0), np.float32(width - 1), np.float32(height - 1)
    slack = np.float32(1e-3)
    for splat in range(begin, stop):
        first_pair[splat] = at
        record = splat * RECORD
        if not records[record + 10] > 0.0:  # alpha below 1/255 at the centre, or NaN
            pair_count[splat] = 0
            continue
        x, y, half_w, half_h = (
            records[record],
            records[record + 1],
            records[record + 11],
            records[record + 12],
        )
        if not (
            x + half_w >= zero and x - half_w <= right_edge and y + half_h >= zero and y - half_h <= bottom
        ):
            pair_count[splat] = 0
            continue
        first, last = int(max(x - half_w, zero)) >> _SHIFT_W, int(min(x + half_w, right_edge)) >> _SHIFT_W
        B, x_top = records[record + 3], records[record + 13]
        curved, level = records[record + 14], records[record + 15]
        half_over_c = np.float32(0.5) / records[record + 4]
        for column in range(first, last + 1):
            low, high = -half_h, half_h
            if first != last:
                left = max(np.float32(column << _SHIFT_W) - x, -half_w)
                right = min(np.float32((column << _SHIFT_W) + TILE_W - 1) - x, half_w)
                if left > right + slack:
                    continue
                if x_top < left or x_top > right:
                    e = min(max(x_top, left), right)
                    high = (-B * e - np.sqrt(max(curved * e * e + level, zero))) * half_over_c
                if -x_top < left or -x_top > right:
                    e = min(max(-x_top, left), right)
                    low = (-B * e + np.sqrt(max(curved * e * e + level, zero))) * half_over_c
            y0 = int(np.ceil(max(y + low - slack, zero)))
            y1 = int(np.floor(min(y + high + slack, bottom)))
            if y0 > y1:
                continue
            for row in range(y0 >> _SHIFT_H, (y1 >> _SHIFT_H) + 1):
                if at < limit:
                    top = row << _SHIFT_H
                    tiles[at] = row * tiles_x + column
                    rows[at] = (max(y0 - top, 0) // ROWS) | ((min(y1 - top, TILE_H - 1) // ROWS) << 8)
                at += 1
        pair_count[splat] = at - first_pair[splat]
    return at


@kernel
def project_and_emit(
    counter: np.ndarray,
    params: np.ndarray,
    stride: int,
    index: np.ndarray,
    visible: int,
    camera: np.ndarray,
    width: int,
    height: int,
    tiles_x: int,
    records: np.ndarray,
    first_pair: np.ndarray,
    pair_count: np.ndarray,
    tiles: np.ndarray,
    rows: np.ndarray,
    emitted: np.ndarray,
    depth: np.ndarray,
    order: np.ndarray,
    keys: np.ndarray,
    keys_other: np.ndarray,
    order_other: np.ndarray,
) -> None:
    """Project the visible Gaussians in batches and list their (splat, tile) pairs; one thread sorts by depth.

    `tiles` and `rows` are int32 [BATCHES * capacity]; `emitted` [BATCHES] is the number of pairs of each
    batch. If it exceeds the capacity, the caller must enlarge the arrays and call again. The pairs of splat
    i are first_pair[i] ... first_pair[i] + pair_count[i]. The last five arguments are passed to
    `sort_by_depth`.
    """
    lanes = aligned_floats(RECORD * LANES)
    size, capacity = batch_size(visible), len(rows) // BATCHES
    while True:
        batch = atomic_next(counter, 0) - 1
        if batch >= BATCHES:
            return
        if batch < 0:
            sort_by_depth(depth, visible, order, keys, keys_other, order_other)
            continue
        at, limit = batch * capacity, (batch + 1) * capacity
        start, stop = batch * size, min(visible, (batch + 1) * size)
        for group in range(start, stop, LANES):
            _write_records(params, stride, index, group, camera, records, lanes)
            at = _emit(
                group, min(group + LANES, stop), records, width, height, tiles_x, first_pair, pair_count,
                tiles, rows, at, limit,
            )  # fmt: skip
        emitted[batch] = at - batch * capacity


@inner
def batch_size(visible: int) -> int:
    """Return the number of splats per batch: a multiple of LANES, so that batches write separate records."""
    return ((visible + BATCHES - 1) // BATCHES + LANES - 1) // LANES * LANES
