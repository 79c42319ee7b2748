"""Pictures of a map along a path: a video, or numbered PNGs."""

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


def orbit(store: GaussianStore, eye_height_m: float, frames: int) -> list[np.ndarray]:
    """T_map_camera of a circle around what is solid, seen from above at 35 degrees; the map fits in."""
    solid = store.params[MEAN : MEAN + 3, : store.count][:, store.params[OPACITY, : store.count] > 0.0]
    if solid.shape[1] == 0:
        raise UserError("the map has nothing solid to circle around")
    low, high = np.percentile(solid, [2.0, 98.0], axis=1)
    centre, reach = 0.5 * (low + high), 0.55 * float(np.linalg.norm(high - low))
    centre[2] = min(centre[2], eye_height_m)
    angles = np.linspace(0.0, 2.0 * np.pi, frames, endpoint=False)
    down = np.radians(35.0)
    offsets = np.stack([np.cos(angles) * np.cos(down), np.sin(angles) * np.cos(down),
                        np.full(frames, np.sin(down))], axis=1)  # fmt: skip
    return [looking(centre + 1.6 * reach * offset, centre) for offset in offsets]


def looking(eye_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    """T_map_camera at `eye_m`, upright, with the target in the middle."""
    forward = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight down: any side will do
        right = np.array([0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    return make_transform(np.stack([right, np.cross(forward, right), forward], axis=1), eye_m)


def drive(poses: list[np.ndarray], frames: int) -> list[np.ndarray]:
    """Poses [4, 4] spread evenly over a path through others, in their order."""
    if len(poses) == 1:
        return [poses[0]] * frames
    at = np.linspace(0.0, len(poses) - 1.0, frames)
    before = np.minimum(at.astype(int), len(poses) - 2)
    return [interpolate(poses[i], poses[i + 1], float(s - i)) for i, s in zip(before, at)]


def along(trajectory: Trajectory, T_body_camera: np.ndarray, frames: int) -> list[np.ndarray]:
    """T_map_camera at stamps spread evenly over a trajectory of body poses."""
    stamps = np.linspace(trajectory.stamps_ns[0], trajectory.stamps_ns[-1], frames).astype(np.int64)
    return [T @ T_body_camera for T in trajectory.resampled(stamps)[1]]


def pictures(
    store: GaussianStore, camera: RasterCamera, poses: Iterable[np.ndarray], threads: int
) -> Iterator[np.ndarray]:
    """uint8 [H, W, 3] RGB of each pose."""
    rasterizer = Rasterizer(threads)
    try:
        for T_map_camera in poses:
            rgb, _, _ = render_rgb_depth(rasterizer, store, camera, T_map_camera)
            yield (rgb * 255.0 + 0.5).astype(np.uint8)
    finally:
        rasterizer.close()


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, count: int) -> list[Path]:
    """`.mp4` as one video, `.png` as one file a picture (NAME-0001.png ..., NAME.png if there is only one).

    Raises:
        UserError: another ending, or the file cannot be written.
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
            size = (rgb.shape[1] // 2 * 2, rgb.shape[0] // 2 * 2)  # the codec wants even sizes
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
            if not writer.isOpened():
                raise UserError(f"{path}: cannot be written as a video; choose another folder, or .png")
            written.append(path)
        writer.write(np.ascontiguousarray(bgr[: size[1], : size[0]]))
    if writer is not None:
        writer.release()
    return written
