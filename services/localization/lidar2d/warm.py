"""Compilation of all kernels of the lidar SLAM, so that the service does not compile them at run time."""

from __future__ import annotations

import numpy as np

from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam

_BEAMS, _SCANS = 360, 80
_HALF_M = (3.0, 2.0)  # half sides of the room


def warm() -> None:
    """Run every kernel once: map a small rectangular room, optimise, render the grid, relocalize."""
    slam = LidarSlam(LidarSlamSettings(), np.eye(4))
    angles = -np.pi + np.arange(_BEAMS) * (2.0 * np.pi / _BEAMS)
    with JobRunner(slam) as jobs:
        for i in range(_SCANS):
            jump = 0.35 if i >= _SCANS - 5 else 0.0  # away from the prediction, to run the correlative search
            turn = 2.0 * np.pi * i / _SCANS + jump
            x, y, yaw = np.cos(turn), 0.7 * np.sin(turn), turn + np.pi / 2.0
            stamp_ns = 10**9 + i * 10**8
            if not jump:
                slam.add_odometry(stamp_ns, x, y, yaw)
            jobs.before_scan()
            ranges = _room_ranges(x, y, angles + yaw)
            ranges.setflags(write=bool(i % 2))  # those of messages are views of received bytes
            result = slam.add_scan(stamp_ns, ranges, angles[0], angles[1] - angles[0], 1e-5, 0.1, 20.0)
            jobs.after_scan(result)
        jobs.finish()
    slam.grid()
    slam.relocalize(ranges, angles[0], angles[1] - angles[0], 0.1, 20.0)


def _room_ranges(x_m: float, y_m: float, directions_rad: np.ndarray) -> np.ndarray:
    """Return the distance to the nearest wall in each direction, float32 [N]."""
    dx, dy = np.cos(directions_rad), np.sin(directions_rad)
    with np.errstate(divide="ignore"):
        to_x = np.where(dx > 0.0, (_HALF_M[0] - x_m) / dx, (-_HALF_M[0] - x_m) / dx)
        to_y = np.where(dy > 0.0, (_HALF_M[1] - y_m) / dy, (-_HALF_M[1] - y_m) / dy)
    return np.minimum(to_x, to_y).astype(np.float32)
