"""Compare two sessions of one place; write what was found as JSON, pictures and a coloured point cloud."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import make_folder, write_atomically
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.surface import write_ply
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.compare.alignment import DriveAlignment, align_drives
from beamsplat.tools.compare.beams import compare_beams
from beamsplat.tools.compare.drive import DepthView, MappedDrive, depth_views, open_drive
from beamsplat.tools.compare.objects import APPEARED, ChangedObject, find_objects
from beamsplat.tools.compare.pictures import COLOUR_BGR, ObjectPair, maps_from_above, object_pair
from beamsplat.tools.compare.voxels import SurfaceVoxels, changed_voxels, surface_voxels
from beamsplat.tools.sessions.edit import with_anchors

Progress = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True)
class OpenedSession:
    """A session as it is read: its folder, the arrays of its state, and its lidar map."""

    folder: SessionFolder
    arrays: Arrays
    slam: LidarSlam


@dataclass(frozen=True)
class SessionComparison:
    """What differs between two sessions, in the map frame of the first."""

    a: MappedDrive
    b: MappedDrive
    alignment: DriveAlignment
    objects: list[ChangedObject]  # the surest first
    pairs: list[ObjectPair | None]  # one for each object
    surface: SurfaceVoxels  # of map a
    keyframes: tuple[int, int]  # of a and b, that could be decoded

    def as_json(self) -> dict[str, Any]:
        """Return the result as JSON values; lengths in metres in the map frame of the first session."""
        objects = []
        for number, (found, pair) in enumerate(zip(self.objects, self.pairs), 1):
            row = {"number": number, **found.as_json()}
            if pair is not None:
                row["keyframe"] = pair.keyframe
                row["appearance_difference"] = round(pair.difference, 3)
                row["appearance_typical"] = round(pair.typical, 3)
            objects.append(row)
        pose = self.alignment.pose_a_b
        return {
            "format": "beamsplat-changes", "version": 1,
            "first": self.a.name, "second": self.b.name,
            "alignment": {
                "pose_first_second": [float(v) for v in pose], "sigma_m": round(self.alignment.sigma_m, 4),
                "inlier_ratio": round(self.alignment.inlier_ratio, 3),
                "scans_agreeing": self.alignment.agreeing, "scans_queried": self.alignment.queried,
            },
            "keyframes": list(self.keyframes), "objects": objects,
        }  # fmt: skip


def compare_sessions(
    a: OpenedSession,
    b: OpenedSession,
    given_pose_a_b: np.ndarray | None,
    threads: int,
    progress: Progress,
) -> SessionComparison:
    """Find what appeared in session b and what vanished from session a.

    Args:
        given_pose_a_b: rough pose of map b in map a, float64 [3]; None: found by lidar.
        progress: called with the stage, and how many of how many parts of it are done.

    Raises:
        UserError: the sessions cannot be aligned, or one has no keyframes.
    """
    progress("aligning", 0, 0)
    alignment = align_drives(a.slam, b.slam, given_pose_a_b)
    anchors_a = {id: se2_to_se3(pose) for id, pose in a.slam.anchors().items()}
    drive_a = open_drive(a.folder, with_anchors(a.arrays, anchors_a), a.slam, a.slam.anchors())
    drive_b = open_drive(b.folder, _moved(b.arrays, alignment), b.slam, alignment.pose_a_submap)
    rasterizer = Rasterizer(threads)
    try:
        views_a, views_b = (_views(drive, rasterizer, progress) for drive in (drive_a, drive_b))
        progress("comparing", 0, 0)
        beams = compare_beams(drive_a, drive_b, alignment.sigma_m)
        surface_a, surface_b = surface_voxels(views_a), surface_voxels(views_b)
        vanished = changed_voxels(surface_a, views_a, views_b, alignment.sigma_m)
        appeared = changed_voxels(surface_b, views_b, views_a, alignment.sigma_m)
        found = find_objects(beams, vanished, appeared, _beam_height_m(drive_a))
        objects, pairs = [], []
        for number, candidate in enumerate(found):
            progress("rendering objects", number, len(found))
            there = views_b if candidate.kind == APPEARED else views_a
            pair = object_pair(drive_a, drive_b, there, candidate, rasterizer)
            if candidate.by_lidar or (pair is not None and pair.looks_changed):
                objects.append(candidate)
                pairs.append(pair)
    finally:
        rasterizer.close()
    counts = len(views_a), len(views_b)
    return SessionComparison(drive_a, drive_b, alignment, objects, pairs, surface_a, counts)


def _moved(arrays: Arrays, alignment: DriveAlignment) -> Arrays:
    """Return map b with its anchors in the frame of map a."""
    T_a_b = se2_to_se3(alignment.pose_a_b)
    poses = {
        id: se2_to_se3(alignment.pose_a_submap[id]) if id in alignment.pose_a_submap else T_a_b @ T
        for id, T in zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"])
    }
    return with_anchors(arrays, poses)


def _views(drive: MappedDrive, rasterizer: Rasterizer, progress: Progress) -> list[DepthView]:
    total, out = len(drive.keyframes), []
    for view in depth_views(drive, rasterizer):
        out.append(view)
        progress(f"rendering {drive.name}", len(out), total)
    if not out:
        raise UserError(f"{drive.name}: no keyframe can be decoded; the camera of this session says nothing")
    return out


def _beam_height_m(drive: MappedDrive) -> float:
    """Return the height of the lidar's plane in the map frame: the median of the returns in the keyframes."""
    heights = []
    for view in drive.keyframes[:: max(len(drive.keyframes) // 20, 1)]:
        try:
            u, v, z = np.asarray(drive.read(view.id).beams_uvz, dtype=np.float64).reshape(-1, 3).T
        except ValueError:
            continue
        c, T = view.camera, view.T_map_camera
        local = np.stack([(u - c.cx_px) / c.fx_px * z, (v - c.cy_px) / c.fy_px * z, z])
        heights.append(T[2, :3] @ local + T[2, 3])
    return float(np.median(np.concatenate(heights))) if heights and sum(map(len, heights)) else 0.0


def write_comparison(result: SessionComparison, out: Path) -> list[Path]:
    """Write changes.json, top_view.png, object_N.png and changes.ply into the folder `out`; return the files.

    Raises:
        OSError: the disk is full or broken, or the folder cannot be written.
    """
    make_folder(out)
    files = []

    def image(name: str, bgr: np.ndarray) -> None:
        write_atomically(out / name, cv2.imencode(".png", bgr)[1].tobytes())
        files.append(out / name)

    above = maps_from_above(result.a, result.b, result.objects)
    if above is not None:
        image("top_view.png", above)
    for number, pair in enumerate(result.pairs, 1):
        if pair is not None:
            image(f"object_{number}.png", np.hstack([pair.before, pair.after]))
    points, colours = [result.surface.points_m], [result.surface.colours]
    for found in result.objects:
        points.append(found.points_m)
        colours.append(np.tile(np.array(COLOUR_BGR[found.kind][::-1], np.uint8), (len(found.points_m), 1)))
    write_ply(out / "changes.ply", np.concatenate(points), np.concatenate(colours))
    files.append(out / "changes.ply")
    write_atomically(out / "changes.json", (json.dumps(result.as_json(), indent=1) + "\n").encode())
    return [*files, out / "changes.json"]
