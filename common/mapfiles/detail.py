"""Level of detail: the Gaussians of one grid cell are merged into one, for viewpoints that see a cell as a
pixel.

A merged Gaussian has the mean, covariance and colour of its members, weighted by opacity times area, and the
opacity that covers the same area: the moments and the opacity rule of Kerbl et al. 2024, "A Hierarchical 3D
Gaussian Representation", eqs. 2-5, over the cells of a grid instead of the nodes of a tree.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from beamsplat.common.raster.layout import ALPHA_MAX, COLOUR, MEAN, OPACITY, QUAT, SCALE

FINEST_CELL_M = 0.02  # smallest cell; most Gaussians are as large, so smaller cells save little
_COARSEST_CELL_M = FINEST_CELL_M * 2**16  # 1.3 km: larger than any map
_MIN_SIGMA_M = 1e-4  # of a merged Gaussian: keeps its covariance invertible
_MAX_GROWTH = 1.6  # of a merged Gaussian's area; best of 1 to 2.5 on a mapped home


def detail_cell_m(distance_m: float, focal_px: float, error_px: float) -> float:
    """Return the edge (m) of the largest cell that appears at most `error_px` large in the image.

    Edges are `FINEST_CELL_M` times a power of two, at most `_COARSEST_CELL_M`; 0.0 (full detail) if the
    finest cell is larger.

    Raises:
        ValueError: a length is not finite, negative, or (`focal_px`) zero.
    """
    if not (0.0 <= distance_m < math.inf and 0.0 < focal_px < math.inf and 0.0 <= error_px < math.inf):
        raise ValueError(
            f"distance_m={distance_m}, focal_px={focal_px}, error_px={error_px}: expected finite lengths"
        )
    cell_m = min(error_px * distance_m / focal_px, _COARSEST_CELL_M)
    if cell_m < FINEST_CELL_M:
        return 0.0
    return FINEST_CELL_M * 2.0 ** math.floor(math.log2(cell_m / FINEST_CELL_M))


def merge_by_cell(params: np.ndarray, cell_m: float) -> np.ndarray:
    """Merge the Gaussians in each grid cell of edge `cell_m` into one, except Gaussians larger than a cell.

    Args:
        params: float32 [14, N], in any frame.
        cell_m: 0 returns `params` unchanged.

    Returns:
        float32 [14, M], M <= N.
    """
    scale = np.exp(params[SCALE:QUAT].astype(np.float64))
    small = scale.max(axis=0) < cell_m
    if cell_m <= 0.0 or not small.any():
        return params
    some = params[:, small]
    cells = np.floor(some[MEAN:SCALE].astype(np.float64) / cell_m).astype(np.int64)
    _, which, counts = np.unique(_cell_keys(cells), return_inverse=True, return_counts=True)
    single = counts[which] == 1
    order = np.argsort(which[~single], kind="stable")
    groups = some[:, ~single][:, order]
    merged = _merged(groups, np.unique(which[~single][order], return_index=True)[1])
    return np.concatenate([params[:, ~small], some[:, single], merged], axis=1)


def _cell_keys(cells: np.ndarray) -> np.ndarray:
    """Return one number [N] for each cell int64 [3, N], in the order of (x, y, z).

    Sorting numbers takes a tenth of the time of sorting columns. Cells that span more than 2^21 per axis,
    such as those of a map of kilometres in millimetres, are numbered by sorting the columns.
    """
    offset = cells - cells.min(axis=1, keepdims=True)
    if offset.max() < 1 << 21:
        return (offset[0] << 42) | (offset[1] << 21) | offset[2]
    return np.unique(cells, axis=1, return_inverse=True)[1].ravel()


def _merged(params: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return one Gaussian for each run of columns that begins at `starts` int [M]."""
    if params.shape[1] == 0:
        return params

    def total(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, starts, axis=-1)

    mean, R = params[MEAN:SCALE].astype(np.float64), _rotation(params[QUAT:OPACITY]).as_matrix()
    scale = np.exp(params[SCALE:QUAT].astype(np.float64))
    opacity = 1.0 / (1.0 + np.exp(-params[OPACITY].astype(np.float64)))
    weight = opacity * _area(scale)
    mass = total(weight)
    centre = total(weight * mean) / mass
    counts = np.diff(np.append(starts, params.shape[1]))
    off = mean - np.repeat(centre, counts, axis=1)
    spread = np.einsum("nij,jn,nkj->ikn", R, scale**2, R) + off[:, None] * off[None]
    covariance = (total(weight * spread) / mass).transpose(2, 0, 1)
    variance, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0  # det = +1: a rotation
    deviation = np.sqrt(np.maximum(variance, _MIN_SIGMA_M**2)).T
    # Opacity is at most 1: the rest of the area is covered by a larger Gaussian, within bounds.
    deviation[1:] *= np.sqrt(np.clip(mass / _area(deviation), 1.0, _MAX_GROWTH))
    covering = np.clip(mass / _area(deviation), 1e-4, ALPHA_MAX)
    out = np.empty((params.shape[0], len(starts)), np.float32)
    out[MEAN:SCALE], out[SCALE:QUAT] = centre, np.log(deviation)
    out[QUAT:OPACITY] = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1).T
    out[OPACITY] = np.log(covering / (1.0 - covering))
    out[COLOUR:] = total(weight * params[COLOUR:]) / mass
    return out


def _area(scale_m: np.ndarray) -> np.ndarray:
    """Return the area of the largest cross-section of ellipsoids [3, N], without the factor pi."""
    ordered = np.sort(scale_m, axis=0)
    return ordered[1] * ordered[2]


def _rotation(quat_wxyz: np.ndarray) -> Rotation:
    """Return N rotations from quaternions [4, N] of any norm."""
    return Rotation.from_quat(np.roll(quat_wxyz.astype(np.float64), -1, axis=0).T)
