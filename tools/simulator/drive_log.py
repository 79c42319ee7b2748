"""Simulates lidar scans, wheel odometry and true poses of any number of laps; renders and writes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.actors import ActorSet
from beamsplat.tools.simulator.lidar import SimulatedLidar, SimulatedRevolution
from beamsplat.tools.simulator.mesh import SceneMesh
from beamsplat.tools.simulator.path import DrivePath
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.settings import START_NS, LidarSettings, WheelSettings
from beamsplat.tools.simulator.wheels import WheelOdometrySimulator, WheelReadings


@dataclass(frozen=True)
class SimulationStep:
    """One lidar revolution of B beams, and the M odometry readings after those of the previous step."""

    stamp_ns: int  # time of the first beam, nanoseconds since 1970
    ranges_m: np.ndarray  # float32 [B], +inf = no return
    moving: np.ndarray  # bool [B], the beam hit a dynamic object
    through_glass: np.ndarray  # bool [B], the beam passed through glass
    T_world_body: np.ndarray  # float64 [4, 4], true pose at the first beam
    odometry_stamps_ns: np.ndarray  # int64 [M], up to the end of this revolution
    odometry: WheelReadings  # at the odometry stamps
    true_pose_world_body: np.ndarray  # float64 [M, 3], true (x, y, yaw) at the odometry stamps


def simulate_lidar(
    mesh: SceneMesh,
    caster: RayCaster,
    drive: DrivePath,
    lidar: LidarSettings,
    wheels: WheelSettings,
    *,
    seed: int,
    duration_s: float,
    actors: ActorSet | None = None,
) -> Iterator[SimulationStep]:
    """Yield one step for each lidar revolution that ends within `duration_s` seconds.

    If a lap takes a whole number of revolutions, noise-free ranges are computed in the first lap and reused
    in all other laps; noise, dropouts and odometry are computed anew in each lap.

    Args:
        mesh: the static scene.
        caster: ray caster of `mesh`.
        drive: path of the robot.
        seed: seed of all random noise.
        duration_s: duration of the recording.
        actors: dynamic objects; None = a static scene.
    """
    simulated_lidar = SimulatedLidar(mesh, caster, lidar)
    wheel_simulator = WheelOdometrySimulator(wheels, np.random.default_rng([seed, 0x57]))
    noise = np.random.default_rng([seed, 0x4C49])
    dynamic_scene = actors if actors is not None and actors.paths else None
    laps: dict[int, SimulatedRevolution] = {}
    per_lap = drive.lap_s * lidar.rate_hz
    repeats = abs(per_lap - round(per_lap)) < 1e-9
    period_ns = round(1e9 / lidar.rate_hz)
    tick_ns = round(1e9 / wheels.rate_hz)
    first_ns, next_tick, end_ns = round(lidar.phase_s * 1e9), 0, round(duration_s * 1e9)
    k = 0
    while first_ns + (k + 1) * period_ns <= end_ns:
        stamp = first_ns + k * period_ns
        at = k % round(per_lap) if repeats else k
        revolution = laps.get(at)
        if revolution is None:
            revolution = simulated_lidar.revolution((stamp / 1e9) % drive.lap_s, drive.pose_at, dynamic_scene)
            if repeats:
                laps[at] = revolution
        ranges, through = simulated_lidar.measure(revolution, noise)
        last_tick = (stamp + period_ns) // tick_ns
        stamps = np.arange(next_tick, last_tick + 1) * tick_ns
        next_tick = last_tick + 1
        truth = drive.pose_at(stamps / 1e9)
        yield SimulationStep(
            START_NS + stamp,
            ranges,
            revolution.moving,
            through,
            drive.transform_at(stamp / 1e9),
            START_NS + stamps,
            wheel_simulator.measure(truth, 1.0 / wheels.rate_hz),
            truth,
        )
        k += 1
