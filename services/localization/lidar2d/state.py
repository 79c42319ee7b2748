"""Saved maps: a journal of what never changes, and a small state with all poses (`map_saver` writes them).

`lidar_map.json` names two files (`beamsplat.common.files.numbered_state`): `lidar_map-<n>.npz` with the poses
and with which records are part of the map, and `lidar_map-<n>.journal` with scans, finished submaps,
constraints and the trajectory. Maps of version 1 consist of one npz file.
"""

from __future__ import annotations

import dataclasses
import uuid
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.files.journal import read_records
from beamsplat.common.files.numbered_state import Arrays, NumberedState, unpacked_arrays
from beamsplat.services.localization.lidar2d import map_records, state_v1
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings

FORMAT = "beamsplat-lidar-map"
VERSION = 2
MANIFEST = "lidar_map.json"
PREFIX = "lidar_map-"


# The manifest has these settings under other names, since version 1.
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


def manifest_settings(settings: LidarSlamSettings) -> dict[str, Any]:
    """Return the settings as they are named in a manifest."""
    return {_SETTING_KEYS.get(k, k): v for k, v in dataclasses.asdict(settings).items()}


def map_files(folder: Path) -> NumberedState:
    """Return the files of a map in a folder."""
    return NumberedState(Path(folder), PREFIX, MANIFEST, "arrays")


def _existing_files(folder: Path) -> NumberedState:
    files = map_files(folder)
    if not files.manifest_path.is_file():
        raise UserError(f"{files.manifest_path}: no saved map here; give the folder of a saved map")
    return files


def load_state(folder: Path, settings: LidarSlamSettings) -> tuple[PoseGraph, dict[str, np.ndarray]]:
    """Load a saved pose graph, and the arrays of its trajectory record.

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
        graph = PoseGraph(settings)
        graph.uuid = str(manifest.get("uuid", ""))  # missing in old states
        try:
            if manifest["version"] == 1:
                record = state_v1.unpack(arrays, graph)
            else:
                path = files.folder / Path(manifest["journal"]).name
                records = read_records(path, manifest["journal_bytes"])
                parts = ((kind, unpacked_arrays(payload)) for kind, payload in records)
                record = map_records.restore(graph, arrays, parts)
        except (
            KeyError, ValueError, IndexError, TypeError, EOFError, zipfile.BadZipFile, zlib.error,
        ) as error:  # fmt: skip
            raise UserError(
                f"{files.folder / manifest['arrays']}: not a complete map of version {manifest['version']} "
                f"({error}); restore the folder from a copy"
            ) from error
        graph.resume_numbering()
        return graph, record

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
    version = manifest.get("version")
    if type(version) is not int or not 1 <= version <= VERSION:
        raise UserError(
            f"{path}: version {version!r}, this program reads 1 to {VERSION}; "
            "map again or use the program that wrote it"
        )
    if not isinstance(manifest.get("settings"), dict):
        raise UserError(f"{path}: field 'settings' is missing; restore the folder from a copy")
    if version > 1:
        for field, kind in (("journal", str), ("journal_bytes", int)):
            if not isinstance(manifest.get(field), kind):
                raise UserError(f"{path}: field {field!r} is missing; restore the folder from a copy")
