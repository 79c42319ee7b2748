"""Saved maps: one manifest (JSON) and one array file (npz), see `beamsplat.common.files.numbered_state`."""

from __future__ import annotations

import dataclasses
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.files.numbered_state import Arrays, NumberedState
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import (
    Constraint,
    NodeScan,
    Submap,
    TrajectoryNode,
)
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.surfel_map import FrozenMap

FORMAT = "beamsplat-lidar-map"
VERSION = 1
MANIFEST = "lidar_map.json"


# Version 1 of the format stores these settings under other names.
_SETTING_KEYS = {
    "min_spacing_m": "spread_m", "max_match_points": "match_points", "submap_nodes": "submap_keynodes",
    "min_submap_nodes": "least_keynodes", "motion_filter_distance_m": "keynode_distance_m",
    "motion_filter_angle_rad": "keynode_angle_rad", "motion_filter_time_s": "keynode_time_s",
    "returns_per_measurement": "beams_per_fact", "good_inlier_ratio": "good_share",
    "lost_inlier_ratio": "lost_share", "sure_inlier_ratio": "sure_share",
    "submap_drift_sigma_m": "link_sigma_m", "submap_drift_sigma_rad": "link_sigma_rad",
    "nodes_per_measurement": "inner_facts", "job_nodes": "job_keynodes", "max_loops_per_node": "loop_submaps",
    "loop_distance_m": "loop_near_m", "local_window_m": "narrow_m", "local_window_rad": "narrow_rad",
    "global_searches_per_job": "wide_searches", "max_global_window_m": "wide_limit_m",
    "merged_scans": "chunk_keynodes", "min_global_score": "wide_score",
    "loop_min_inlier_ratio": "loop_share", "loop_min_overlap": "loop_known",
    "min_covering_submaps": "copies_of_a_place", "link_min_confidence": "link_confidence",
    "link_max_runner_up_ratio": "link_alone_rival", "link_min_distance_m": "link_apart_m",
}  # fmt: skip


def map_uuid(stamp_ns: int, ranges_m: np.ndarray) -> str:
    """Return the UUID of a map that begins with this scan; the same scan yields the same UUID."""
    first = f"{FORMAT} {stamp_ns} {np.asarray(ranges_m, np.float32).tobytes().hex()}"
    return str(uuid.uuid5(uuid.NAMESPACE_OID, first))


@dataclasses.dataclass(frozen=True)
class PackedMap:
    """Copies of a map's state; they can be written in another thread while mapping continues."""

    arrays: dict[str, np.ndarray]
    head: dict[str, object]


def pack_state(graph: PoseGraph, extra: dict[str, np.ndarray]) -> PackedMap:
    """Return copies of the pose graph as arrays, and the arrays `extra` of the caller."""
    arrays = {**_pack_nodes(graph), **_pack_submaps(graph), **_pack_edges(graph.constraints), **extra}
    head = {
        "uuid": graph.uuid,
        "keynodes": len(graph.nodes),
        "submaps": len(graph.submaps),
        "constraints": len(graph.constraints),
        "settings": {_SETTING_KEYS.get(k, k): v for k, v in dataclasses.asdict(graph.settings).items()},
    }
    return PackedMap(arrays, head)


def _files(folder: Path) -> NumberedState:
    return NumberedState(Path(folder), "lidar_map-", MANIFEST, "arrays")


def _existing_files(folder: Path) -> NumberedState:
    files = _files(folder)
    if not files.manifest_path.is_file():
        raise UserError(f"{files.manifest_path}: no saved map here; give the folder of a saved map")
    return files


def write_state(folder: Path, state: PackedMap) -> None:
    """Write a map in place of the previous one; a crash or an error leaves one of the two valid.

    Raises:
        OSError: the disk is full or broken.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    _files(folder).write(state.arrays, {"format": FORMAT, "version": VERSION, **state.head})


def load_state(folder: Path, settings: LidarSlamSettings) -> tuple[PoseGraph, dict[str, np.ndarray]]:
    """Load a saved pose graph, and the `extra` arrays of `pack_state`.

    Raises:
        UserError: there is no saved map, or it cannot be read; the text names the file and a remedy.
    """
    files = _existing_files(folder)

    def unpack(manifest: dict[str, Any], arrays: Arrays) -> tuple[PoseGraph, dict[str, np.ndarray]]:
        cell_m = manifest["settings"].get("cell_m")
        if cell_m != settings.cell_m:
            raise UserError(
                f"{files.manifest_path}: settings.cell_m is {cell_m}, the running SLAM has "
                f"{settings.cell_m}; use the same value"
            )
        try:
            graph = _unpack(arrays, settings)
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise UserError(
                f"{files.folder / manifest['arrays']}: not a complete map of version {VERSION} ({error}); "
                "restore it from a copy"
            ) from error
        graph.uuid = str(manifest.get("uuid", ""))  # missing in old states
        return graph, {key: value for key, value in arrays.items() if key.startswith("extra_")}

    return files.read(_check_manifest, unpack)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of the map saved in a folder.

    Raises:
        UserError: there is none, or this program cannot read it.
    """
    return _existing_files(folder).manifest(_check_manifest)


def _check_manifest(manifest: dict[str, Any], path: Path) -> None:
    if manifest.get("format") != FORMAT:
        raise UserError(f"{path}: field 'format' is not {FORMAT!r}; this is not a lidar map")
    if manifest.get("version") != VERSION:
        raise UserError(
            f"{path}: version {manifest.get('version')!r}, this program reads {VERSION}; "
            "map again or use the program that wrote it"
        )
    if not isinstance(manifest.get("settings"), dict):
        raise UserError(f"{path}: field 'settings' is missing; restore the folder from a copy")


def _pack_nodes(graph: PoseGraph) -> dict[str, np.ndarray]:
    nodes = list(graph.nodes.values())
    scans = [n.scan for n in nodes]
    return {
        "node_id": np.array([n.id for n in nodes], dtype=np.int64),
        "node_stamp_ns": np.array([n.stamp_ns for n in nodes], dtype=np.int64),
        "node_odom": np.array([n.pose_odom_body for n in nodes]).reshape(-1, 3),
        "node_map": np.array([graph.pose_map_node[n.id] for n in nodes]).reshape(-1, 3),
        "node_origin": np.array([s.origin for s in scans]).reshape(-1, 2),
        "node_points": np.array([len(s.points) for s in scans], dtype=np.int64),
        "node_features": np.array([len(s.features) for s in scans], dtype=np.int64),
        "points": _concat([s.points for s in scans], 2),
        "tangents": _concat([s.tangents for s in scans], 2),
        "spacing": np.concatenate([s.spacing_m for s in scans]) if scans else np.zeros(0, np.float32),
        "moving": np.concatenate([s.dynamic for s in scans]) if scans else np.zeros(0, bool),
        "features": _concat([s.features for s in scans], 5),
    }


def _concat(parts: list[np.ndarray], width: int) -> np.ndarray:
    return np.concatenate(parts) if parts else np.zeros((0, width), np.float32)


def _pack_submaps(graph: PoseGraph) -> dict[str, np.ndarray]:
    finished = [(s, s.frozen) for s in graph.submaps.values() if s.frozen is not None]
    submaps, frozen = [s for s, _ in finished], [f for _, f in finished]
    return {
        "submap_id": np.array([s.id for s in submaps], dtype=np.int64),
        "submap_odom": np.array([s.pose_odom_submap for s in submaps]).reshape(-1, 3),
        "submap_map": np.array([s.pose_map_submap for s in submaps]).reshape(-1, 3),
        "submap_members": np.array([len(s.members) for s in submaps], dtype=np.int64),
        "members": np.array([m for s in submaps for m in s.members], dtype=np.int64),
        "submap_grid": np.array([[f.row0, f.col0, *f.shape] for f in frozen], dtype=np.int64).reshape(-1, 4),
        "submap_surfels": np.array([len(f.means) for f in frozen], dtype=np.int64),
        "means": _concat([f.means for f in frozen], 2),
        "omegas": _concat([f.omegas for f in frozen], 3),
        "views": _concat([f.views for f in frozen], 2),
        "submap_packed": np.array([len(f.packed) for f in frozen], dtype=np.int64),
        "packed": np.frombuffer(b"".join(f.packed for f in frozen), dtype=np.uint8),
    }


def _pack_edges(constraints: list[Constraint]) -> dict[str, np.ndarray]:
    return {
        "edge_submap": np.array([c.submap for c in constraints], dtype=np.int64),
        "edge_node": np.array([c.node for c in constraints], dtype=np.int64),
        "edge_pose": np.array([c.pose_submap_node for c in constraints]).reshape(-1, 3),
        "edge_information": np.array([c.information for c in constraints]).reshape(-1, 3, 3),
        "edge_loop": np.array([c.loop for c in constraints], dtype=bool),
    }


def _unpack(a: dict[str, np.ndarray], settings: LidarSlamSettings) -> PoseGraph:
    graph = PoseGraph(settings)
    p, f = np.r_[0, np.cumsum(a["node_points"])], np.r_[0, np.cumsum(a["node_features"])]
    for k, node_id in enumerate(a["node_id"].tolist()):
        here = slice(p[k], p[k + 1])
        scan = NodeScan(
            a["points"][here],
            a["tangents"][here],
            a["spacing"][here],
            a["moving"][here],
            a["features"][f[k] : f[k + 1]],
            a["node_origin"][k],
        )
        graph.nodes[node_id] = TrajectoryNode(node_id, int(a["node_stamp_ns"][k]), a["node_odom"][k], scan)
        graph.pose_map_node[node_id] = a["node_map"][k]
    m, s, b = (np.r_[0, np.cumsum(a[key])] for key in ("submap_members", "submap_surfels", "submap_packed"))
    for k, submap_id in enumerate(a["submap_id"].tolist()):
        row0, col0, rows, cols = a["submap_grid"][k].tolist()
        frozen = FrozenMap(
            a["means"][s[k] : s[k + 1]],
            a["omegas"][s[k] : s[k + 1]],
            a["views"][s[k] : s[k + 1]],
            a["packed"][b[k] : b[k + 1]].tobytes(),
            (rows, cols),
            row0,
            col0,
            settings.cell_m,
        )
        graph.submaps[submap_id] = Submap(
            submap_id, a["submap_odom"][k], a["submap_map"][k], a["members"][m[k] : m[k + 1]].tolist(), frozen
        )
    graph.constraints = [
        Constraint(int(i), int(j), z, w, bool(loop))
        for i, j, z, w, loop in zip(
            a["edge_submap"], a["edge_node"], a["edge_pose"], a["edge_information"], a["edge_loop"]
        )
        if int(i) in graph.submaps and int(j) in graph.nodes
    ]
    graph.resume_numbering()
    return graph
