"""Settings that fully determine a simulated recording: frozen dataclasses of plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.tools.simulator.bag_layout import BagLayout
from beamsplat.tools.simulator.changes import Rearrangement
from beamsplat.tools.simulator.lidar_drivers import IDEAL, RosLidarDriver

START_NS = 1_767_225_600_000_000_000  # stamp at time 0: 2026-01-01 00:00 UTC, an arbitrary fixed date


@dataclass(frozen=True)
class CameraSettings:
    """Settings of the camera, fixed at (x, y, z) in the body frame; fx = focal_widths * width_px."""

    width_px: int = 640
    height_px: int = 480
    rate_hz: float = 10.0
    focal_widths: float = 530.0 / 640.0
    aspect: float = 1.0  # fy / fx
    centre_px: tuple[float, float] | None = None  # principal point; None = the image centre
    x_m: float = 0.10
    y_m: float = 0.0
    z_m: float = 0.45
    pitch_down_rad: float = float(np.radians(2.0))
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3
    noise: float = 1.0  # factor on the standard deviation of the sensor noise; 0 = none
    vignetting: float = 0.12  # v in the falloff 1 / (1 + v r^2), r in normalised image coordinates
    jpeg_quality: int = 92
    phase_s: float = 0.035  # time of the first image after the start

    @property
    def K(self) -> np.ndarray:
        """Intrinsic matrix in pixels, float64 [3, 3]."""
        f = self.focal_widths * self.width_px
        cx, cy = self.centre_px or ((self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0)
        return np.array([[f, 0.0, cx], [0.0, self.aspect * f, cy], [0.0, 0.0, 1.0]])

    @property
    def T_body_camera(self) -> np.ndarray:
        """True pose of the camera in the body frame, float64 [4, 4]."""
        return camera_mount(self.x_m, self.y_m, self.z_m, pitch_down_rad=self.pitch_down_rad)


@dataclass(frozen=True)
class LidarSettings:
    """Settings of a spinning 2D lidar, rigidly mounted at (x, y, z) in the body frame.

    Beam i is measured i * time_increment_s after the scan's stamp.
    """

    beams: int = 720
    rate_hz: float = 10.0
    sweep_s: float | None = None  # duration of a revolution; None = the whole period
    clockwise: bool = False
    angle_min_rad: float = -np.pi  # direction of the first beam in the lidar frame
    range_min_m: float = 0.12
    range_max_m: float = 12.0
    noise_m: float = 0.01  # standard deviation of a range
    dropout: float = 0.003  # probability that a beam has no return
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.18
    yaw_rad: float = 0.0
    # Part of the robot that the lidar sees: first beam, number of beams, range in metres.
    self_returns: tuple[int, int, float] | None = None
    glass: bool = False  # whether beams can pass through glazed doors
    glass_pass: float = 0.7  # probability that a beam passes through glass
    phase_s: float = 0.020  # time of the first scan after the start

    @property
    def angle_increment_rad(self) -> float:
        """Angle between two successive beams, negative for a clockwise lidar."""
        return (-2.0 if self.clockwise else 2.0) * np.pi / self.beams

    @property
    def scan_time_s(self) -> float:
        """Duration of a revolution in seconds."""
        return 1.0 / self.rate_hz if self.sweep_s is None else self.sweep_s

    @property
    def time_increment_s(self) -> float:
        """Time between two successive beams in seconds."""
        return self.scan_time_s / self.beams

    @property
    def T_body_lidar(self) -> np.ndarray:
        """True pose of the lidar in the body frame, float64 [4, 4]."""
        return lidar_mount(self.x_m, self.y_m, self.z_m, yaw_left_rad=self.yaw_rad)


@dataclass(frozen=True)
class WheelSettings:
    """Settings of wheel odometry with systematic errors of wheel radius and track width."""

    rate_hz: float = 50.0
    # Relative errors of distance and of turn: (min, max) of the magnitude; magnitude and sign are random.
    scale_error: tuple[float, float] = (0.018, 0.026)
    turn_error: tuple[float, float] = (0.003, 0.008)
    noise: float = 0.01  # standard deviation of the random error of a 1 cm step, relative to the step


@dataclass(frozen=True)
class Faults:
    """Faults added to the recording on purpose; extrinsic faults change only the published mount."""

    clock_offset_ms: float = 0.0  # added to the stamps of the images
    extrinsic_xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # published minus true camera mount
    extrinsic_yaw_deg: float = 0.0
    extrinsic_pitch_deg: float = 0.0
    extrinsic_roll_deg: float = 0.0
    exposure_changes: bool = False

    def published_mount(self, T_body_camera: np.ndarray) -> np.ndarray:
        """Return the T_body_camera that is published in tf: the true pose with the extrinsic fault added.

        The fault moves the camera by `extrinsic_xyz_m`, and rotates it about its own centre by roll, pitch
        and yaw (in this order) about the axes of the body frame.
        """
        yaw, pitch, roll = np.radians(
            [self.extrinsic_yaw_deg, self.extrinsic_pitch_deg, self.extrinsic_roll_deg]
        )
        R = so3_exp([0.0, 0.0, yaw]) @ so3_exp([0.0, pitch, 0.0]) @ so3_exp([roll, 0.0, 0.0])
        return make_transform(
            R @ T_body_camera[:3, :3], T_body_camera[:3, 3] + np.array(self.extrinsic_xyz_m)
        )

    def exposure_gain_at(self, time_s: float) -> float:
        """Return the exposure factor `time_s` seconds after the lap start.

        Its binary logarithm is the sum of two sine waves and of a step of 0.5 that is on for 8 of every 24 s.
        """
        if not self.exposure_changes:
            return 1.0
        wave = 0.35 * np.sin(2 * np.pi * time_s / 11.0) + 0.2 * np.sin(2 * np.pi * time_s / 3.7)
        return float(2.0 ** (wave + (0.5 if time_s % 24.0 > 16.0 else 0.0)))


@dataclass(frozen=True)
class SimulationSettings:
    """Settings of one recording."""

    seed: int = 0
    drive: int = 0  # number of the drive: another start of the lap, other noise and actors in the same home
    rearrangement: Rearrangement | None = None  # furniture that differs from the home of `seed`
    seconds: float | None = None  # duration; None: all `laps`; with `laps`: the shorter of both
    laps: int | None = None  # number of laps; None: until `seconds`, or one lap if both are None
    people: int = 0
    carts: int = 0
    scene: str | None = None  # a glTF/GLB file instead of the generated home
    lidar_only: bool = False
    extra_views: int = 40  # held-out views off the path
    surface_points: int = 250_000  # points of the ground-truth surface
    camera: CameraSettings = field(default_factory=CameraSettings)
    lidar: LidarSettings = field(default_factory=LidarSettings)
    wheels: WheelSettings = field(default_factory=WheelSettings)
    faults: Faults = field(default_factory=Faults)
    driver: RosLidarDriver = IDEAL
    layout: BagLayout = field(default_factory=BagLayout)
    truth_every: int = 8  # every n-th image has a ground-truth depth map

    @property
    def drive_seed(self) -> int:
        """Seed of all that differs between drives through one home; that of the home for drive 0."""
        return self.seed + 1_000_003 * self.drive
