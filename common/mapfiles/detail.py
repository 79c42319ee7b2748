"""Level of detail: Gaussians of one cell as one, for who looks from so far that a cell is a pixel.

A merged Gaussian has the mean, covariance and colour of those it stands for, weighted by opacity times area,
and the opacity that covers as much (the moments and the opacity rule of Kerbl et al. 2024, "A Hierarchical 3D
Gaussian Representation", eqs. 2-5, over cells of a grid in place of a tree).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from beamsplat.common.raster.layout import ALPHA_MAX, COLOUR, MEAN, OPACITY, QUAT, SCALE

FINEST_CELL_M = 0.02  # below, merging saves little: Gaussians are as large
_THINNEST_M = 1e-4
_GROWTH = 1.6  # of a merged Gaussian's area; best of 1 to 2.5 on a mapped home


def detail_cell_m(distance_m: float, focal_px: float, error_px: float) -> float:
    """Edge (m) of cells that a pinhole of that focal length sees as `error_px` from that far: a power of two
    times `FINEST_CELL_M`; 0.0 where all detail is due."""
    cell_m = error_px * distance_m / focal_px
    if cell_m < FINEST_CELL_M:
        return 0.0
    return FINEST_CELL_M * 2.0 ** math.floor(math.log2(cell_m / FINEST_CELL_M))


def merge_by_cell(params: np.ndarray, cell_m: float) -> np.ndarray:
    """Gaussians float32 [14, M], M <= N, for those of `params` float32 [14, N]: one a cell of edge `cell_m`,
    beside those that are larger than a cell. `cell_m` 0 leaves all as they are."""
    scale = np.exp(params[SCALE:QUAT].astype(np.float64))
    small = scale.max(axis=0) < cell_m
    if cell_m <= 0.0 or not small.any():
        return params
    some = params[:, small]
    cells = np.floor(some[MEAN:SCALE].astype(np.float64) / cell_m).astype(np.int64)
    _, which, counts = np.unique(cells, axis=1, return_inverse=True, return_counts=True)
    which = which.ravel()
    single = counts[which] == 1
    order = np.argsort(which[~single], kind="stable")
    groups = some[:, ~single][:, order]
    merged = _merged(groups, np.unique(which[~single][order], return_index=True)[1])
    return np.concatenate([params[:, ~small], some[:, single], merged], axis=1)


def _merged(params: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """One Gaussian for each run of columns that begins at `starts`."""
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
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0  # a rotation, no mirror
    deviation = np.sqrt(np.maximum(variance, _THINNEST_M**2)).T
    # What opacity alone cannot cover, size does, within bounds.
    deviation[1:] *= np.sqrt(np.clip(mass / _area(deviation), 1.0, _GROWTH))
    covering = np.clip(mass / _area(deviation), 1e-4, ALPHA_MAX)
    out = np.empty((params.shape[0], len(starts)), np.float32)
    out[MEAN:SCALE], out[SCALE:QUAT] = centre, np.log(deviation)
    out[QUAT:OPACITY] = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1).T
    out[OPACITY] = np.log(covering / (1.0 - covering))
    out[COLOUR:] = total(weight * params[COLOUR:]) / mass
    return out


def _area(scale_m: np.ndarray) -> np.ndarray:
    """Of the largest face of ellipsoids [3, N], but for a factor."""
    ordered = np.sort(scale_m, axis=0)
    return ordered[1] * ordered[2]


def _rotation(quat_wxyz: np.ndarray) -> Rotation:
    """N rotations of quaternions [4, N] of any length."""
    return Rotation.from_quat(np.roll(quat_wxyz.astype(np.float64), -1, axis=0).T)
