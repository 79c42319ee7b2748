"""Planar rigid motions as float64 [3] arrays (x_m, y_m, yaw_rad); `T_a_b` takes b to a."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel

TWO_PI = 2.0 * math.pi


@kernel
def wrap(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    return angle_rad - TWO_PI * math.floor((angle_rad + math.pi) / TWO_PI)


@kernel
def compose(T_a_b: np.ndarray, T_b_c: np.ndarray) -> np.ndarray:
    """T_a_c = T_a_b @ T_b_c."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    T_a_c = np.empty(3)
    T_a_c[0] = T_a_b[0] + c * T_b_c[0] - s * T_b_c[1]
    T_a_c[1] = T_a_b[1] + s * T_b_c[0] + c * T_b_c[1]
    T_a_c[2] = wrap(T_a_b[2] + T_b_c[2])
    return T_a_c


@kernel
def inverse(T_a_b: np.ndarray) -> np.ndarray:
    """T_b_a."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    T_b_a = np.empty(3)
    T_b_a[0] = -c * T_a_b[0] - s * T_a_b[1]
    T_b_a[1] = s * T_a_b[0] - c * T_a_b[1]
    T_b_a[2] = wrap(-T_a_b[2])
    return T_b_a


@kernel
def between(T_a_b: np.ndarray, T_a_c: np.ndarray) -> np.ndarray:
    """T_b_c = inverse(T_a_b) @ T_a_c."""
    return compose(inverse(T_a_b), T_a_c)


def transform(T_a_b: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Points [N, 2] of frame b expressed in frame a."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    out = np.empty(points_b.shape, dtype=np.float64)
    out[:, 0] = T_a_b[0] + c * points_b[:, 0] - s * points_b[:, 1]
    out[:, 1] = T_a_b[1] + s * points_b[:, 0] + c * points_b[:, 1]
    return out


def compose_many(T_a_b: np.ndarray, T_b_c: np.ndarray) -> np.ndarray:
    """Row-wise composition of [N, 3] (or [3]) with [N, 3] (or [3]); broadcasts."""
    T_a_b, T_b_c = np.broadcast_arrays(np.atleast_2d(T_a_b), np.atleast_2d(T_b_c))
    c, s = np.cos(T_a_b[:, 2]), np.sin(T_a_b[:, 2])
    x = T_a_b[:, 0] + c * T_b_c[:, 0] - s * T_b_c[:, 1]
    y = T_a_b[:, 1] + s * T_b_c[:, 0] + c * T_b_c[:, 1]
    return np.stack([x, y, wrap_many(T_a_b[:, 2] + T_b_c[:, 2])], axis=1)


def between_many(T_a_b: np.ndarray, T_a_c: np.ndarray) -> np.ndarray:
    """Row-wise inverse(T_a_b) @ T_a_c for [N, 3] arrays."""
    T_a_b, T_a_c = np.broadcast_arrays(np.atleast_2d(T_a_b), np.atleast_2d(T_a_c))
    c, s = np.cos(T_a_b[:, 2]), np.sin(T_a_b[:, 2])
    dx, dy = T_a_c[:, 0] - T_a_b[:, 0], T_a_c[:, 1] - T_a_b[:, 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap_many(T_a_c[:, 2] - T_a_b[:, 2])], axis=1)


def wrap_many(angles_rad: np.ndarray) -> np.ndarray:
    """Angles of any shape in [-pi, pi)."""
    return angles_rad - TWO_PI * np.floor((angles_rad + math.pi) / TWO_PI)


def from_matrix(T_a_b: np.ndarray) -> np.ndarray:
    """(x, y, yaw) of a [3, 3] or [4, 4] matrix or of a [3] array; height, roll and pitch are dropped."""
    T_a_b = np.asarray(T_a_b, dtype=np.float64)
    if T_a_b.shape == (3,):
        return T_a_b.copy()
    if T_a_b.shape not in ((3, 3), (4, 4)):
        raise ValueError(f"T_body_lidar has shape {T_a_b.shape}; give (3,), (3, 3) or (4, 4)")
    last = T_a_b.shape[0] - 1
    return np.array([T_a_b[0, last], T_a_b[1, last], math.atan2(T_a_b[1, 0], T_a_b[0, 0])])


def to_matrix(T_a_b: np.ndarray) -> np.ndarray:
    """[4, 4] matrix with z = 0."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    return np.array([[c, -s, 0, T_a_b[0]], [s, c, 0, T_a_b[1]], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)
