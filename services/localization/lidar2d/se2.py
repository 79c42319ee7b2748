"""Planar rigid motions SE(2) as float64 [3] arrays (x_m, y_m, yaw_rad).

`pose_a_b` is the pose of frame b in frame a: it maps points of b to a.
"""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.compiled import kernel

TWO_PI = 2.0 * math.pi


@kernel
def wrap(angle_rad: float) -> float:
    """Return the equivalent angle in [-pi, pi) rad."""
    return angle_rad - TWO_PI * math.floor((angle_rad + math.pi) / TWO_PI)


@kernel
def compose(pose_a_b: np.ndarray, pose_b_c: np.ndarray) -> np.ndarray:
    """Return pose_a_c = pose_a_b * pose_b_c, yaw in [-pi, pi)."""
    c, s = math.cos(pose_a_b[2]), math.sin(pose_a_b[2])
    pose_a_c = np.empty(3)
    pose_a_c[0] = pose_a_b[0] + c * pose_b_c[0] - s * pose_b_c[1]
    pose_a_c[1] = pose_a_b[1] + s * pose_b_c[0] + c * pose_b_c[1]
    pose_a_c[2] = wrap(pose_a_b[2] + pose_b_c[2])
    return pose_a_c


@kernel
def inverse(pose_a_b: np.ndarray) -> np.ndarray:
    """Return pose_b_a, the inverse motion."""
    c, s = math.cos(pose_a_b[2]), math.sin(pose_a_b[2])
    pose_b_a = np.empty(3)
    pose_b_a[0] = -c * pose_a_b[0] - s * pose_a_b[1]
    pose_b_a[1] = s * pose_a_b[0] - c * pose_a_b[1]
    pose_b_a[2] = wrap(-pose_a_b[2])
    return pose_b_a


@kernel
def between(pose_a_b: np.ndarray, pose_a_c: np.ndarray) -> np.ndarray:
    """Return pose_b_c = inverse(pose_a_b) * pose_a_c."""
    return compose(inverse(pose_a_b), pose_a_c)


def transform(pose_a_b: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Transform points float64 [N, 2] from frame b to frame a."""
    c, s = math.cos(pose_a_b[2]), math.sin(pose_a_b[2])
    out = np.empty(points_b.shape, dtype=np.float64)
    out[:, 0] = pose_a_b[0] + c * points_b[:, 0] - s * points_b[:, 1]
    out[:, 1] = pose_a_b[1] + s * points_b[:, 0] + c * points_b[:, 1]
    return out


def compose_many(pose_a_b: np.ndarray, pose_b_c: np.ndarray) -> np.ndarray:
    """Return pose_a_c float64 [N, 3], row by row; the arguments are [N, 3] or [3]."""
    pose_a_b, pose_b_c = np.broadcast_arrays(np.atleast_2d(pose_a_b), np.atleast_2d(pose_b_c))
    c, s = np.cos(pose_a_b[:, 2]), np.sin(pose_a_b[:, 2])
    x = pose_a_b[:, 0] + c * pose_b_c[:, 0] - s * pose_b_c[:, 1]
    y = pose_a_b[:, 1] + s * pose_b_c[:, 0] + c * pose_b_c[:, 1]
    return np.stack([x, y, wrap_many(pose_a_b[:, 2] + pose_b_c[:, 2])], axis=1)


def between_many(pose_a_b: np.ndarray, pose_a_c: np.ndarray) -> np.ndarray:
    """Return pose_b_c float64 [N, 3], row by row; the arguments are [N, 3] or [3]."""
    pose_a_b, pose_a_c = np.broadcast_arrays(np.atleast_2d(pose_a_b), np.atleast_2d(pose_a_c))
    c, s = np.cos(pose_a_b[:, 2]), np.sin(pose_a_b[:, 2])
    dx, dy = pose_a_c[:, 0] - pose_a_b[:, 0], pose_a_c[:, 1] - pose_a_b[:, 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap_many(pose_a_c[:, 2] - pose_a_b[:, 2])], axis=1)


def wrap_many(angles_rad: np.ndarray) -> np.ndarray:
    """Return the equivalent angles in [-pi, pi), for an array of any shape."""
    return angles_rad - TWO_PI * np.floor((angles_rad + math.pi) / TWO_PI)


def from_matrix(T_a_b: np.ndarray) -> np.ndarray:
    """Convert a transform float64 [4, 4] or [3, 3] to a planar pose [3]; a pose [3] is copied.

    Height, roll and pitch are dropped. Raises ValueError for another shape.
    """
    T_a_b = np.asarray(T_a_b, dtype=np.float64)
    if T_a_b.shape == (3,):
        return T_a_b.copy()
    if T_a_b.shape not in ((3, 3), (4, 4)):
        raise ValueError(f"a pose has shape {T_a_b.shape}; expected (4, 4), (3, 3) or (3,)")
    last = T_a_b.shape[0] - 1
    return np.array([T_a_b[0, last], T_a_b[1, last], math.atan2(T_a_b[1, 0], T_a_b[0, 0])])


def rotate_covariance(covariance: np.ndarray, yaw_rad: float) -> np.ndarray:
    """Return a covariance [3, 3] of (x, y, yaw) in axes that are rotated by `-yaw_rad`."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return R @ covariance @ R.T
