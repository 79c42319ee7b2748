"""Eight hours of operation in the same rooms: constant memory and time per scan; run by `make soak`."""

import gc
import time
from pathlib import Path

import numpy as np
import pytest

from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from tests.services.localization.world import RayCastLidar, SimulatedDrive

RATE_HZ = 10.0


def resident_mb() -> float:
    """Return the resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def lap_of_ranges(lidar: RayCastLidar) -> np.ndarray:
    """Return noise-free ranges float32 [T, N] of the middle one of three laps, so that its ends meet."""
    drive, quiet = SimulatedDrive(laps=3), RayCastLidar(beams=lidar.beams, sigma_m=0.0)
    lap_s = drive.duration_s / 3.0
    times = lap_s + np.arange(round(lap_s * RATE_HZ)) / RATE_HZ
    return np.array([quiet.scan(drive, t) for t in times])


def drive_for(scans: int, parts: int = 20) -> tuple[np.ndarray, np.ndarray, LidarSlam]:
    """Return CPU milliseconds per scan and resident MB at the end of each part, and the SLAM."""
    lidar, rng = RayCastLidar(), np.random.default_rng(0)
    lap = lap_of_ranges(lidar)
    slam = LidarSlam(LidarSlamSettings(), np.eye(4))
    cost_ms, memory_mb, began = [], [], time.process_time()
    with JobRunner(slam) as jobs:
        for i in range(scans):
            noise = 0.01 * rng.standard_normal(lidar.beams, dtype=np.float32)
            jobs.before_scan()
            result = slam.add_scan(
                10**15 + round(i / RATE_HZ * 1e9), lap[i % len(lap)] + noise, *lidar.arguments()
            )
            jobs.after_scan(result)
            if (i + 1) % (scans // parts) == 0:
                gc.collect()
                cost_ms.append((time.process_time() - began) / (scans // parts) * 1e3)
                memory_mb.append(resident_mb())
                began = time.process_time()
    return np.array(cost_ms), np.array(memory_mb), slam


@pytest.mark.soak
def test_eight_hours_in_the_same_rooms():
    cost_ms, memory_mb, slam = drive_for(8 * 3600 * int(RATE_HZ))
    print(
        f"\nms a scan: {np.round(cost_ms, 2)}\nMB: {np.round(memory_mb)}\nsubmaps: {len(slam.pose_graph.submaps)}"
    )
    # The first quarter fills the rooms; after it only the poses of the scans themselves may be added.
    later = slice(len(cost_ms) // 4, None)
    assert memory_mb[-1] - memory_mb[later][0] < 120.0
    assert cost_ms[later].max() < 1.5 * np.median(cost_ms[later])
    assert cost_ms[-3:].mean() < 1.2 * cost_ms[later][:3].mean()
