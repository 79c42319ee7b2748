"""Lidar SLAM on NumPy arrays: drive a simulated lidar around a hall, compare the trajectory with the truth.

python examples/lidar_slam.py
"""

import numpy as np

from beamsplat import JobRunner, LidarSlam, LidarSlamSettings

BEAMS, RATE_HZ, SPEED_M_S = 360, 10.0, 0.6
INCREMENT_RAD = 2 * np.pi / BEAMS
# A hall of 12 x 8 m with two pillars; walls as segments x0, y0, x1, y1 in metres.
WALLS = [(0, 0, 12, 0), (12, 0, 12, 8), (12, 8, 0, 8), (0, 8, 0, 0)]
for x, y in ((4.0, 4.0), (8.0, 3.5)):
    WALLS += [
        (x, y, x + 0.6, y),
        (x + 0.6, y, x + 0.6, y + 0.6),
        (x + 0.6, y + 0.6, x, y + 0.6),
        (x, y + 0.6, x, y),
    ]


def pose_at(t_s: float) -> tuple[float, float, float]:
    """Return the true pose x, y, yaw: an ellipse around the pillars, started from standstill."""
    angle = SPEED_M_S / 3.5 * (t_s - 1.0 if t_s > 2.0 else t_s**2 / 4.0)
    x, y = 6.0 + 4.5 * np.cos(angle), 4.0 + 2.6 * np.sin(angle)
    return x, y, np.arctan2(2.6 * np.cos(angle), -4.5 * np.sin(angle))


def scan_at(t_s: float, rng: np.random.Generator) -> np.ndarray:
    """Return the ranges float32 [BEAMS] of one revolution; each beam is measured at its own time."""
    ranges = np.full(BEAMS, np.inf)
    segments = np.array(WALLS, dtype=float)
    start, edge = segments[:, :2], segments[:, 2:] - segments[:, :2]
    for i in range(BEAMS):
        x, y, yaw = pose_at(t_s + i / BEAMS / RATE_HZ)
        direction = np.array(
            [np.cos(yaw - np.pi + i * INCREMENT_RAD), np.sin(yaw - np.pi + i * INCREMENT_RAD)]
        )
        to_start = start - (x, y)
        cross = direction[0] * edge[:, 1] - direction[1] * edge[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (to_start[:, 0] * edge[:, 1] - to_start[:, 1] * edge[:, 0]) / cross
            across = (to_start[:, 0] * direction[1] - to_start[:, 1] * direction[0]) / cross
        hit = along[(along > 0) & (across >= 0) & (across <= 1)]
        ranges[i] = hit.min(initial=np.inf) + rng.normal(0.0, 0.01)
    return ranges.astype(np.float32)


def main() -> float:
    """Run the SLAM and return the RMSE of its positions in metres, both trajectories starting at one pose."""
    rng = np.random.default_rng(0)
    slam = LidarSlam(LidarSlamSettings(), T_body_lidar=np.eye(4))
    stamps_s = np.arange(0.0, 38.0, 1.0 / RATE_HZ)
    with JobRunner(slam) as jobs:  # runs loop closure and optimisation
        for t_s in stamps_s:
            jobs.before_scan()
            result = slam.add_scan(
                round(t_s * 1e9), scan_at(t_s, rng), angle_min_rad=-np.pi, angle_increment_rad=INCREMENT_RAD,
                time_increment_s=1.0 / RATE_HZ / BEAMS, range_min_m=0.1, range_max_m=20.0,
            )  # fmt: skip
            jobs.after_scan(result)
        jobs.finish()
    stamps_ns, poses, _ = slam.trajectory()
    truth = np.array([pose_at(stamp_ns * 1e-9) for stamp_ns in stamps_ns])
    x, y, yaw = truth[0]  # the map frame is the first pose
    to_map = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    error_m = poses[:, :2] - (truth[:, :2] - (x, y)) @ to_map.T
    rmse_m = float(np.sqrt(np.mean(np.sum(error_m**2, axis=1))))
    grid = slam.grid(resolution_m=0.05)
    height, width = grid.values.shape
    print(f"{len(stamps_ns)} poses, RMSE {rmse_m:.3f} m, occupancy grid of {width} x {height} cells")
    return rmse_m


if __name__ == "__main__":
    main()
