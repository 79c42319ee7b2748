"""Calibration of camera and lidar from a recorded drive, or from still images and scans of a chessboard."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.rig import load_rig
from beamsplat.common.geometry.transforms import transform_points
from beamsplat.services.fusion.calibration.board import BoardPair, chessboard_plane, level_mount, solve_board
from beamsplat.services.fusion.calibration.board_edges import edge_errors, image_edges
from beamsplat.services.fusion.calibration.motion import (
    PARAMETERS,
    MotionCalibration,
    TrackedPair,
    solve_motion,
)
from beamsplat.services.fusion.calibration.startup_check import describe_calibration
from beamsplat.services.fusion.relative_pose import detect_corners, track_corners
from beamsplat.tools.evaluation.drive import RecordedDrive

_WIDTH_PX = 320  # images are tracked at this width
_PAIR_BASELINE_NS = 1_000_000_000  # longer pairs have more rotation relative to the noise of the poses
_PAIR_PERIOD_NS = 250_000_000
_HALF_BOARD_M = 0.26  # beams this close to the board's centre can hit it


def tracked_pairs(drive: RecordedDrive, clock_offset_ns: int = 0) -> list[TrackedPair]:
    """Return image corners tracked over 1 s, one set per 0.25 s of the drive, as rays at both times.

    `clock_offset_ns` is added to the stamps of the images.
    """
    cv2.setNumThreads(1)
    height = round(drive.camera.height_px * _WIDTH_PX / drive.camera.width_px)
    camera = drive.undistort.pinhole.resized(_WIDTH_PX, height)
    stamps = np.array([image.stamp_ns for image in drive.images], dtype=np.int64)
    pairs = []
    begin = int(stamps[0])
    while begin + _PAIR_BASELINE_NS < stamps[-1]:
        i = int(np.searchsorted(stamps, begin))
        j = int(np.searchsorted(stamps, stamps[i] + _PAIR_BASELINE_NS))
        begin += _PAIR_PERIOD_NS
        if j >= len(stamps):
            break
        grey = [
            cv2.resize(cv2.cvtColor(drive.rgb(k), cv2.COLOR_RGB2GRAY), (_WIDTH_PX, height),
                       interpolation=cv2.INTER_AREA)
            for k in (i, j)
        ]  # fmt: skip
        uv = detect_corners(grey[0], 80)
        moved, good = track_corners(grey[0], grey[1], uv, uv)
        if good.any():
            pairs.append(TrackedPair(
                int(stamps[i]) + clock_offset_ns, int(stamps[j]) + clock_offset_ns,
                camera.rays(uv[good]), camera.rays(moved[good]),
            ))  # fmt: skip
    return pairs


def calibrate_motion(drive: RecordedDrive, free: tuple[str, ...] = PARAMETERS) -> MotionCalibration:
    """Estimate the clock offset and the mount of the camera from the motion of a drive.

    `free` names the parameters to estimate; the others stay as in the drive's calibration.

    Raises:
        UserError: too few corners can be tracked, or the drive has no poses at the images.
    """
    focal = drive.camera.fx_px * _WIDTH_PX / drive.camera.width_px
    try:
        return solve_motion(tracked_pairs(drive), drive.pose, drive.T_body_camera, focal, free)
    except ValueError as error:
        raise UserError(f"{drive.path}: {error}") from error


def calibrate_board(
    folder: Path, rig_file: Path, corner_counts: tuple[int, int], square_m: float
) -> dict[str, Any]:
    """Estimate yaw, x and z of the lidar in the camera frame from images and scans of a chessboard.

    Args:
        folder: contains `images/<stamp_ns>.png` and `lasers/<stamp_ns>.pcd`.
        rig_file: rig.toml with the camera's intrinsics; mounts in it are the start of the estimation.
        corner_counts: inner corners of the chessboard, (columns, rows).
        square_m: side of a square of the chessboard.

    Returns:
        The entries of the JSON report of `calibrate extrinsics --target board`, by name.

    Raises:
        UserError: files are missing, the rig has no camera, or fewer than two images show the board.
    """
    loaded = load_rig(rig_file)
    if loaded.camera is None:
        raise UserError(f"{rig_file} has no [camera]; calibration with a board needs K and distortion")
    camera = Pinhole.of(loaded.camera.model())
    pairs, images, missing = [], [], []
    for image_file, cloud_file in pair_files(folder):
        grey = cv2.imread(str(image_file), cv2.IMREAD_GRAYSCALE)
        if grey is None or grey.shape != camera.shape:
            raise UserError(f"{image_file} is not an image of {camera.width_px}x{camera.height_px} pixels")
        plane = chessboard_plane(grey, camera, corner_counts, square_m)
        if plane is None:
            missing.append(image_file.name)
            continue
        images.append(grey)
        pairs.append(BoardPair(plane[0], plane[1], plane[2], _HALF_BOARD_M, read_pcd(cloud_file)))
    if len(pairs) < 2:
        raise UserError(
            f"{folder}: a board of {corner_counts} corners was found in {len(pairs)} images; at "
            f"least 2 are needed"
        )
    start, y_m = (0.0, 0.0, 0.0), 0.0
    if loaded.lidar is not None:
        T = np.linalg.inv(loaded.camera.model().T_body_camera) @ loaded.lidar.model().T_body_lidar
        start = (float(np.arctan2(-T[0, 0], T[2, 0])), float(T[0, 3]), float(T[2, 3]))
        y_m = float(T[1, 3])
    try:
        found = solve_board(pairs, start, y_m)
    except ValueError as error:
        raise UserError(f"{folder}: {error}") from error
    pinhole = Undistorter(camera).pinhole
    edges = [
        image_edges(
            grey, camera, pinhole.project(transform_points(found.T_camera_lidar, pair.points_lidar[beams]))[0]
        )
        for grey, pair, beams in zip(images, pairs, found.on_board)
    ]  # fmt: skip
    before = edge_errors(
        pairs, found.on_board, edges, level_mount(start[0], start[1], y_m, start[2]), pinhole
    )
    after = edge_errors(pairs, found.on_board, edges, found.T_camera_lidar, pinhole)
    return {
        "edges": len(after.errors_px), "edge_error_before_px": before.median_px,
        "edge_error_px": after.median_px, "edge_spot_px": after.spot_px,
        "edge_errors_px": after.errors_px.tolist(),
        "pairs": len(pairs), "without_board": missing, "yaw_deg": float(np.degrees(found.yaw_rad)),
        "x_m": found.x_m, "z_m": found.z_m, "yaw_sigma_deg": float(np.degrees(found.sigma[0])),
        "x_sigma_m": float(found.sigma[1]), "z_sigma_m": float(found.sigma[2]), "rms_m": found.rms_m,
        "beams": found.beams, "not_observable": ["height", "roll", "pitch"],
        "T_camera_lidar": found.T_camera_lidar.tolist(),
    }  # fmt: skip


def pair_files(folder: Path, tolerance_ns: int = 100_000_000) -> list[tuple[Path, Path]]:
    """Return each image file of a folder with the point cloud file nearest in time.

    Images without a point cloud within `tolerance_ns` are left out.

    Raises:
        UserError: no image has a point cloud.
    """
    images = {int(p.stem): p for p in sorted((folder / "images").glob("*.png")) if p.stem.isdigit()}
    clouds = {int(p.stem): p for p in sorted((folder / "lasers").glob("*.pcd")) if p.stem.isdigit()}
    pairs = []
    for stamp, image in images.items():
        near = min(clouds, key=lambda s: abs(s - stamp), default=None)
        if near is not None and abs(near - stamp) <= tolerance_ns:
            pairs.append((image, clouds[near]))
    if not pairs:
        raise UserError(
            f"{folder}: expected images/<stamp_ns>.png and lasers/<stamp_ns>.pcd with stamps at most"
            f" 0.1 s apart"
        )
    return pairs


def read_pcd(path: Path) -> np.ndarray:
    """Return the points float64 [N, 3] (x, y, z in m) of an ASCII PCD file; its first fields must be x, y, z.

    Points with a coordinate that is not finite are left out.

    Raises:
        UserError: the file has another format.
    """
    try:
        head, _, body = path.read_text().partition("DATA ascii\n")
        values = np.array(
            [[float(w) for w in line.split()[:3]] for line in body.splitlines() if line.strip()]
        )
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise UserError(f"{path}: not an ASCII PCD file: {reason(error)}") from error
    if "FIELDS x y z" not in head or values.ndim != 2 or values.shape[1] != 3:
        raise UserError(f"{path}: not an ASCII PCD file with fields x y z")
    return values[np.all(np.isfinite(values), axis=1)]


def motion_report(drive: RecordedDrive, found: MotionCalibration) -> dict[str, Any]:
    """Return the JSON report of a motion calibration: values, standard errors, residuals in px, quality.

    Angles are in degrees, the clock offset in ms, and lengths in m. Values that were not estimated are None.
    """
    report: dict[str, Any] = {
        "corners": found.corners, "residual_px": found.residual_px,
        "residual_before_px": found.residual_before_px,
    }  # fmt: skip
    unknown = []
    for name, value, sigma, sure in zip(PARAMETERS, found.values, found.sigma, found.observable):
        unit = 180.0 / np.pi if name.endswith("_rad") else 1e3 if name == "clock_s" else 1.0
        shown = name.replace("_rad", "_deg").replace("clock_s", "clock_ms")
        report[shown] = float(value * unit) if np.isfinite(sigma) else None
        report[f"{shown}_sigma"] = float(sigma * unit) if np.isfinite(sigma) else None
        if np.isfinite(sigma) and not sure:
            unknown.append(name.rsplit("_", 1)[0])
    report["not_observable"] = [*unknown, "z: a body on a floor never moves along z"]
    report["status"] = describe_calibration(found)[1]
    report["T_body_camera"] = found.mount(drive.T_body_camera).tolist()
    return report


def with_clock_offset(drive: RecordedDrive, offset_ns: int) -> RecordedDrive:
    """Return a copy of the drive with `offset_ns` added to the stamps of its images.

    It is used to test whether the calibration estimates this offset.
    """
    images = [image.model_copy(update={"stamp_ns": image.stamp_ns + offset_ns}) for image in drive.images]
    return replace(drive, images=images)
