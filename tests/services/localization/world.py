"""A simulated flat with known walls and a lidar: ground truth for the SLAM tests."""

import numpy as np

from beamsplat.services.localization.lidar2d import se2

# Two rooms, a door between them, a box, a pillar and a slanted wall; metres.
WALLS = np.array(
    [
        [0, 0, 9, 0],
        [9, 0, 9, 6],
        [9, 6, 0, 6],
        [0, 6, 0, 0],
        [4.5, 0, 4.5, 2.2],
        [4.5, 3.4, 4.5, 6],
        [1, 4.2, 2.2, 4.2],
        [2.2, 4.2, 2.2, 5.1],
        [2.2, 5.1, 1, 5.1],
        [1, 5.1, 1, 4.2],
        [7.2, 1.5, 7.5, 1.5],
        [7.5, 1.5, 7.5, 1.8],
        [7.5, 1.8, 7.2, 1.8],
        [7.2, 1.8, 7.2, 1.5],
        [8, 6, 9, 4.5],
        [0, 1.2, 0.6, 0.6],
        [3.0, 0, 3.0, 0.7],
    ],
    dtype=float,
)


def cast(origins: np.ndarray, angles: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Return the range of each ray (origin [N, 2], angle [N]) to the nearest wall [S, 4], else inf."""
    d = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    a, e = walls[None, :, :2], walls[None, :, 2:] - walls[None, :, :2]
    cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    w = a - origins[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (w[..., 0] * e[..., 1] - w[..., 1] * e[..., 0]) / cross
        u = (w[..., 0] * d[..., 1] - w[..., 1] * d[..., 0]) / cross
    t = np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf)
    return t.min(axis=1)


def box(x: float, y: float, size: float) -> np.ndarray:
    """Return the four walls of a square object."""
    a, b, c, d = x - size / 2, y - size / 2, x + size / 2, y + size / 2
    return np.array([[a, b, c, b], [c, b, c, d], [c, d, a, d], [a, d, a, b]])


class RayCastLidar:
    """A lidar with up to a full turn of beams, each at its own time."""

    def __init__(
        self, beams=360, fov=2 * np.pi, rate_hz=10.0, sigma_m=0.01, seed=0, sweep=True, range_max=12.0
    ):
        self.beams, self.increment, self.angle_min = beams, fov / beams, -fov / 2
        self.dt = 1.0 / rate_hz / beams if sweep else 0.0
        self.sigma_m, self.range_max, self.rng = sigma_m, range_max, np.random.default_rng(seed)

    def scan(self, pose_at, t: float, walls: np.ndarray = WALLS) -> np.ndarray:
        """Return ranges float32 [N] of a scan with its first beam at time t.

        `pose_at` maps times [N] to poses [N, 3].
        """
        poses = pose_at(t + np.arange(self.beams) * self.dt)
        angles = poses[:, 2] + self.angle_min + np.arange(self.beams) * self.increment
        ranges = cast(poses[:, :2], angles, walls) + self.sigma_m * self.rng.standard_normal(self.beams)
        return np.where(ranges < self.range_max, ranges, np.inf).astype(np.float32)

    def arguments(self) -> tuple[float, float, float, float, float]:
        """Return angle_min, angle_increment, time_increment, range_min, range_max."""
        return self.angle_min, self.increment, self.dt, 0.1, self.range_max


LOOP = np.array(
    [
        [1.2, 1.8],
        [3.6, 1.6],
        [4.5, 2.8],
        [6.0, 3.0],
        [8.0, 2.6],
        [8.2, 4.0],
        [6.5, 5.0],
        [5.2, 3.6],
        [4.5, 2.8],
        [3.4, 3.2],
        [3.2, 5.2],
        [2.8, 3.6],
        [1.2, 3.2],
        [0.9, 2.3],
        [1.2, 1.8],
    ]
)


class SimulatedDrive:
    """A smooth path of `laps` rounds through the flat at constant speed."""

    def __init__(self, speed_m_s=0.5, laps=1):
        points = np.concatenate([LOOP] + [LOOP[1:]] * (laps - 1))
        corner = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        s = np.arange(0, corner[-1], 0.02)
        xy = np.stack([np.interp(s, corner, points[:, 0]), np.interp(s, corner, points[:, 1])], axis=1)
        kernel = np.hanning(41) / np.hanning(41).sum()
        pad = np.pad(xy, ((20, 20), (0, 0)), mode="edge")
        xy = np.stack([np.convolve(pad[:, i], kernel, "valid") for i in range(2)], axis=1)
        yaw = np.unwrap(np.arctan2(*np.gradient(xy, axis=0).T[::-1]))
        yaw = np.convolve(np.pad(yaw, 20, mode="edge"), kernel, "valid")
        self._s, self._table, self._speed = s, np.column_stack([xy, yaw]), speed_m_s
        self.duration_s = float(s[-1] / speed_m_s)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Return poses float64 [N, 3] in the world frame."""
        s = np.clip(np.asarray(t) * self._speed, 0, self._s[-1])
        pose = np.stack([np.interp(s, self._s, self._table[:, i]) for i in range(3)], axis=1)
        pose[:, 2] = se2.wrap_many(pose[:, 2])
        return pose


def wheels(drive, times: np.ndarray, scale=1.02, drift_rad_s=0.002) -> np.ndarray:
    """Return odometry poses [N, 3] with a scale error `scale` and a yaw drift `drift_rad_s`."""
    truth = drive(times)
    steps = se2.between_many(truth[:-1], truth[1:])
    steps[:, :2] *= scale
    steps[:, 2] += drift_rad_s * np.diff(times)
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)
