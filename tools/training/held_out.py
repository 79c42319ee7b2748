"""Errors of a trained aggregation on homes that were not used for training, beside semi-global matching."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.services.fusion.learned_aggregation import LearnedAggregation
from beamsplat.services.fusion.learned_inputs import CANDIDATES, AggregatorInputs
from beamsplat.tools.evaluation.depth_breakdown import DepthBreakdown, PairedErrors
from beamsplat.tools.evaluation.image_parts import label_distances, label_edges
from beamsplat.tools.training.optimisation import log_labels
from beamsplat.tools.training.sample_files import Carrier, load_sample, samples_in

_SNAP_LABELS = 1.2  # as in the plane sweep
_WALLS = ("wall", "background wall")
_SNAPPED_TO = tuple(name for name in CANDIDATES if name not in ("past keyframes", "depth source"))
_TILTED_WALL_M = 0.05  # as in the plane sweep: walls of a hand-held lidar count only this near to its plane
_TIMED = 40  # images


def evaluate_held_out(weights: Path, folder: Path, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Return the errors of the learned aggregation and of semi-global matching, by carrier.

    Both work on the same stored inputs at the working size, and their depth is set to candidate surfaces that
    are near (as in the plane sweep). So the feedback of a method's depth through past keyframes is not
    included; `beamsplat eval depth --weights` includes it.

    Args:
        weights: ONNX file.
        folder: contains the homes.
        progress: receives the number of finished and of all samples.
    """
    aggregation, log_z = LearnedAggregation(weights), log_labels()
    files: dict[Carrier, list[Path]] = {
        "robot": samples_in(folder, "robot"), "hand": samples_in(folder, "hand"),
    }  # fmt: skip
    total, done, cpu_ms = sum(len(paths) for paths in files.values()), 0, []
    report: dict[str, Any] = {}
    for carrier, paths in files.items():
        pairs = PairedErrors()
        breakdowns = {"sgm": DepthBreakdown(), "learned": DepthBreakdown()}
        for path in paths:
            sample = load_sample(path)
            started = time.process_time()
            depth, spread = aggregation.depth_of(sample.inputs, log_z)
            cpu_ms.append(1e3 * (time.process_time() - started))
            truth = sample.truth_mm[::2, ::2] * np.float32(1e-3)
            truth[truth == 0.0] = np.nan
            matched = np.exp(sample.matched_log_depth.astype(np.float32))
            sgm, learned = (snapped(z, sample.inputs, carrier == "robot", log_z) for z in (matched, depth))
            pairs.add(sgm, learned, truth)
            labels = {"distance": label_distances(truth), "edges": label_edges(truth)}
            breakdowns["sgm"].add(sgm, None, truth, labels)
            breakdowns["learned"].add(learned, depth * spread, truth, labels)
            done += 1
            progress(done, total)
        report[carrier] = {
            "samples": len(paths), "comparison": {"first": "sgm", "second": "learned", **pairs.report()},
            "methods": {name: breakdown.report() for name, breakdown in breakdowns.items()},
        }  # fmt: skip
    # The first runs allocate memory; the rest includes features, network and decoding.
    report["cpu_ms"] = float(np.median(cpu_ms[1 : _TIMED + 1])) if len(cpu_ms) > 1 else None
    return report


def snapped(
    depth_m: np.ndarray,  # float32 [h, w]
    inputs: AggregatorInputs,
    planar: bool,
    log_z: np.ndarray,
) -> np.ndarray:
    """Return depth set to the nearest candidate surface within 1.2 labels, as in the plane sweep."""
    log_depth = np.log(depth_m)
    best = np.full(depth_m.shape, _SNAP_LABELS * (log_z[1] - log_z[0]))
    result = log_depth.copy()
    for name in _SNAPPED_TO:
        surface = inputs.log_depth[CANDIDATES.index(name)].astype(np.float32)
        if name in _WALLS and not planar:
            surface = np.where(inputs.lidar_plane_m < _TILTED_WALL_M, surface, np.nan)
        with np.errstate(invalid="ignore"):
            distance = np.abs(surface - log_depth)
            nearer = distance < best
        result[nearer], best[nearer] = surface[nearer], distance[nearer]
    return np.exp(result).astype(np.float32)


def network_cpu_ms(weights: Path, runs: int = 20) -> tuple[float, float]:
    """Return median and least CPU time (ms) of the network alone at 160 x 120, on one thread.

    Other processes on the machine raise the median more than the least.
    """
    from beamsplat.common.onnx_model import OnnxModel
    from beamsplat.services.fusion.learned_inputs import CHANNELS

    model = OnnxModel(weights, threads=1, providers=("CPUExecutionProvider",))
    features = np.random.default_rng(0).uniform(-1.0, 1.0, (1, CHANNELS, 128, 160)).astype(np.float32)
    times = []
    for _ in range(runs + 1):
        started = time.process_time()
        model.run(features)
        times.append(1e3 * (time.process_time() - started))
    return float(np.median(times[1:])), float(min(times[1:]))
