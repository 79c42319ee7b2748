"""Kernels of the surfel map: moments per cell and the surface elements (surfels) computed from them."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.services.localization.lidar2d.table_kernels import splat

MAX_WEIGHT = 60.0  # number of returns after which old ones are forgotten: follows slow changes and drift
RESPLAT_M = 0.006  # the tables are updated when a surface element has moved by this distance


@kernel
def merged_surfel(
    cell_id: np.ndarray,  # int32 [H, W]
    moments: np.ndarray,  # float64 [S, 6] weight, x, y, xx, xy, yy sums
    row: int,
    col: int,
    range_sigma_m: float,
    map_sigma_m: float,
    mean: np.ndarray,  # out float64 [2]
    omega: np.ndarray,  # out float64 [3] information xx, xy, yy
) -> None:
    """Compute the surface element of a cell: mean and information matrix of 3x3 cells (binomial weights).

    A wall has no information along its direction; other shapes have information in both directions.
    """
    w = sx = sy = sxx = sxy = syy = 0.0
    ref = cell_id[row, col]
    ox = moments[ref, 1] / moments[ref, 0]
    oy = moments[ref, 2] / moments[ref, 0]
    for dr in range(-1, 2):
        for dc in range(-1, 2):
            r, c = row + dr, col + dc
            if r < 0 or c < 0 or r >= cell_id.shape[0] or c >= cell_id.shape[1]:
                continue
            k = cell_id[r, c]
            if k < 0:
                continue
            f = (1.0 if dr == 0 else 0.5) * (1.0 if dc == 0 else 0.5)
            m = moments[k]
            # Shift to a local origin first, against cancellation in the sums of squares.
            w += f * m[0]
            sx += f * (m[1] - m[0] * ox)
            sy += f * (m[2] - m[0] * oy)
            sxx += f * (m[3] - 2.0 * ox * m[1] + m[0] * ox * ox)
            sxy += f * (m[4] - ox * m[2] - oy * m[1] + m[0] * ox * oy)
            syy += f * (m[5] - 2.0 * oy * m[2] + m[0] * oy * oy)
    ux, uy = sx / w, sy / w
    cxx, cxy, cyy = sxx / w - ux * ux, sxy / w - ux * uy, syy / w - uy * uy
    mean[0], mean[1] = ox + ux, oy + uy
    half = 0.5 * (cxx + cyy)
    root = math.sqrt(max(0.25 * (cxx - cyy) ** 2 + cxy * cxy, 0.0))
    low, high = max(half - root, 0.0), half + root
    noise = map_sigma_m * map_sigma_m + range_sigma_m * range_sigma_m
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
    nx, ny = -math.sin(angle), math.cos(angle)
    a = 1.0 / (low + noise)
    # Along the surface: 0 for a line, 1 / variance for a round shape, interpolated in between.
    roundness = low / max(high, 1e-9)
    b = max(0.0, min(1.0, (roundness - 0.1) / 0.3)) / (high + noise)
    omega[0] = a * nx * nx + b * ny * ny
    omega[1] = (a - b) * nx * ny
    omega[2] = a * ny * ny + b * nx * nx


@kernel
def compute_surfels(
    cell_id: np.ndarray,
    moments: np.ndarray,
    cells: np.ndarray,  # int32 [S, 2] row, col (absolute)
    row0: int,
    col0: int,
    range_sigma_m: float,
    map_sigma_m: float,
    means: np.ndarray,  # out float64 [>= S, 2]
    omegas: np.ndarray,  # out float64 [>= S, 3]
) -> None:
    """Compute the surface element (mean, information) of every cell with returns."""
    for k in range(cells.shape[0]):
        row, col = cells[k, 0] - row0, cells[k, 1] - col0
        merged_surfel(cell_id, moments, row, col, range_sigma_m, map_sigma_m, means[k], omegas[k])


@kernel
def _increment(counter: np.ndarray, other: np.ndarray, r: int, c: int) -> None:
    """Increment `counter` at (r, c); at 255, halve both counters first, which preserves their ratio."""
    if counter[r, c] == 255:
        counter[r, c] = 128
        other[r, c] >>= 1
    counter[r, c] += 1


@kernel
def add_returns(
    points: np.ndarray,  # float64 [M, 2] in the map's frame
    tangents: np.ndarray,  # float64 [M, 2] in the map's frame
    spacing_m: np.ndarray,  # float64 [M]
    use: np.ndarray,  # bool [M]
    origin: np.ndarray,  # float64 [2]
    scan_number: int,
    cell_id: np.ndarray,
    hits: np.ndarray,  # uint8 [H, W]
    misses: np.ndarray,  # uint8 [H, W]
    touched: np.ndarray,  # int32 [H, W], number of the last scan that changed the cell
    moments: np.ndarray,
    views: np.ndarray,  # float64 [S, 2] mean of the unit directions towards the lidar
    cells: np.ndarray,  # int32 [S, 2] row, col (absolute)
    table_means: np.ndarray,  # float64 [S, 2], see refresh()
    count: int,
    row0: int,
    col0: int,
    cell_m: float,
    changed: np.ndarray,  # out int32 [>= M], surfels with a new return
) -> tuple[int, int]:
    """Add the returns of a scan to the moments of their cells and count hits.

    Returns the number of surfels, and the number of surfels with a new return (the length of `changed`).
    """
    n_changed = 0
    for i in range(points.shape[0]):
        if not use[i]:
            continue
        x, y = points[i, 0], points[i, 1]
        ar, ac = math.floor(y / cell_m), math.floor(x / cell_m)
        r, c = ar - row0, ac - col0
        k = cell_id[r, c]
        if k < 0:
            k = count
            count += 1
            cell_id[r, c] = k
            cells[k, 0], cells[k, 1] = ar, ac
            moments[k] = 0.0
            views[k] = 0.0
            table_means[k] = 1e9
        if touched[r, c] != scan_number:
            touched[r, c] = scan_number
            _increment(hits, misses, r, c)
            changed[n_changed] = k
            n_changed += 1
        m = moments[k]
        if m[0] > MAX_WEIGHT:
            f = MAX_WEIGHT / m[0]
            for j in range(6):
                m[j] *= f
        # A return represents a piece of the surface of the length of its spacing, along the tangent; if
        # the tangent is unknown, in all directions.
        s = min(0.5 * spacing_m[i], 0.10)
        s2 = s * s
        tx, ty = tangents[i, 0], tangents[i, 1]
        blob = s2 if tx == 0.0 and ty == 0.0 else 0.0
        w = max(0.1, min(1.0, spacing_m[i] / cell_m))
        m[0] += w
        m[1] += w * x
        m[2] += w * y
        m[3] += w * (x * x + s2 * tx * tx + blob)
        m[4] += w * (x * y + s2 * tx * ty)
        m[5] += w * (y * y + s2 * ty * ty + blob)
        vx, vy = origin[0] - x, origin[1] - y
        norm = max(math.hypot(vx, vy), 1e-6)
        views[k, 0] += w / m[0] * (vx / norm - views[k, 0])
        views[k, 1] += w / m[0] * (vy / norm - views[k, 1])
    return count, n_changed


@kernel
def cast_rays(
    points: np.ndarray,
    use: np.ndarray,
    origin: np.ndarray,
    scan_number: int,
    hits: np.ndarray,
    misses: np.ndarray,
    touched: np.ndarray,
    row0: int,
    col0: int,
    cell_m: float,
) -> None:
    """Count one miss per scan in every cell that a beam crossed before its return.

    The grid traversal is that of Amanatides and Woo 1987. Cells with a return of the same scan are not
    changed.
    """
    for i in range(points.shape[0]):
        if not use[i]:
            continue
        dx, dy = points[i, 0] - origin[0], points[i, 1] - origin[1]
        length = math.hypot(dx, dy) - 1.5 * cell_m
        if length <= 0.0:
            continue
        norm = math.hypot(dx, dy)
        ux, uy = dx / norm, dy / norm
        r = math.floor(origin[1] / cell_m)
        c = math.floor(origin[0] / cell_m)
        step_c = 1 if ux > 0 else -1
        step_r = 1 if uy > 0 else -1
        tdx = cell_m / max(abs(ux), 1e-12)
        tdy = cell_m / max(abs(uy), 1e-12)
        tx = (((c + 1) if ux > 0 else c) * cell_m - origin[0]) / (ux if abs(ux) > 1e-12 else 1e-12)
        ty = (((r + 1) if uy > 0 else r) * cell_m - origin[1]) / (uy if abs(uy) > 1e-12 else 1e-12)
        tx, ty = abs(tx), abs(ty)
        t = 0.0
        while t < length:
            rr, cc = r - row0, c - col0
            if touched[rr, cc] != scan_number:
                touched[rr, cc] = scan_number
                _increment(misses, hits, rr, cc)
            if tx < ty:
                t = tx
                tx += tdx
                c += step_c
            else:
                t = ty
                ty += tdy
                r += step_r


@kernel
def refresh(
    changed: np.ndarray,  # int32 [C] surfels with new returns
    cell_id: np.ndarray,
    nearest: np.ndarray,
    field: np.ndarray,
    moments: np.ndarray,
    cells: np.ndarray,
    means: np.ndarray,
    omegas: np.ndarray,
    table_means: np.ndarray,  # in out float64 [S, 2], the means in the match tables
    row0: int,
    col0: int,
    cell_m: float,
    reach: int,
    range_sigma_m: float,
    map_sigma_m: float,
) -> None:
    """Recompute the surface elements of changed cells and their neighbours, then update the match tables."""
    for i in range(changed.shape[0]):
        row, col = cells[changed[i], 0] - row0, cells[changed[i], 1] - col0
        for r in range(max(row - 1, 0), min(row + 2, cell_id.shape[0])):
            for c in range(max(col - 1, 0), min(col + 2, cell_id.shape[1])):
                k = cell_id[r, c]
                if k >= 0:
                    merged_surfel(cell_id, moments, r, c, range_sigma_m, map_sigma_m, means[k], omegas[k])
    for i in range(changed.shape[0]):
        k = changed[i]
        moved = abs(means[k, 0] - table_means[k, 0]) + abs(means[k, 1] - table_means[k, 1])
        if moved < RESPLAT_M:
            continue
        table_means[k] = means[k]
        splat(
            nearest,
            field,
            means,
            omegas,
            k,
            cells[k, 0] - row0,
            cells[k, 1] - col0,
            row0,
            col0,
            cell_m,
            reach,
        )
