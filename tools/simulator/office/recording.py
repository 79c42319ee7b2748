"""Simulates a drive through an office floor: scans, odometry and ground truth, in one folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.tools.simulator import store
from beamsplat.tools.simulator import writer as w
from beamsplat.tools.simulator.drive_log import SimulationStep
from beamsplat.tools.simulator.lidar import GRAZING_COSINE, see_robot
from beamsplat.tools.simulator.lidar_records import (
    Progress,
    RecordingSummary,
    TruthLog,
    lidar_records,
    transforms,
    write_lidar_truth,
)
from beamsplat.tools.simulator.office.caster import SegmentGrid, build_grid, cast_revolution
from beamsplat.tools.simulator.office.floor import FloorPlan, build_floor
from beamsplat.tools.simulator.office.lost import LostStretch, choose_stretches
from beamsplat.tools.simulator.office.people import People
from beamsplat.tools.simulator.office.route import plan_route
from beamsplat.tools.simulator.office.settings import OfficeSettings
from beamsplat.tools.simulator.path import DrivePath
from beamsplat.tools.simulator.settings import START_NS, LidarSettings, SimulationSettings
from beamsplat.tools.simulator.wheels import WheelOdometrySimulator

KNOTS = 10  # parts of a revolution with linear motion: at 1 rad/s^2 the error is 1e-5 rad
# A lidar sees a pane of glass only near its normal, and at grazing angles the beam is mirrored away
# (Foster et al. 2013, VisAGGE: Visible Angle Grid for Glass Environments); between, it passes.
GLASS_NORMAL_COSINE, GLASS_GRAZING_COSINE = 0.978, 0.2  # 12 and 78 degrees from the normal
GLASS_NORMAL_RETURN, GLASS_OBLIQUE_RETURN, GLASS_GRAZING_MISS = 0.9, 0.08, 0.8  # probabilities


def simulate_office(
    settings: OfficeSettings, out: Path, *, replace: bool, progress: Progress
) -> RecordingSummary:
    """Simulate a drive and write the folder `out`, which appears only when all files are complete.

    The folder has bag/, groundtruth.txt, camera.json and beams.npz as `recording.simulate` writes them, and
    site.json with the surfaces of the floor and the lost stretches.

    Raises:
        ValueError: the floor or the drive is too small.
        FileExistsError: `out` exists and `replace` is False.
    """
    if out.exists() and not replace:
        raise FileExistsError(f"{out} exists: choose another folder, or replace this one with --force")
    progress("generating the floor and the route", 0, 0)
    floor = build_floor(settings)
    drive = plan_route(floor, settings)
    stretches = choose_stretches(drive, settings.lost, settings.lost_s)
    people = People(floor, settings.people, np.random.default_rng([settings.seed, 0x0F3]))
    common = SimulationSettings(
        seed=settings.seed, lidar_only=True, lidar=settings.lidar, wheels=settings.wheels,
        driver=settings.driver, layout=settings.layout,
    )  # fmt: skip
    log = TruthLog()
    scans = int(drive.lap_s * settings.lidar.rate_hz)
    with store.atomic_folder(out, replace=replace) as folder:
        steps = simulate_steps(settings, build_grid(floor), drive, people, stretches)
        records = lidar_records(common, steps, log, lambda i: progress("scanning", i, scans))
        streams = [transforms(common, drive.lap_s), _without_silent(records, stretches)]
        messages = w.write_bag(folder / "bag", streams, common.layout, camera=False)
        write_lidar_truth(folder, common, log)
        _write_site(folder / "site.json", settings, floor, stretches)
    return RecordingSummary(drive.lap_s, 1.0, drive.length_m, 0, len(log.scan_stamps_ns), messages, 0)


def simulate_steps(
    settings: OfficeSettings,
    grid: SegmentGrid,
    drive: DrivePath,
    people: People,
    stretches: list[LostStretch],
) -> Iterator[SimulationStep]:
    """Yield one step for each revolution of the lidar during the drive."""
    lidar = settings.lidar
    wheels = WheelOdometrySimulator(
        settings.wheels, np.random.default_rng([settings.seed, 0x57]), settings.slips_per_km
    )
    noise = np.random.default_rng([settings.seed, 0x4C49])
    period_ns, tick_ns = round(1e9 / lidar.rate_hz), round(1e9 / settings.wheels.rate_hz)
    blind = [s for s in stretches if s.kind == "blind"]
    hits, moving = np.zeros((lidar.beams, 4)), np.zeros(lidar.beams, dtype=bool)
    next_tick, stamp = 0, round(lidar.phase_s * 1e9)
    part_s = np.arange(KNOTS + 1) / KNOTS * lidar.scan_time_s
    first_rad = lidar.yaw_rad + lidar.angle_min_rad
    while stamp + period_ns <= drive.lap_s * 1e9:
        time_s = stamp / 1e9
        knots = drive.pose_at(time_s + part_s)
        knots[:, 2] = np.unwrap(knots[:, 2])
        middle = 0.5 * (knots[1:] + knots[:-1])
        circles = people.circles(
            time_s + 0.5 * (part_s[1:] + part_s[:-1]), middle[:, :2], lidar.range_max_m + 2.0
        )
        cast_revolution(
            knots, lidar.x_m, lidar.y_m, first_rad, lidar.angle_increment_rad, lidar.range_max_m,
            grid.segments, grid.glass, grid.low_m, *grid.shape, grid.start, grid.index, circles, hits, moving,
        )  # fmt: skip
        ranges, through = measure(hits, lidar, noise)
        if any(s.start_s <= time_s < s.end_s for s in blind):
            ranges = np.full_like(ranges, np.inf)
        last_tick = (stamp + period_ns) // tick_ns
        stamps = np.arange(next_tick, last_tick + 1) * tick_ns
        next_tick = last_tick + 1
        truth = drive.pose_at(stamps / 1e9)
        yield SimulationStep(
            START_NS + stamp,
            ranges,
            moving & np.isfinite(ranges) & ~through,
            through,
            se2_to_se3(knots[0]),
            START_NS + stamps,
            wheels.measure(truth, 1.0 / settings.wheels.rate_hz),
            truth,
        )
        stamp += period_ns


def measure(
    hits: np.ndarray, lidar: LidarSettings, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the measured ranges float32 [B] (+inf = no return), and bool [B]: the beam passed through glass.

    `hits` float64 [B, 4] is the result of `cast_revolution`. The number of draws does not depend on it.
    """
    count = len(hits)
    noise, lost, grazed, glass = rng.standard_normal(count), *rng.random((3, count))
    range_m, cosine, glass_m, glass_cosine = hits.T
    pane = np.isfinite(glass_m)
    normal, grazing = glass_cosine >= GLASS_NORMAL_COSINE, glass_cosine < GLASS_GRAZING_COSINE
    seen = pane & (glass < np.where(normal, GLASS_NORMAL_RETURN, GLASS_OBLIQUE_RETURN)) & ~grazing
    mirrored = pane & grazing & (glass < GLASS_GRAZING_MISS)
    through = pane & ~seen & ~mirrored
    measured = np.where(seen, glass_m, range_m) + lidar.noise_m * noise
    no_return = (lost < lidar.dropout) | mirrored
    if lidar.dropout > 0:
        no_return |= (np.where(seen, 1.0, cosine) < GRAZING_COSINE) & (grazed < 0.5)
    no_return |= ~((measured >= lidar.range_min_m) & (measured <= lidar.range_max_m))
    ranges = np.where(no_return, np.inf, measured).astype(np.float32)
    see_robot(ranges, lidar, noise)
    return ranges, through


def _without_silent(records: Iterator[w.BagRecord], stretches: list[LostStretch]) -> Iterator[w.BagRecord]:
    """Leave out what was received during a silent stretch."""
    spans = [
        (START_NS + round(s.start_s * 1e9), START_NS + round(s.end_s * 1e9))
        for s in stretches
        if s.kind == "silent"
    ]
    for record in records:
        if not any(start <= record.received_ns < end for start, end in spans):
            yield record


def _write_site(path: Path, settings: OfficeSettings, floor: FloorPlan, stretches: list[LostStretch]) -> None:
    """Write the settings, the lost stretches with their stamps, and all surfaces rounded to 1 mm."""
    described = {k: v for k, v in asdict(settings).items() if k not in ("driver", "layout")}  # not JSON: inf
    text = {
        "settings": described,
        "lost": [
            {
                "start_ns": START_NS + round(s.start_s * 1e9),
                "end_ns": START_NS + round(s.end_s * 1e9),
                "kind": s.kind,
            }
            for s in stretches
        ],
        "segments_m": np.round(floor.segments, 3).tolist(),
        "glass": np.flatnonzero(floor.glass).tolist(),
    }
    path.write_text(json.dumps(text) + "\n")
