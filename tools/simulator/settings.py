"""Everything that decides what a simulated recording is, in frozen settings with plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import make_transform, so3_exp

START_NS = 1_767_225_600_000_000_000  # stamp of the first moment; any fixed date does


@dataclass(frozen=True)
class CameraSettings:
    """A rigid camera. The focal length follows the width: fx = fy = focal_widths * width."""

    width_px: int = 640
    height_px: int = 480
    rate_hz: float = 10.0
    focal_widths: float = 530.0 / 640.0
    x_m: float = 0.10
    y_m: float = 0.0
    z_m: float = 0.45
    pitch_down_rad: float = float(np.radians(2.0))
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # plumb_bob
    noise: float = 1.0  # times the sensor's own; 0 = none
    vignetting: float = 0.12
    jpeg_quality: int = 92
    phase_s: float = 0.035  # of the first image after the start

    @property
    def K(self) -> np.ndarray:
        """float64 [3, 3]."""
        f = self.focal_widths * self.width_px
        cx, cy = (self.width_px - 1) / 2.0, (self.height_px - 1) / 2.0
        return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])

    @property
    def T_body_camera(self) -> np.ndarray:
        return camera_mount(self.x_m, self.y_m, self.z_m, pitch_down_rad=self.pitch_down_rad)


@dataclass(frozen=True)
class LidarSettings:
    """A spinning planar lidar: beam i is taken i * time_increment after the stamp."""

    beams: int = 720
    rate_hz: float = 10.0
    range_min_m: float = 0.12
    range_max_m: float = 12.0
    noise_m: float = 0.01
    dropout: float = 0.003
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.18
    glass: bool = False  # glazed doors let some beams through
    glass_pass: float = 0.7
    phase_s: float = 0.020

    @property
    def angle_min_rad(self) -> float:
        return -np.pi

    @property
    def angle_increment_rad(self) -> float:
        return 2.0 * np.pi / self.beams

    @property
    def scan_time_s(self) -> float:
        return 1.0 / self.rate_hz

    @property
    def time_increment_s(self) -> float:
        return self.scan_time_s / self.beams

    @property
    def T_body_lidar(self) -> np.ndarray:
        return lidar_mount(self.x_m, self.y_m, self.z_m)


@dataclass(frozen=True)
class WheelSettings:
    """Odometry that counts wheel turns with wrong wheel sizes and a wrong track."""

    rate_hz: float = 50.0
    scale_error: tuple[float, float] = (0.018, 0.026)  # magnitude drawn from here, sign too
    turn_error: tuple[float, float] = (0.003, 0.008)
    noise: float = 0.01  # relative deviation of each increment


@dataclass(frozen=True)
class Faults:
    """What is wrong with the recording on purpose."""

    clock_offset_ms: float = 0.0  # added to the camera's stamps
    extrinsic_xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # published minus true camera mount
    extrinsic_yaw_deg: float = 0.0
    extrinsic_pitch_deg: float = 0.0
    extrinsic_roll_deg: float = 0.0
    exposure_changes: bool = False

    def published(self, T_body_camera: np.ndarray) -> np.ndarray:
        """The camera mount the recording's tf claims: the true one moved and turned in the body frame."""
        yaw, pitch, roll = np.radians(
            [self.extrinsic_yaw_deg, self.extrinsic_pitch_deg, self.extrinsic_roll_deg]
        )
        R = so3_exp([0.0, 0.0, yaw]) @ so3_exp([0.0, pitch, 0.0]) @ so3_exp([roll, 0.0, 0.0])
        return make_transform(
            R @ T_body_camera[:3, :3], T_body_camera[:3, 3] + np.array(self.extrinsic_xyz_m)
        )

    def gain_at(self, time_s: float) -> float:
        """Factor on the exposure at a time of the lap: slow waves and one sudden step."""
        if not self.exposure_changes:
            return 1.0
        wave = 0.35 * np.sin(2 * np.pi * time_s / 11.0) + 0.2 * np.sin(2 * np.pi * time_s / 3.7)
        return float(2.0 ** (wave + (0.5 if time_s % 24.0 > 16.0 else 0.0)))


@dataclass(frozen=True)
class Simulation:
    """One recording."""

    seed: int = 0
    seconds: float | None = None  # None: whole laps
    laps: int | None = None  # None: as many as the seconds need, at least one
    people: int = 0
    carts: int = 0
    scene: str | None = None  # a glTF/GLB file instead of the generated home
    lidar_only: bool = False
    extra_views: int = 40
    surface_points: int = 250_000
    camera: CameraSettings = field(default_factory=CameraSettings)
    lidar: LidarSettings = field(default_factory=LidarSettings)
    wheels: WheelSettings = field(default_factory=WheelSettings)
    faults: Faults = field(default_factory=Faults)
    truth_every: int = 8  # images between depth maps
