"""The lidar, the wheels and the true path over any number of laps, as a stream: no pictures, no files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.lidar import Lidar, Revolution
from beamsplat.tools.simulator.mesh import Mesh
from beamsplat.tools.simulator.movers import Cast
from beamsplat.tools.simulator.path import Drive
from beamsplat.tools.simulator.settings import START_NS, LidarSettings, WheelSettings
from beamsplat.tools.simulator.wheels import Odometry, Wheels


@dataclass(frozen=True)
class Step:
    """One revolution, and the odometry counted since the one before."""

    stamp_ns: int  # first beam
    ranges_m: np.ndarray  # float32 [B], +inf no return
    moving: np.ndarray  # bool [B], the beam met something that moves
    through_glass: np.ndarray  # bool [B]
    T_world_body: np.ndarray  # float64 [4, 4], truth at the first beam
    odometry_stamps_ns: np.ndarray  # int64 [M], up to the end of this revolution
    odometry: Odometry
    truth_poses: np.ndarray  # float64 [M, 3], SE(2) truth at the odometry stamps


def simulate_lidar(
    mesh: Mesh,
    caster: Caster,
    drive: Drive,
    lidar: LidarSettings,
    wheels: WheelSettings,
    *,
    seed: int,
    duration_s: float,
    cast: Cast | None = None,
) -> Iterator[Step]:
    """Every revolution that is complete within `duration_s`.

    What the beams of a lap meet is cast once; noise, dropouts and odometry are fresh on every lap.
    """
    device = Lidar(mesh, caster, lidar)
    counter = Wheels(wheels, np.random.default_rng([seed, 0x57]))
    noise = np.random.default_rng([seed, 0x4C49])
    movers = cast if cast is not None and cast.walks else None
    laps: dict[int, Revolution] = {}
    per_lap = round(drive.lap_s * lidar.rate_hz)
    period_ns = round(1e9 / lidar.rate_hz)
    tick_ns = round(1e9 / wheels.rate_hz)
    first_ns, next_tick, end_ns = round(lidar.phase_s * 1e9), 0, round(duration_s * 1e9)
    k = 0
    while first_ns + (k + 1) * period_ns <= end_ns:
        stamp = first_ns + k * period_ns
        if k % per_lap not in laps:
            laps[k % per_lap] = device.revolution((stamp / 1e9) % drive.lap_s, drive.pose_at, movers)
        revolution = laps[k % per_lap]
        ranges, through = device.measure(revolution, noise)
        last_tick = (stamp + period_ns) // tick_ns
        stamps = np.arange(next_tick, last_tick + 1) * tick_ns
        next_tick = last_tick + 1
        truth = drive.pose_at(stamps / 1e9)
        yield Step(
            START_NS + stamp,
            ranges,
            revolution.moving,
            through,
            drive.transform_at(stamp / 1e9),
            START_NS + stamps,
            counter.count(truth, 1.0 / wheels.rate_hz),
            truth,
        )
        k += 1
