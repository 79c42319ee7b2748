"""Compute the paper's metrics of one run: errors of poses and depth, speed, CPU load."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.rig import rpy_from_rotation
from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.services.depth.recorded import read_depth
from beamsplat.tools.evaluation.drive import RecordedDrive
from beamsplat.tools.report.observer import DEPTH_STRIDE, RunCosts, RunRecord

MIN_POSES = 3  # with fewer poses, aligning the first one leaves almost no error
_MAX_EXTRAPOLATION_NS = 20_000_000


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a recording: its folder, true poses `drive.poses` (T_world_body), true depth files."""

    path: Path
    drive: RecordedDrive
    depth_files: dict[int, Path]  # stamp -> PNG


def aligned_poses(record: RunRecord, truth: GroundTruth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the poses published with status ok, and the true poses at the same stamps.

    The estimated poses are transformed to the world frame so that the first one equals its true pose.

    Returns:
        Stamps int64 [N] in ns, estimated T_world_body float64 [N, 4, 4], true T_world_body float64 [N, 4, 4].
    """
    stamps, found, true = [], [], []
    for stamp_ns, T_map_body, status, _ in record.poses:
        T = truth.drive.poses.at(
            stamp_ns, max_gap_ns=1_000_000_000, max_extrapolation_ns=_MAX_EXTRAPOLATION_NS
        )
        if status == "ok" and T is not None:
            stamps.append(stamp_ns)
            found.append(T_map_body)
            true.append(T)
    if not stamps:
        return np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
    T_world_map = true[0] @ inverse(found[0])
    return np.array(stamps), T_world_map @ np.array(found), np.array(true)


def rigid_offset(T_found: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """Return the rigid transform [4, 4] that maps estimated poses [N, 4, 4] to the true poses [N, 4, 4].

    It consists of the mean rotation and the mean translation between both. Maps are aligned by all poses,
    because an error of the first pose alone would move the whole map.
    """
    U, _, Vt = np.linalg.svd(np.sum(T_true[:, :3, :3] @ np.swapaxes(T_found[:, :3, :3], 1, 2), axis=0))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    shift = T_true[:, :3, 3].mean(axis=0) - R @ T_found[:, :3, 3].mean(axis=0)
    return make_transform(R, shift)


def pose_errors(T_found: np.ndarray, T_true: np.ndarray) -> dict[str, Any]:
    """Return position errors (m) and orientation errors (rad) of estimated poses, by name.

    They are the RMSE per axis and combined (the quadratic mean over the three axes), the ATE without further
    alignment, and the ATE after rigid and after similarity alignment. With fewer than `MIN_POSES` poses, only
    the number of poses is returned.

    Args:
        T_found: estimated T_world_body, float64 [N, 4, 4], from `aligned_poses`.
        T_true: true T_world_body, float64 [N, 4, 4].
    """
    if len(T_found) < MIN_POSES:
        return {"poses": len(T_found)}
    offset = T_found[:, :3, 3] - T_true[:, :3, 3]
    turn = np.swapaxes(T_true[:, :3, :3], 1, 2) @ T_found[:, :3, :3]
    rpy = np.array([rpy_from_rotation(R) for R in turn])
    xyz_rmse, rpy_rmse = np.sqrt(np.mean(offset**2, axis=0)), np.sqrt(np.mean(rpy**2, axis=0))
    se3, _ = aligned_rmse(T_found[:, :3, 3], T_true[:, :3, 3], scaled=False)
    sim3, scale = aligned_rmse(T_found[:, :3, 3], T_true[:, :3, 3], scaled=True)
    return {
        "position_rmse_m": float(np.sqrt(np.mean(xyz_rmse**2))),
        "position_rmse_xyz_m": xyz_rmse.tolist(),
        "orientation_rmse_rad": float(np.sqrt(np.mean(rpy_rmse**2))),
        "orientation_rmse_rpy_rad": rpy_rmse.tolist(),
        "ate_first_pose_rmse_m": float(np.sqrt(np.mean(np.sum(offset**2, axis=1)))),
        "ate_se3_rmse_m": se3,
        "ate_sim3_rmse_m": sim3,
        "sim3_scale": scale,
        "poses": len(T_found),
    }


def aligned_rmse(found: np.ndarray, true: np.ndarray, *, scaled: bool) -> tuple[float, float]:
    """Return (RMSE in m, scale) of estimated positions after least-squares alignment (Umeyama 1991).

    Args:
        found, true: estimated and true positions, float64 [N, 3], m.
        scaled: whether the alignment includes a scale; else the scale is 1.
    """
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a / len(a))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    variance = float(np.mean(np.sum(a**2, axis=1)))
    scale = float(np.trace(np.diag(S) @ D)) / variance if scaled and variance > 1e-12 else 1.0
    rest = scale * a @ (U @ D @ Vt).T - b
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1)))), scale


def speed_and_load(record: RunRecord, costs: RunCosts, cores: int) -> dict[str, Any]:
    """Return speed, CPU load, latency and memory of a run by name; speed is in images per second.

    For the speed, an image counts if its pose and its fused depth are known, and if it either is no keyframe
    or was acknowledged by the mapper. `cores` is the number of CPU cores of the host.
    """
    if not record.images:
        return {}
    last_decided = max(record.acks, default=0)
    newest_pose_ns = max(record.pose_at_ns, default=0)
    oldest_pose_ns = min(record.pose_at_ns, default=0)
    through, ends = 0, [min(record.images.values())]
    for stamp_ns, (at_ns, status, keyframe) in record.fused.items():
        has_pose = oldest_pose_ns <= stamp_ns <= newest_pose_ns
        decided = not keyframe or stamp_ns in record.acks or stamp_ns < last_decided
        if status == "ok" and has_pose and decided:
            through += 1
            ends.append(at_ns)
    wall_s = max((max([*ends, *record.images.values()]) - min(record.images.values())) * 1e-9, 1e-9)
    cpu_s = sum(costs.cpu_s.values())
    located = len(set(record.pose_at_ns) & set(record.images))
    latency = [
        (at_ns - record.images[stamp]) * 1e-6
        for stamp, (at_ns, _) in record.acks.items()
        if stamp in record.images
    ]
    maps = any("keyframes" in name.split("+") for name in costs.cpu_s)  # nodes that share a process
    return {
        "fps": through / wall_s if maps else None,
        "poses_per_s": len(record.pose_at_ns) / wall_s,
        "images": len(record.images), "images_through": through, "images_with_own_pose": located,
        "keyframes": len(record.keyframes), "keyframes_per_s": len(record.keyframes) / wall_s,
        "keyframes_refused": sum(status != "ok" for _, status in record.acks.values()),
        "cpu_load_percent": 100.0 * cpu_s / max(costs.wall_s, 1e-9),
        "cpu_cores": cores,
        "cpu_s_per_image": cpu_s / through if through else None,
        "cpu_s_per_located_image": cpu_s / max(len(record.pose_at_ns), 1),
        "cpu_s_by_node": costs.cpu_s, "startup_cpu_s": costs.startup_cpu_s, "wall_s": costs.wall_s,
        "peak_rss_mb": costs.peak_rss_mb, "link_bytes": record.link_bytes,
        "keyframe_latency_p50_ms": float(np.percentile(latency, 50)) if latency else None,
        "keyframe_latency_p95_ms": float(np.percentile(latency, 95)) if latency else None,
        "refusals": record.refusals, "dropped": costs.dropped, "lost": costs.lost, "drained": costs.drained,
        "status_lost_share": float(np.mean([status != "ok" for _, _, status, _ in record.poses]))
        if record.poses else 1.0,
        "metric": all(metric for _, _, status, metric in record.poses if status == "ok"),
    }  # fmt: skip


def depth_errors(record: RunRecord, truth: GroundTruth) -> dict[str, Any]:
    """Return the depth RMSE in m after fusion ("scaled") and of the depth estimate ("unscaled"), by name.

    Both are computed at the lidar beams as in the paper's Table IV, and over all pixels with true depth
    ("dense"). `depth_series` contains the RMSE at the beams of each image.
    """
    series: dict[str, list[Any]] = {"stamps_ns": [], "scaled_m": [], "unscaled_m": []}
    square: dict[str, list[Any]] = {"scaled": [], "unscaled": [], "dense_scaled": [], "dense_unscaled": []}
    for stamp_ns, path in sorted(truth.depth_files.items()):
        shown = {"scaled": record.kept_fused.get(stamp_ns), "unscaled": record.kept_estimates.get(stamp_ns)}
        if shown["scaled"] is None:
            continue
        beams = truth.drive.beams_at(stamp_ns)
        uv, z, _ = project_beams(beams, truth.drive.undistort.pinhole, truth.drive.T_body_camera)
        true = read_depth(path)[::DEPTH_STRIDE, ::DEPTH_STRIDE]
        series["stamps_ns"].append(stamp_ns)
        for name, values in shown.items():
            rmse = None
            if values is not None:
                depth = values.astype(np.float64)
                v = np.clip((uv[:, 1] / DEPTH_STRIDE).round().astype(int), 0, depth.shape[0] - 1)
                u = np.clip((uv[:, 0] / DEPTH_STRIDE).round().astype(int), 0, depth.shape[1] - 1)
                error = depth[v, u] - z
                error = error[np.isfinite(error)]
                square[name].append((float(error @ error), len(error)))
                rmse = float(np.sqrt(np.mean(error**2))) if len(error) else None
                dense = (depth - true)[np.isfinite(depth) & np.isfinite(true)]
                square["dense_" + name].append((float(dense @ dense), len(dense)))
            series[f"{name}_m"].append(rmse)
    metric = record.kinds <= {"metric", "none"}
    return {
        "depth_rmse_scaled_m": _rmse(square["scaled"]),
        # Estimates that are not metric have no error in metres.
        "depth_rmse_unscaled_m": _rmse(square["unscaled"]) if metric else None,
        "depth_dense_rmse_scaled_m": _rmse(square["dense_scaled"]),
        "depth_dense_rmse_unscaled_m": _rmse(square["dense_unscaled"]) if metric else None,
        "depth_frames": len(series["stamps_ns"]), "depth_series": series,
    }  # fmt: skip


def _rmse(pairs: list[tuple[float, int]]) -> float | None:
    count = sum(n for _, n in pairs)
    return float(np.sqrt(sum(s for s, _ in pairs) / count)) if count else None
