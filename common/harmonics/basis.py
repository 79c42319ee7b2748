"""Real spherical harmonics of degree 1 to 3, signs and order of 3DGS (Kerbl et al. 2023), and their rotation.

The colour of a Gaussian in the viewing direction d (unit vector from the camera to its centre, map frame) is

    colour[c] + sum over k of harmonics[c * K + k] * basis(d)[k]

with K = 3, 8 or 15 coefficients per channel for degree 1, 2 or 3. `harmonics` are rows float32 [3 K, N], by
channel, as `f_rest_*` in PLY files.
"""

from __future__ import annotations

import functools

import numpy as np

MAX_DEGREE = 3
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
    1.445305721320277, -0.5900435899266435,
)  # fmt: skip
_SAMPLES = 64  # directions from which a rotation of coefficients is computed


def coefficients(degree: int) -> int:
    """Return the number of coefficients per channel beyond the constant one: 0, 3, 8 or 15.

    Raises:
        ValueError: the degree is not 0 to 3.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"the degree of spherical harmonics must be 0 to {MAX_DEGREE}, not {degree}")
    return (degree + 1) ** 2 - 1


def degree_of(rows: int) -> int:
    """Return the degree that has `rows` rows of coefficients of three channels.

    Raises:
        ValueError: none has.
    """
    for degree in range(MAX_DEGREE + 1):
        if rows == 3 * coefficients(degree):
            return degree
    raise ValueError(f"{rows} rows are no spherical harmonics of degree 0 to {MAX_DEGREE}")


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the basis functions float64 [N, K] at unit vectors [N, 3]."""
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    columns = [
        -C1 * y, C1 * z, -C1 * x,
        C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy),
        C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy),
        C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy), C3[5] * z * (xx - yy),
        C3[6] * x * (xx - 3 * yy),
    ]  # fmt: skip
    return np.stack(columns, axis=1)[:, : coefficients(degree)]


def rotation_of(R_new_old: np.ndarray, degree: int) -> np.ndarray:
    """Return the matrix float64 [K, K] that turns coefficients as R_new_old turns directions.

    It is computed from the functions at sample directions; the result is exact but for rounding, because
    rotated harmonics of a degree are sums of harmonics of that degree.
    """
    directions = _samples()
    return np.linalg.pinv(basis(directions, degree)) @ basis(directions @ R_new_old, degree)


def rotated(rows: np.ndarray, R_new_old: np.ndarray) -> np.ndarray:
    """Return coefficients float32 [3 K, N] in a rotated frame."""
    degree = degree_of(len(rows))
    if degree == 0:
        return rows
    blocks = rows.reshape(3, coefficients(degree), -1).astype(np.float64)
    return (rotation_of(R_new_old, degree) @ blocks).astype(np.float32).reshape(rows.shape)


def with_degree(rows: np.ndarray, degree: int) -> np.ndarray:
    """Return coefficients float32 [3 K, N] of another degree: higher ones are left out, or zero."""
    before, after = coefficients(degree_of(len(rows))), coefficients(degree)
    if before == after:
        return rows
    out = np.zeros((3, after, rows.shape[1]), np.float32)
    shared = min(before, after)
    out[:, :shared] = rows.reshape(3, before, rows.shape[1])[:, :shared]
    return out.reshape(3 * after, rows.shape[1])


@functools.cache
def _samples() -> np.ndarray:
    """Return directions float64 [_SAMPLES, 3], evenly spread over the sphere (Fibonacci)."""
    k = np.arange(_SAMPLES) + 0.5
    z, turn = 1.0 - 2.0 * k / _SAMPLES, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
