"""Calibrate the lidar against the camera with views of a chessboard that the beams cross."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import R_body_camera_level
from beamsplat.common.geometry.transforms import inverse, make_transform, se3_to_se2
from beamsplat.common.messages import CameraModel, Scan
from beamsplat.services.fusion.calibration.board import BoardPair, chessboard_plane, solve_board
from beamsplat.tools.setup.chessboard import Chessboard

N_BOARDS = 6  # views
_STILL_M = 0.01  # largest motion of the board between the images before and after the scan
_GOOD_RMS_M, _GOOD_YAW_RAD = 0.02, np.radians(1.0)  # limits of an acceptable result


@dataclass(frozen=True)
class LidarExtrinsics:
    """The calibrated mount of the lidar: yaw and horizontal position; height and tilt are not estimated."""

    T_body_lidar: np.ndarray  # float64 [4, 4]
    yaw_sigma_rad: float
    shift_sigma_m: float
    rms_m: float  # distance of the beams' ends from the boards
    beams: int  # used

    @property
    def is_good(self) -> bool:
        """Whether RMS distance of the beams from the boards and standard error of yaw are small enough.

        The limits are 2 cm and 1 degree.
        """
        return self.rms_m < _GOOD_RMS_M and self.yaw_sigma_rad < _GOOD_YAW_RAD

    @property
    def summary(self) -> str:
        """Position and yaw of the lidar, their standard errors and the residual, in one sentence."""
        x_m, y_m, yaw_rad = se3_to_se2(self.T_body_lidar)
        return (
            f"lidar at {x_m:.3f} m forward, {y_m:.3f} m left, +- {self.shift_sigma_m:.3f}; turned by "
            f"{np.degrees(yaw_rad):.2f} degrees, +- {np.degrees(self.yaw_sigma_rad):.2f}; RMS distance of "
            f"{self.beams} beams from the boards {1e3 * self.rms_m:.1f} mm (height and tilt as measured)"
        )


class LidarBoardCalibration:
    """Calibration of the lidar's mount from views of a chessboard with simultaneous scans.

    Call `add` for at least `N_BOARDS` views, then `solve`.
    """

    def __init__(self, model: CameraModel, board: Chessboard) -> None:
        self._model = model
        self._camera: Pinhole = Pinhole.of(model)
        self._board = board
        # The beams are level even if the camera looks down: planes are expressed in a level camera frame.
        self._T_body_level = make_transform(R_body_camera_level, model.T_body_camera[:3, 3])
        self._R_level_camera = R_body_camera_level.T @ model.T_body_camera[:3, :3]
        self._pairs: list[BoardPair] = []

    @property
    def count(self) -> int:
        """Number of accepted views."""
        return len(self._pairs)

    def add(self, grey_before: np.ndarray, scan: Scan, grey_after: np.ndarray) -> str:
        """Add one view of the board; return whether it was accepted or why it was rejected, as text.

        Args:
            grey_before, grey_after: grey images uint8 [H, W] just before and just after the scan.
            scan: scan of the board, which must not move between the images.
        """
        size = self._board.corners, self._board.square_m
        planes = [chessboard_plane(grey, self._camera, *size) for grey in (grey_before, grey_after)]
        if planes[0] is None or planes[1] is None:
            return "rejected: the board is not completely in the image"
        if np.linalg.norm(planes[0][2] - planes[1][2]) > _STILL_M:
            return "rejected: the board moved, repeat"
        normal, offset_m, centre, _ = planes[1]
        angle = scan.angle_min_rad + scan.angle_increment_rad * np.arange(len(scan.ranges_m))
        seen = np.isfinite(scan.ranges_m)
        plane_points = scan.ranges_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        half_m = 0.5 * (self._board.corners[0] + 1) * self._board.square_m
        R = self._R_level_camera
        self._pairs.append(
            BoardPair(R @ normal, offset_m, R @ centre, half_m, plane_points[:, seen].T.astype(np.float64))
        )
        return f"accepted, distance {np.linalg.norm(centre):.2f} m"

    def solve(self, T_body_lidar: np.ndarray) -> LidarExtrinsics:
        """Estimate the lidar's mount from the accepted views.

        `T_body_lidar` float64 [4, 4] is the start value, correct to a few degrees and centimetres.

        Raises:
            ValueError: no beams are on the boards, or all boards have the same orientation.
        """
        T = inverse(self._T_body_level) @ T_body_lidar
        start = (float(np.arctan2(-T[0, 0], T[2, 0])), float(T[0, 3]), float(T[2, 3]))
        found = solve_board(self._pairs, start, float(T[1, 3]))
        return LidarExtrinsics(
            self._T_body_level @ found.T_camera_lidar, float(found.sigma[0]), float(np.max(found.sigma[1:])),
            found.rms_m, found.beams,
        )  # fmt: skip
