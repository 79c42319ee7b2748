"""Sensors of simulated training drives: random cameras, lidars and errors of a robot and of a hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import make_transform, so3_exp, transform_points
from beamsplat.tools.simulator.camera import ImageSensor, pixel_rays
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.render import ActorSnapshot, RayTable, ray_table
from beamsplat.tools.training.exposure import Shutter
from beamsplat.tools.training.sample_files import Carrier

WIDTH_PX, HEIGHT_PX = 320, 240
_BEAMS = 720
_RANGE_MIN_M, _RANGE_SIGMA_M, _DROPOUT = 0.12, 0.01, 0.003
_MOUNT_RAD, _MOUNT_M = np.radians(0.12), 0.003  # errors of the published camera mount
_POSE_RAD, _POSE_M = np.radians(0.08), 0.007  # errors of a pose from localization


@dataclass(frozen=True)
class SensorSet:
    """Camera and lidar of one drive, with the mount that is published and with its errors."""

    carrier: Carrier
    camera: Pinhole
    table: RayTable
    sensor: ImageSensor
    shutter: Shutter
    T_body_camera: np.ndarray
    T_body_camera_published: np.ndarray
    T_body_lidar: np.ndarray
    range_max_m: float

    @property
    def planar(self) -> bool:
        """Whether the body stays level on the floor."""
        return self.carrier == "robot"

    def noisy_pose(self, T_world_body: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return a pose as localization would publish it: with errors, in the plane for a robot."""
        rotation, shift = rng.normal(size=3) * _POSE_RAD, rng.normal(size=3) * _POSE_M
        if self.planar:
            rotation[:2], shift[2] = 0.0, 0.0
        return T_world_body @ make_transform(so3_exp(rotation), shift)

    def scan(
        self, caster: RayCaster, actors: ActorSnapshot | None, T_world_body: np.ndarray,
        rng: np.random.Generator,
    ) -> Beams:  # fmt: skip
        """Return a noisy scan of all beams from one pose, in the body frame."""
        angle = -np.pi + 2.0 * np.pi * np.arange(_BEAMS) / _BEAMS
        rays = np.stack([np.cos(angle), np.sin(angle), np.zeros(_BEAMS)], axis=1)
        T_world_lidar = T_world_body @ self.T_body_lidar
        directions = rays @ T_world_lidar[:3, :3].T
        origins = np.broadcast_to(T_world_lidar[:3, 3], directions.shape)
        reach = caster.hit_distance(origins, directions, caster.first_hit(origins, directions))
        if actors is not None:
            hit = actors.caster.first_hit(origins, directions)
            reach = np.minimum(reach, actors.caster.hit_distance(origins, directions, hit))
        reach = reach + _RANGE_SIGMA_M * rng.standard_normal(_BEAMS)
        seen = (reach > _RANGE_MIN_M) & (reach < self.range_max_m) & (rng.random(_BEAMS) > _DROPOUT)
        if not self.planar:  # a scan that was made from a depth image: only beams in view
            seen &= np.abs(angle) < 0.98 * np.arctan(0.5 * WIDTH_PX / self.camera.fx_px)
        index = np.flatnonzero(seen)
        points = transform_points(self.T_body_lidar, rays[index] * reach[index, None])
        return Beams(points, index, np.full(len(index), _RANGE_SIGMA_M))


def random_sensors(carrier: Carrier, rng: np.random.Generator) -> SensorSet:
    """Return random sensors on a robot (camera at 0.22 to 1.2 m), or in a hand (lidar 0.1 m below)."""
    f = float(rng.uniform(0.76, 0.92)) * WIDTH_PX
    cx, cy = (float((side - 1) / 2.0 + rng.normal() * 1.5) for side in (WIDTH_PX, HEIGHT_PX))
    camera = Pinhole(f, f, cx, cy, WIDTH_PX, HEIGHT_PX)
    table = ray_table(pixel_rays(WIDTH_PX, HEIGHT_PX, camera.K))
    sensor = ImageSensor(
        table.rays, noise=float(rng.uniform(0.3, 1.6)), vignetting=float(rng.uniform(0.0, 0.25)),
        quality=int(rng.integers(80, 97)),
    )  # fmt: skip
    rolling = rng.random() < 0.6
    shutter = Shutter(float(rng.uniform(0.002, 0.03)), float(rng.uniform(0.008, 0.025)) if rolling else 0.0)
    T_body_lidar = np.eye(4)
    if carrier == "robot":
        height = rng.uniform(0.35, 0.6) if rng.random() < 0.5 else rng.uniform(0.22, 1.2)
        mount = camera_mount(
            float(rng.uniform(0.0, 0.2)), 0.0, float(height),
            pitch_down_rad=float(rng.normal() * 0.06 + 0.035),
        )  # fmt: skip
        T_body_lidar[:3, 3] = [rng.uniform(-0.1, 0.1), 0.0, rng.uniform(0.1, 0.32)]
    else:
        mount = camera_mount(0.0, 0.0, 0.0)
        T_body_lidar[2, 3] = -0.10 + 0.02 * rng.normal()
    error = make_transform(so3_exp(rng.normal(size=3) * _MOUNT_RAD), rng.normal(size=3) * _MOUNT_M)
    range_max_m = 12.0 if carrier == "robot" else float(rng.uniform(3.3, 8.0))
    return SensorSet(carrier, camera, table, sensor, shutter, mount, mount @ error, T_body_lidar, range_max_m)
