"""Extrinsic calibration of camera and planar lidar with a chessboard: yaw and the offsets in the scan plane.

The chessboard is a plane in the camera frame; lidar returns from the board are points on this plane. For a
lidar that is level with the camera, the yaw angle and the offsets to the right and forward are observable.
The height and small tilts of the lidar move the points within the plane and are not observable.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import R_body_camera_level
from beamsplat.common.geometry.transforms import make_transform, so3_exp, transform_points

_GAP_M = 0.05  # largest distance of neighbouring beams on one board
_SIGMA_M = 0.008  # standard deviation of a lidar range


@dataclass(frozen=True)
class BoardPair:
    """One chessboard plane (camera frame) and the lidar scan of the same time (lidar frame)."""

    normal_camera: np.ndarray  # float64 [3], unit
    offset_m: float  # normal . point = offset
    centre_camera: np.ndarray  # float64 [3]
    half_width_m: float  # of the board along the scan line, approximate
    points_lidar: np.ndarray  # float64 [N, 3]


@dataclass(frozen=True)
class BoardCalibration:
    """Pose of the lidar in the camera frame with standard errors and residuals; see `solve_board`."""

    T_camera_lidar: np.ndarray
    yaw_rad: float  # of the lidar against the camera's forward direction, to the left
    x_m: float  # of the lidar in the camera, to the right
    z_m: float  # of the lidar in the camera, forward
    sigma: np.ndarray  # float64 [3]: standard errors of (yaw rad, x m, z m)
    rms_m: float  # point-to-plane distance of the beams
    beams: int
    on_board: tuple[np.ndarray, ...]  # indices of all beams on each board


def chessboard_plane(
    grey: np.ndarray, camera: Pinhole, corners: tuple[int, int], square_m: float
) -> tuple[np.ndarray, float, np.ndarray, float] | None:
    """Return the plane of a chessboard in the camera frame; None if no chessboard is found in the image.

    Args:
        grey: uint8 [H, W], with lens distortion as described by `camera`.
        camera: camera model of the image.
        corners: number of inner corners (columns, rows).
        square_m: side of one square.

    Returns:
        Unit normal n float64 [3]; offset (m) with n . p = offset; centre of the inner corners float64 [3], m;
        RMS reprojection error (px).
    """
    found, uv = cv2.findChessboardCornersSB(grey, corners, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        return None
    uv = uv.reshape(-1, 2).astype(np.float64)  # OpenCV 4 and 5 shape it differently
    grid = np.zeros((corners[0] * corners[1], 3))
    grid[:, :2] = np.mgrid[: corners[0], : corners[1]].T.reshape(-1, 2) * square_m
    rays = camera.rays(uv)
    ok, rotation, translation = cv2.solvePnP(grid, np.ascontiguousarray(rays[:, :2]), np.eye(3), None)
    if not ok:
        return None
    R = cv2.Rodrigues(rotation)[0]
    in_camera = grid @ R.T + translation[:, 0]
    back, _ = camera.project(in_camera)
    rms = float(np.sqrt(np.mean(np.sum((back - uv) ** 2, axis=1))))
    normal = R[:, 2]
    return normal, float(normal @ translation[:, 0]), in_camera.mean(axis=0), rms


def level_mount(yaw_rad: float, x_m: float, y_m: float, z_m: float) -> np.ndarray:
    """Return `T_camera_lidar` [4, 4] of a lidar level with the camera and rotated by `yaw_rad` to the left.

    `x_m`, `y_m`, `z_m`: position of the lidar in the optical frame (right, down, forward).
    """
    R_lidar_level = so3_exp([0.0, 0.0, yaw_rad])
    return make_transform(R_body_camera_level.T @ R_lidar_level, np.array([x_m, y_m, z_m]))


def solve_board(
    pairs: list[BoardPair], start: tuple[float, float, float], y_m: float = 0.0, rounds: int = 14
) -> BoardCalibration:
    """Estimate yaw, x and z of the lidar in the camera frame by minimising point-to-plane distances.

    Each of the `rounds` first selects the beams on each board with the present estimate, then runs Gauss-
    Newton.

    Args:
        pairs: at least two boards of different orientation.
        start: initial values (yaw rad, x m, z m), correct to a few degrees and centimetres.
        y_m: position of the lidar below the camera, which is not observable from the boards.
        rounds: number of rounds.

    Raises:
        ValueError: too few beams on the boards with these initial values, or all boards are parallel.
    """
    x = np.array(start, dtype=np.float64)
    on_board: list[np.ndarray] = []
    for number in range(rounds):
        reach = max(0.20 * 0.7**number, 0.015)
        on_board = [_beams_on_board(pair, level_mount(x[0], x[1], y_m, x[2]), reach) for pair in pairs]
        if sum(len(i) for i in on_board) < 20:
            raise ValueError("too few beams fall on the boards; check the start values and the rig")
        for _ in range(5):
            r, J = _linear(pairs, on_board, x, y_m)
            weight = 1.0 / (1.0 + (r / (3.0 * _SIGMA_M)) ** 2)
            H = J.T @ (J * weight[:, None])
            if np.linalg.cond(H) > 1e7:
                raise ValueError("all boards face the same way: turn the board between images")
            x -= np.linalg.solve(H, J.T @ (weight * r))
    r, J = _linear(pairs, on_board, x, y_m)
    variance = float(r @ r) / max(len(r) - 3, 1)
    # Beams on one board share the error of its plane: their effective number is one tenth.
    sigma = np.sqrt(np.diag(np.linalg.inv(J.T @ J)) * variance * 10.0)
    T = level_mount(x[0], x[1], y_m, x[2])
    # The chessboard pattern may be off the centre of the board: take the beams up to the edges of the board.
    whole = [_beams_on_board(pair, T, 0.015, widen=1.8) for pair in pairs]
    return BoardCalibration(
        T,
        float(x[0]),
        float(x[1]),
        float(x[2]),
        sigma,
        float(np.sqrt(np.mean(r**2))),
        len(r),
        tuple(whole),
    )


def _linear(
    pairs: list[BoardPair], on_board: list[np.ndarray], x: np.ndarray, y_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return point-to-plane distances [M], m, and their derivatives [M, 3] by (yaw rad, x m, z m)."""

    def distances(x: np.ndarray) -> np.ndarray:
        T = level_mount(x[0], x[1], y_m, x[2])
        return np.concatenate([
            transform_points(T, pair.points_lidar[i]) @ pair.normal_camera - pair.offset_m
            for pair, i in zip(pairs, on_board)
        ])  # fmt: skip

    r = distances(x)
    J = np.stack([(distances(x + step) - r) / 1e-6 for step in np.eye(3) * 1e-6], axis=1)
    return r, J


def _beams_on_board(
    pair: BoardPair, T_camera_lidar: np.ndarray, reach_m: float, widen: float = 1.0
) -> np.ndarray:
    """Return the indices of the longest run of neighbouring beams near the plane and centre of the board."""
    points = transform_points(T_camera_lidar, pair.points_lidar)
    half_m = widen * pair.half_width_m
    near = np.abs(points @ pair.normal_camera - pair.offset_m) < reach_m
    near &= np.abs(points[:, 0] - pair.centre_camera[0]) < half_m + 0.5 * reach_m
    near &= np.abs(points[:, 2] - pair.centre_camera[2]) < half_m + reach_m
    index = np.flatnonzero(near)
    if len(index) == 0:
        return index
    angle = np.arctan2(pair.points_lidar[index, 1], pair.points_lidar[index, 0])
    index = index[np.argsort(angle)]
    gaps = np.linalg.norm(np.diff(pair.points_lidar[index], axis=0), axis=1) > _GAP_M
    runs = np.split(index, np.flatnonzero(gaps) + 1)
    return max(runs, key=len)
