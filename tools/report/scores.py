"""The paper's figures of one run: errors of poses and depth against truth, speed and load."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.rig import rpy_from_rotation
from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.services.depth.recorded import read_depth
from beamsplat.tools.evaluation.drive import Drive
from beamsplat.tools.report.observer import DEPTH_STEP, Costs, Seen

LEAST_POSES = 3  # with fewer the first pose's alignment leaves nothing to be wrong
_REACH_NS = 20_000_000


@dataclass(frozen=True)
class Truth:
    """What is known of a recording; `drive.poses` is the truth of T_world_body."""

    path: Path
    drive: Drive
    depth_files: dict[int, Path]  # stamp -> PNG


def compared_poses(seen: Seen, truth: Truth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(stamps int64 [N], T_world_body estimated [N, 4, 4], true [N, 4, 4]) of the poses that were published
    as good, aligned by the first of them only."""
    stamps, found, true = [], [], []
    for stamp_ns, T_map_body, status, _ in seen.poses:
        T = truth.drive.poses.at(stamp_ns, max_gap_ns=1_000_000_000, max_extrapolation_ns=_REACH_NS)
        if status == "ok" and T is not None:
            stamps.append(stamp_ns)
            found.append(T_map_body)
            true.append(T)
    if not stamps:
        return np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
    T_world_map = true[0] @ inverse(found[0])
    return np.array(stamps), T_world_map @ np.array(found), np.array(true)


def rigid_offset(T_found: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """The rigid transform [4, 4] that best takes poses [N, 4, 4] to the true ones: mean turn, mean shift.

    For maps: one first pose a few millimetres off must not move the whole map.
    """
    U, _, Vt = np.linalg.svd(np.sum(T_true[:, :3, :3] @ np.swapaxes(T_found[:, :3, :3], 1, 2), axis=0))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    shift = T_true[:, :3, 3].mean(axis=0) - R @ T_found[:, :3, 3].mean(axis=0)
    return make_transform(R, shift)


def pose_errors(T_found: np.ndarray, T_true: np.ndarray) -> dict[str, Any]:
    """RMSE per axis and together as the paper counts it, and ATE after rigid and similarity alignment."""
    if len(T_found) < LEAST_POSES:
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
    """(RMSE in metres, scale) of positions [N, 3] after the best alignment (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a / len(a))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    variance = float(np.mean(np.sum(a**2, axis=1)))
    scale = float(np.trace(np.diag(S) @ D)) / variance if scaled and variance > 1e-12 else 1.0
    rest = scale * a @ (U @ D @ Vt).T - b
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1)))), scale


def speed(seen: Seen, costs: Costs, cores: int) -> dict[str, Any]:
    """Images through the whole system per second, and what they cost (design section 11).

    An image counts if it got a pose, a depth, and a decision: passed over, or taken up and acknowledged.
    """
    if not seen.images:
        return {}
    last_decided = max(seen.acks, default=0)
    newest_pose_ns = max(seen.pose_at_ns, default=0)
    oldest_pose_ns = min(seen.pose_at_ns, default=0)
    through, ends = 0, [min(seen.images.values())]
    for stamp_ns, (at_ns, status, keyframe) in seen.fused.items():
        has_pose = oldest_pose_ns <= stamp_ns <= newest_pose_ns
        decided = not keyframe or stamp_ns in seen.acks or stamp_ns < last_decided
        if status == "ok" and has_pose and decided:
            through += 1
            ends.append(at_ns)
    wall_s = max((max([*ends, *seen.images.values()]) - min(seen.images.values())) * 1e-9, 1e-9)
    cpu_s = sum(costs.cpu_s.values())
    located = len(set(seen.pose_at_ns) & set(seen.images))
    latency = [
        (at_ns - seen.images[stamp]) * 1e-6 for stamp, (at_ns, _) in seen.acks.items() if stamp in seen.images
    ]
    maps = "keyframes" in costs.cpu_s
    return {
        "fps": through / wall_s if maps else None,
        "poses_per_s": len(seen.pose_at_ns) / wall_s,
        "images": len(seen.images), "images_through": through, "images_with_own_pose": located,
        "keyframes": len(seen.keyframes), "keyframes_per_s": len(seen.keyframes) / wall_s,
        "keyframes_refused": sum(status != "ok" for _, status in seen.acks.values()),
        "cpu_load_percent": 100.0 * cpu_s / max(costs.wall_s, 1e-9),
        "cpu_cores": cores,
        "cpu_s_per_image": cpu_s / through if through else None,
        "cpu_s_per_located_image": cpu_s / max(len(seen.pose_at_ns), 1),
        "cpu_s_by_node": costs.cpu_s, "startup_cpu_s": costs.startup_cpu_s, "wall_s": costs.wall_s,
        "peak_rss_mb": costs.peak_rss_mb, "link_bytes": seen.link_bytes,
        "keyframe_latency_p50_ms": float(np.percentile(latency, 50)) if latency else None,
        "keyframe_latency_p95_ms": float(np.percentile(latency, 95)) if latency else None,
        "refusals": seen.refusals, "dropped": costs.dropped, "lost": costs.lost, "drained": costs.drained,
        "status_lost_share": float(np.mean([status != "ok" for _, _, status, _ in seen.poses]))
        if seen.poses else 1.0,
        "metric": all(metric for _, _, status, metric in seen.poses if status == "ok"),
    }  # fmt: skip


def depth_errors(seen: Seen, truth: Truth) -> dict[str, Any]:
    """RMSE scaled and unscaled: at the beams as the paper has it (Table IV), and over all truth pixels."""
    series: dict[str, list[Any]] = {"stamps_ns": [], "scaled_m": [], "unscaled_m": []}
    square = {"scaled": [], "unscaled": [], "dense_scaled": [], "dense_unscaled": []}
    for stamp_ns, path in sorted(truth.depth_files.items()):
        shown = {"scaled": seen.kept_fused.get(stamp_ns), "unscaled": seen.kept_estimates.get(stamp_ns)}
        if shown["scaled"] is None:
            continue
        beams = truth.drive.beams(stamp_ns)
        uv, z, _ = project_beams(beams, truth.drive.undistort.pinhole, truth.drive.T_body_camera)
        true = read_depth(path)[::DEPTH_STEP, ::DEPTH_STEP]
        series["stamps_ns"].append(stamp_ns)
        for name, values in shown.items():
            rmse = None
            if values is not None:
                depth = values.astype(np.float64)
                v = np.clip((uv[:, 1] / DEPTH_STEP).round().astype(int), 0, depth.shape[0] - 1)
                u = np.clip((uv[:, 0] / DEPTH_STEP).round().astype(int), 0, depth.shape[1] - 1)
                error = depth[v, u] - z
                error = error[np.isfinite(error)]
                square[name].append((float(error @ error), len(error)))
                rmse = float(np.sqrt(np.mean(error**2))) if len(error) else None
                dense = (depth - true)[np.isfinite(depth) & np.isfinite(true)]
                square["dense_" + name].append((float(dense @ dense), len(dense)))
            series[f"{name}_m"].append(rmse)
    metric = seen.kinds <= {"metric", "none"}
    return {
        "depth_rmse_scaled_m": _root(square["scaled"]),
        # Numbers without a unit have no error in metres.
        "depth_rmse_unscaled_m": _root(square["unscaled"]) if metric else None,
        "depth_dense_rmse_scaled_m": _root(square["dense_scaled"]),
        "depth_dense_rmse_unscaled_m": _root(square["dense_unscaled"]) if metric else None,
        "depth_frames": len(series["stamps_ns"]), "depth_series": series,
    }  # fmt: skip


def _root(pairs: list[tuple[float, int]]) -> float | None:
    count = sum(n for _, n in pairs)
    return float(np.sqrt(sum(s for s, _ in pairs) / count)) if count else None
