"""Renders of a map along a camera path, as a video or as numbered PNG files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import Trajectory
from beamsplat.common.geometry.transforms import interpolate, make_transform
from beamsplat.common.mapfiles.scores import render_rgb_depth
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN, OPACITY
from beamsplat.common.raster.rasterizer import Rasterizer


def orbit_poses(store: GaussianStore, target_height_m: float, frames: int) -> list[np.ndarray]:
    """Return T_map_camera of a circle around the map, looking down at 35 degrees; the whole map is in the
    image.

    Args:
        target_height_m: upper limit on the height of the point at the image centre.

    Raises:
        UserError: no Gaussian has an opacity above 0.5.
    """
    solid = store.params[MEAN : MEAN + 3, : store.count][:, store.params[OPACITY, : store.count] > 0.0]
    if solid.shape[1] == 0:
        raise UserError("the map has no opaque Gaussians: there is nothing to render")
    low, high = np.percentile(solid, [2.0, 98.0], axis=1)
    centre, reach = 0.5 * (low + high), 0.55 * float(np.linalg.norm(high - low))
    centre[2] = min(centre[2], target_height_m)
    angles = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    down = np.radians(35.0)
    offsets = np.stack([np.cos(angles) * np.cos(down), np.sin(angles) * np.cos(down),
                        np.full(frames, np.sin(down))], axis=1)  # fmt: skip
    return [look_at(centre + 1.6 * reach * offset, centre) for offset in offsets]


def look_at(camera_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    """Return T_map_camera of an upright camera at `camera_m` [3] with `target_m` [3] at the image centre."""
    forward = (target_m - camera_m) / np.linalg.norm(target_m - camera_m)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight up or down: the direction to the right is arbitrary
        right = np.array([0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    return make_transform(np.stack([right, np.cross(forward, right), forward], axis=1), camera_m)


def interpolate_path(poses: list[np.ndarray], frames: int) -> list[np.ndarray]:
    """Return `frames` poses [4, 4], interpolated at equal steps along a list of poses."""
    if len(poses) == 1:
        return [poses[0]] * frames
    at = np.linspace(0.0, len(poses) - 1.0, frames)
    before = np.minimum(at.astype(int), len(poses) - 2)
    return [interpolate(poses[i], poses[i + 1], float(s - i)) for i, s in zip(before, at)]


def trajectory_poses(trajectory: Trajectory, T_body_camera: np.ndarray, frames: int) -> list[np.ndarray]:
    """Return T_map_camera at `frames` equally spaced stamps of a trajectory of body poses."""
    stamps = np.linspace(trajectory.stamps_ns[0], trajectory.stamps_ns[-1], frames).astype(np.int64)
    return [T @ T_body_camera for T in trajectory.resampled(stamps)[1]]


def render_path(
    store: GaussianStore, camera: RasterCamera, poses: Iterable[np.ndarray], threads: int
) -> Iterator[np.ndarray]:
    """Yield the RGB image uint8 [H, W, 3] of the map from each T_map_camera."""
    rasterizer = Rasterizer(threads)
    try:
        for T_map_camera in poses:
            rgb, _, _ = render_rgb_depth(rasterizer, store, camera, T_map_camera)
            yield (rgb * 255.0 + 0.5).astype(np.uint8)
    finally:
        rasterizer.close()


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, count: int) -> list[Path]:
    """Write images as one video (`.mp4`) or as one file each (`.png`); return the files.

    Args:
        frames: uint8 [H, W, 3] RGB each.
        count: how many there are; one `.png` is NAME.png, several are NAME-0001.png and so on.

    Raises:
        UserError: the name has another suffix, or a file cannot be written.
    """
    if path.suffix not in (".mp4", ".png"):
        raise UserError(f"--out {path}: expected a name that ends in .mp4 or .png")
    path.parent.mkdir(parents=True, exist_ok=True)
    writer, written = None, []
    for number, rgb in enumerate(frames, start=1):
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        if path.suffix == ".png":
            file = path if count == 1 else path.with_name(f"{path.stem}-{number:04d}.png")
            if not cv2.imwrite(str(file), bgr):
                raise UserError(f"{file}: cannot be written")
            written.append(file)
            continue
        if writer is None:
            size = (rgb.shape[1] // 2 * 2, rgb.shape[0] // 2 * 2)  # the codec requires even sizes
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
            if not writer.isOpened():
                raise UserError(f"{path}: cannot be written as a video; choose another folder, or .png")
            written.append(path)
        writer.write(np.ascontiguousarray(bgr[: size[1], : size[0]]))
    if writer is not None:
        writer.release()
    return written
