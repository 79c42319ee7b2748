"""The lidar part of a recording: scans, odometry and tf in order of receipt, and their ground truth."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.scans.laser import LaserMessage
from beamsplat.tools.simulator import writer as w
from beamsplat.tools.simulator.drive_log import SimulationStep
from beamsplat.tools.simulator.lidar_drivers import publish
from beamsplat.tools.simulator.settings import START_NS, SimulationSettings

Progress = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True)
class RecordingSummary:
    """Duration, driven distance in metres and number of images, scans, messages and views of a recording."""

    seconds: float
    laps: float
    metres: float
    images: int
    scans: int
    messages: int
    extra_views: int


@dataclass
class TruthLog:
    """Ground truth collected while the lidar stream is written; beam masks are packed, 8 beams per byte."""

    scan_stamps_ns: list[int] = field(default_factory=list)
    moving: list[np.ndarray] = field(default_factory=list)
    through_glass: list[np.ndarray] = field(default_factory=list)
    stamps_ns: list[np.ndarray] = field(default_factory=list)
    truth: list[np.ndarray] = field(default_factory=list)


def transforms(settings: SimulationSettings, duration_s: float) -> Iterator[w.BagRecord]:
    """Yield the mounts of the sensors: once on /tf_static, those on joints again and again on /tf."""
    camera = None
    if not settings.lidar_only:
        camera = settings.faults.published_mount(settings.camera.T_body_camera)
    layout, lidar = settings.layout, settings.lidar.T_body_lidar
    fixed = layout.edges(lidar, camera, joints=False)
    yield w.BagRecord(START_NS, "/tf_static", w.tf_bytes(START_NS, fixed))
    joints = layout.edges(lidar, camera, joints=True)
    if joints:
        for k in range(int(duration_s * layout.joint_rate_hz)):
            stamp = START_NS + round(k * 1e9 / layout.joint_rate_hz)
            yield w.BagRecord(stamp + 1_000_000, "/tf", w.tf_bytes(stamp, joints))


def ideal_message(settings: SimulationSettings, step: SimulationStep, received_ns: int) -> LaserMessage:
    """Return the message of an ideal driver on one revolution."""
    lidar = settings.lidar
    return LaserMessage(
        at_ns=received_ns, stamp_ns=step.stamp_ns, frame_id=settings.layout.lidar_frame,
        angle_min_rad=lidar.angle_min_rad,
        angle_max_rad=lidar.angle_min_rad + (lidar.beams - 1) * lidar.angle_increment_rad,
        angle_increment_rad=lidar.angle_increment_rad, time_increment_s=lidar.time_increment_s,
        scan_time_s=lidar.scan_time_s, range_min_m=lidar.range_min_m, range_max_m=lidar.range_max_m,
        ranges_m=step.ranges_m, intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def lidar_records(
    settings: SimulationSettings,
    steps: Iterator[SimulationStep],
    log: TruthLog,
    progress: Callable[[int], None],
) -> Iterator[w.BagRecord]:
    """Yield scans, odometry and tf in order of receipt; append their ground truth to `log`."""
    rng = np.random.default_rng([settings.drive_seed, 0x4A, 2])
    layout = settings.layout
    period_ns, sweep_ns = round(1e9 / settings.lidar.rate_hz), round(1e9 * settings.lidar.scan_time_s)
    waiting: list[tuple[int, int, w.BagRecord]] = []
    last: dict[str, int] = {}
    number = 0

    def push(topic: str, received: int, data: bytes) -> int:
        nonlocal number
        if not topic:  # the robot has no such topic
            return received
        received = max(received, last.get(topic, 0) + 1000)
        last[topic] = received
        heapq.heappush(waiting, (received, number, w.BagRecord(received, topic, data)))
        number += 1
        return received

    for index, step in enumerate(steps):
        log.scan_stamps_ns.append(step.stamp_ns)
        log.moving.append(np.packbits(step.moving))
        log.through_glass.append(np.packbits(step.through_glass))
        log.stamps_ns.append(step.odometry_stamps_ns)
        log.truth.append(step.true_pose_world_body)
        odometry = step.odometry
        lags = 2e6 + rng.exponential(3e5, len(odometry.pose_odom_body) + 1)
        for k, (stamp, T) in enumerate(
            zip(step.odometry_stamps_ns.tolist(), se2_to_se3(odometry.pose_odom_body))
        ):
            speed, turn = float(odometry.speed_m_s[k]), float(odometry.turn_rad_s[k])
            data = w.odometry_bytes(stamp, T, speed, turn, layout)
            received = push(layout.odometry_topic, stamp + int(lags[k]), data)
            push(layout.raw_odometry_topic, received, data)
            link = (layout.odometry_frame, layout.base_frame, T)
            push("/tf", received + 100, w.tf_bytes(stamp, [link]))
        received = step.stamp_ns + sweep_ns + int(5e6 + 4 * (lags[-1] - 2e6))
        message = publish(settings.driver, ideal_message(settings, step, received), index)
        push(layout.raw_scan_topic, received, w.scan_bytes(message))
        if layout.scan_filter is not None:
            message = layout.scan_filter.apply(message)
        push(layout.scan_topic, received, w.scan_bytes(message))
        # Odometry of later steps is measured after the end of this one: earlier records are complete.
        while waiting and waiting[0][0] <= step.stamp_ns + period_ns:
            yield heapq.heappop(waiting)[2]
        progress(index + 1)
    while waiting:
        yield heapq.heappop(waiting)[2]


def write_lidar_truth(folder: Path, settings: SimulationSettings, log: TruthLog) -> None:
    w.write_camera_json(folder / "camera.json", settings)
    poses = np.concatenate(log.truth) if log.truth else np.zeros((0, 3))
    stamps = np.concatenate(log.stamps_ns) if log.stamps_ns else np.zeros(0, np.int64)
    w.write_tum(folder / "groundtruth.txt", stamps, se2_to_se3(poses))
    np.savez_compressed(
        folder / "beams.npz",
        stamp_ns=np.array(log.scan_stamps_ns, dtype=np.int64),
        moving=_unpack(log.moving, settings.lidar.beams),
        through_glass=_unpack(log.through_glass, settings.lidar.beams),
    )


def _unpack(rows: list[np.ndarray], beams: int) -> np.ndarray:
    """Return the beam masks bool [S, B] of S rows of packed bits."""
    if not rows:
        return np.zeros((0, beams), np.bool_)
    return np.unpackbits(np.stack(rows), axis=1)[:, :beams].astype(np.bool_)
