"""Stated standard deviations of fused depth compared with true depth, for `bench uncertainties`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamsplat.services.depth.source import make_source
from beamsplat.tools.evaluation.depth_replay import replay_depth, truth_depth_files
from beamsplat.tools.evaluation.drive import RecordedDrive

DEPTHS = {"field": "depth of a keyframe", "field_carried": "depth of another image"}
BANDS_M = ((0.0, 1.5), (1.5, 3.0), (3.0, 6.0), (6.0, np.inf))  # of the stated depth
_EVERY_PX = 4
_MOST_IMAGES = 30  # of a drive, evenly spaced


def depth_samples(drive: RecordedDrive, truth: Path, offset_ns: int) -> dict[str, np.ndarray]:
    """Return rows (depth m, error m, sigma m), float64 [N, 3], of fused depth by the keys of `DEPTHS`.

    Args:
        drive: with the poses and the calibration that fusion uses.
        truth: folder with the true depth, see `truth_depth_files`.
        offset_ns: stamp of an image of the drive minus the stamp in the name of its true depth.
    """
    stamps = {image.stamp_ns for image in drive.images}
    files = {stamp + offset_ns: path for stamp, path in truth_depth_files(truth).items()}
    found = sorted(stamp for stamp in files if stamp in stamps)
    wanted: dict[int, Path | None] = {s: files[s] for s in found[:: -(-len(found) // _MOST_IMAGES) or 1]}
    samples: dict[str, list[np.ndarray]] = {method: [] for method in DEPTHS}
    for outcome in replay_depth(drive, make_source("stixel"), wanted):
        for method, parts in samples.items():
            result = outcome.methods[method]
            grid = np.stack([result.depth_m, result.depth_m - outcome.truth, result.sigma_m])
            rows = grid[:, ::_EVERY_PX, ::_EVERY_PX].reshape(3, -1).T.astype(np.float64)
            parts.append(rows[np.all(np.isfinite(rows), axis=1)])
    return {method: np.concatenate(parts) for method, parts in samples.items() if parts}
