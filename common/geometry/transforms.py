"""Rigid transforms and rotations: SE(2), SE(3), quaternions.

`T_a_b` is a float64 [4, 4] matrix that transforms coordinates from frame b to frame a, so inner names match
in a product: `T_map_camera = T_map_body @ T_body_camera`. SE(2) poses are float64 [3] (x_m, y_m, yaw_rad) in
the floor plane. Quaternion names contain their order; this project uses wxyz except at external interfaces.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt


def wrap_angle(angle_rad: np.ndarray | float) -> np.ndarray | float:
    """Return the angle(s), in radians, wrapped into [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def se2_to_se3(pose: np.ndarray) -> np.ndarray:
    """Convert SE(2) poses [..., 3] (x_m, y_m, yaw_rad) to SE(3) [..., 4, 4] with z, roll and pitch = 0."""
    pose = np.asarray(pose, dtype=np.float64)
    T = np.zeros((*pose.shape[:-1], 4, 4))
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 3] = cos, -sin, pose[..., 0]
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 3] = sin, cos, pose[..., 1]
    T[..., 2, 2] = T[..., 3, 3] = 1.0
    return T


def se3_to_se2(T: np.ndarray) -> np.ndarray:
    """Project SE(3) transforms [..., 4, 4] to the floor plane: [..., 3] (x_m, y_m, yaw_rad)."""
    T = np.asarray(T, dtype=np.float64)
    return np.stack([T[..., 0, 3], T[..., 1, 3], yaw_of(T)], axis=-1)


def yaw_of(T: np.ndarray) -> np.ndarray:
    """Return the yaw (rad) of transforms [..., 4, 4] or rotations [..., 3, 3].

    Yaw is the angle of the rotated x axis in the x-y plane.
    """
    return np.arctan2(T[..., 1, 0], T[..., 0, 0])


def inverse(T: np.ndarray) -> np.ndarray:
    """Return the inverse of rigid transforms [..., 4, 4], by transposing the rotations."""
    T = np.asarray(T, dtype=np.float64)
    R_T = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_T
    out[..., :3, 3] = -(R_T @ T[..., :3, 3:4])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform_points(T_a_b: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Transform points [N, 3] from frame b to frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def make_transform(R: np.ndarray, translation_m: np.ndarray) -> np.ndarray:
    """Return the transform float64 [4, 4] of a rotation [3, 3] and a translation [3]."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = translation_m
    return T


def is_rigid(T: np.ndarray, tolerance: float = 1e-6) -> bool:
    """Return whether T is a finite [4, 4] matrix with a right-handed rotation and last row 0 0 0 1."""
    T = np.asarray(T)
    if T.shape != (4, 4):
        return False
    # Python scalars: this runs for every pose on the bus, and NumPy comparisons take ten times as long.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = T.tolist()
    if last != [0.0, 0.0, 0.0, 1.0] or not all(map(math.isfinite, (x, y, z))):
        return False
    faults = (
        a * a + d * d + g * g - 1.0, b * b + e * e + h * h - 1.0, c * c + f * f + i * i - 1.0,
        a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i,
        a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) - 1.0,
    )  # fmt: skip
    return all(abs(fault) <= tolerance for fault in faults)  # a NaN fails every comparison


def skew(v: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] with skew(v) @ w == cross(v, w)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(rotation_vector_rad: npt.ArrayLike) -> np.ndarray:
    """Return the rotation [3, 3] of a rotation vector [3] (Rodrigues' formula)."""
    w = np.asarray(rotation_vector_rad, dtype=np.float64)
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < 1e-8:  # Taylor series: the quotients below cancel near zero
        return np.eye(3) + W + 0.5 * W @ W
    return np.eye(3) + np.sin(angle) / angle * W + (1.0 - np.cos(angle)) / angle**2 * (W @ W)


def so3_log(R: np.ndarray) -> np.ndarray:
    """Return the rotation vector [3] (radians, length in [0, pi]) of a rotation [3, 3]."""
    quat = quat_wxyz_from_matrix(R)
    if quat[0] < 0.0:
        quat = -quat
    sin_half = float(np.linalg.norm(quat[1:]))
    if sin_half < 1e-12:
        return 2.0 * quat[1:]
    return 2.0 * np.arctan2(sin_half, quat[0]) / sin_half * quat[1:]


def se3_exp(tangent: np.ndarray) -> np.ndarray:
    """Return the SE(3) exponential [4, 4] of a tangent [6] = (rho, phi), translation part first."""
    rho, phi = np.asarray(tangent[:3], dtype=np.float64), np.asarray(tangent[3:], dtype=np.float64)
    return make_transform(so3_exp(phi), _left_jacobian(phi) @ rho)


def se3_log(T: np.ndarray) -> np.ndarray:
    """Return the tangent [6] = (rho, phi) of T [4, 4], with se3_exp(tangent) == T; rotation below pi rad."""
    phi = so3_log(T[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(phi), T[:3, 3]), phi])


def _left_jacobian(phi: np.ndarray) -> np.ndarray:
    angle = float(np.linalg.norm(phi))
    W = skew(phi)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * W + W @ W / 6.0
    return np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * (W @ W)


def quat_wxyz_from_matrix(R: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation [3, 3] (Shepperd's method)."""
    R = np.asarray(R, dtype=np.float64)
    trace = np.trace(R)
    squares = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    largest = int(np.argmax(squares))
    if largest == 0:
        quat = np.array([1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quat = np.empty(4)
        quat[0] = R[k, j] - R[j, k]
        quat[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        quat[1 + j] = R[j, i] + R[i, j]
        quat[1 + k] = R[k, i] + R[i, k]
    quat /= np.linalg.norm(quat)
    return -quat if quat[0] < 0.0 else quat


def matrix_from_quat_wxyz(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion (w, x, y, z), which need not be normalised.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    quat = np.asarray(quat_wxyz, dtype=np.float64)
    norm = float(np.linalg.norm(quat))
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"quaternion {quat.tolist()} is not a rotation")
    w, x, y, z = quat / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_xyzw_from_matrix(R: np.ndarray) -> np.ndarray:
    """Return the quaternion (x, y, z, w) of a rotation [3, 3]: the order of ROS, TUM files and rerun only."""
    return np.roll(quat_wxyz_from_matrix(R), -1)


def matrix_from_quat_xyzw(quat_xyzw: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion (x, y, z, w): the order of ROS, TUM files and rerun only."""
    return matrix_from_quat_wxyz(np.roll(np.asarray(quat_xyzw, dtype=np.float64), 1))


def interpolate(T_a_b0: np.ndarray, T_a_b1: np.ndarray, fraction: float) -> np.ndarray:
    """Interpolate between two poses: translation linear, rotation on the geodesic.

    `fraction` 0 returns `T_a_b0`, 1 returns `T_a_b1`; values outside [0, 1] extrapolate.
    """
    R_01 = T_a_b0[:3, :3].T @ T_a_b1[:3, :3]
    R = T_a_b0[:3, :3] @ so3_exp(fraction * so3_log(R_01))
    return make_transform(R, (1.0 - fraction) * T_a_b0[:3, 3] + fraction * T_a_b1[:3, 3])
