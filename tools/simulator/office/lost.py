"""Stretches of a drive without measurements, placed where the robot drives into unknown space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from beamsplat.tools.simulator.path import DrivePath

KINDS = ("silent", "blind")  # no scans and no odometry; or scans without returns, with odometry
KNOWN_M = 4.0  # space within this distance of the earlier path is known
STEP_S = 1.0
AFTER_S = 15.0  # the space stays unknown for at least so long after the stretch


@dataclass(frozen=True)
class LostStretch:
    """Seconds since the start of the drive, start included, end excluded."""

    start_s: float
    end_s: float
    kind: str  # one of KINDS


def choose_stretches(drive: DrivePath, count: int, duration_s: float) -> list[LostStretch]:
    """Return `count` stretches of `duration_s` seconds, as far apart as possible, kinds in turn.

    During the second half of each and AFTER_S seconds after it, the robot is in space that it did not see
    before.

    Raises:
        ValueError: the drive has too few places of this kind.
    """
    if count == 0:
        return []
    xy = drive.pose_at(np.arange(0.0, drive.lap_s, STEP_S))[:, :2]
    new = _is_new(xy)
    half, after = int(duration_s / 2.0 / STEP_S), int(AFTER_S / STEP_S)
    length = int(duration_s / STEP_S)
    possible = np.array(
        [k for k in range(30, len(xy) - length - after) if new[k + half : k + length + after].all()],
        dtype=int,
    )
    chosen: list[int] = []
    apart = length + after
    for target in np.linspace(0.0, possible[-1] if len(possible) else 0.0, count + 2)[1:-1]:
        free = [k for k in possible if all(abs(k - c) >= apart for c in chosen)]
        if not free:
            raise ValueError(
                f"the drive has place for {len(chosen)} lost stretches into unknown space, not for {count}; "
                "use a larger floor or a longer distance"
            )
        chosen.append(min(free, key=lambda k: abs(k - target)))
    return [
        LostStretch(k * STEP_S, k * STEP_S + duration_s, KINDS[n % len(KINDS)])
        for n, k in enumerate(sorted(chosen))
    ]


def _is_new(xy: np.ndarray) -> np.ndarray:
    """Return for each position of a path [N, 2] whether it is in space that was unknown 20 s before."""
    new = np.ones(len(xy), dtype=bool)
    neighbours = cKDTree(xy).query_ball_point(xy, KNOWN_M)
    for k, near in enumerate(neighbours):
        new[k] = min(near) > k - int(20.0 / STEP_S)
    return new
