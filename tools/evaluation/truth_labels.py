"""Parts of the images of a drive that has true depth: by height, distance and depth edges."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.geometry.trajectory import Trajectory, read_tum
from beamsplat.services.depth.recorded import read_depth
from beamsplat.tools.evaluation.drive import RecordedDrive
from beamsplat.tools.evaluation.image_parts import (
    OUTSIDE,
    find_scene_heights,
    label_distances,
    label_edges,
    label_heights,
    point_heights,
    sampled_heights,
)

_MAX_GAP_NS, _MAX_EXTRAPOLATION_NS = 1_000_000_000, 200_000_000  # between and beyond poses
_LEVEL_COS, _LEVEL_M = np.cos(np.radians(2.0)), 0.03  # of a body that stays on a floor


class TruthLabels:
    """Labels the parts of images with true depth.

    Heights come from the true depth and from the true poses in `groundtruth.txt` in or beside the recording;
    if there is no such file, from the poses with which the depth is estimated. The floor is at the height of
    the body if the body stays level on it, else at the lowest horizontal plane in the true depth.
    """

    def __init__(self, drive: RecordedDrive, truth: dict[int, Path], *, floor_known: bool) -> None:
        """Find floor and ceilings in the true depth files `truth`, by stamp."""
        self._rays = drive.undistort.pinhole.ray_grid()
        self._T_body_camera = drive.T_body_camera
        self._poses, source = _poses_of(drive)
        T = self._poses.T_a_b
        level = bool(np.all(T[:, 2, 2] > _LEVEL_COS)) and float(np.ptp(T[:, 2, 3])) < _LEVEL_M
        on_floor = level and floor_known
        floor_m = float(np.median(T[:, 2, 3])) if on_floor else None
        lidar_m = None if floor_m is None else floor_m + float(drive.T_body_lidar[2, 3])
        heights = sampled_heights(self._views(truth), self._rays)
        self._scene = find_scene_heights(heights, floor_m=floor_m, lidar_m=lidar_m)
        self.heights_report: dict[str, Any] = {"poses": source, "floor": "not found"}
        if self._scene is not None:
            self.heights_report |= {
                "floor": "body on the floor" if on_floor else "lowest plane in the true depth",
                "floor_m": self._scene.floor_m, "ceilings_m": list(self._scene.ceilings_m),
                "lidar_m": self._scene.lidar_m,
            }  # fmt: skip

    def _camera_pose(self, stamp_ns: int) -> np.ndarray | None:
        T_map_body = self._poses.at(
            stamp_ns, max_gap_ns=_MAX_GAP_NS, max_extrapolation_ns=_MAX_EXTRAPOLATION_NS
        )
        return None if T_map_body is None else T_map_body @ self._T_body_camera

    def _views(self, truth: dict[int, Path]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for stamp, path in truth.items():
            T_map_camera = self._camera_pose(stamp)
            if T_map_camera is not None:
                yield read_depth(path), T_map_camera

    def labels(self, stamp_ns: int, truth_m: np.ndarray) -> dict[str, np.ndarray]:
        """Return, by grouping in `image_parts.PARTS`, the numbers of the parts, int8 [H, W].

        The grouping `height` is missing if the height of the floor is not known.

        Args:
            stamp_ns: time of the image.
            truth_m: true optical z float32 [H, W] in m, NaN where unknown.
        """
        labels = {"distance": label_distances(truth_m), "edges": label_edges(truth_m)}
        if self._scene is None:
            return labels
        T_map_camera = self._camera_pose(stamp_ns)
        if T_map_camera is None:
            by_height = np.full(truth_m.shape, OUTSIDE, np.int8)
        else:
            by_height = label_heights(point_heights(truth_m, self._rays, T_map_camera), self._scene)
        return {"height": by_height, **labels}


def _poses_of(drive: RecordedDrive) -> tuple[Trajectory, str]:
    for folder in (drive.path, drive.path.parent):
        file = folder / "groundtruth.txt"
        if file.is_file():
            return read_tum(file), f"true poses ({file.name})"
    return drive.poses, f"{drive.poses_name}; there is no groundtruth.txt with true poses"
