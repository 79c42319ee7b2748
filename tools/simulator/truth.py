"""Ground-truth files beside the bag: held-out views off the path, and points of the seen surface."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.geometry.transforms import so3_exp
from beamsplat.tools.simulator.camera import TONE, WHITE, ImageSensor, pixel_rays
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.frames import FrameRenderer, depth_mm
from beamsplat.tools.simulator.render import RenderedView, ray_table
from beamsplat.tools.simulator.settings import CameraSettings
from beamsplat.tools.simulator.shade import ShadingTables, sample
from beamsplat.tools.simulator.writer import transform_json, write_png

OFF_PATH_M = (0.15, 0.60)  # smallest and largest distance of a held-out view from the path
MIN_SEEN_RATIO = 0.85  # smallest ratio of a held-out view's pixels that depth maps of the drive also show


@dataclass(frozen=True)
class DepthViews:
    """Depth maps of N images of the drive with camera poses, to test whether a point is visible."""

    T_world_camera: np.ndarray  # float64 [N, 4, 4]
    depth_mm: np.ndarray  # uint16 [N, H, W], in the pixels of the (distorted) images, 0 = no surface
    K: np.ndarray  # float64 [3, 3], intrinsic matrix in pixels
    distortion: tuple[float, ...]  # plumb_bob: k1, k2, p1, p2, k3

    def count(self, points_m: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return int32 [P]: the number of views in which each world point [P, 3] is visible.

        A point is visible only from the side towards which its normal [P, 3] points.
        """
        return _count_views(
            np.ascontiguousarray(points_m, dtype=np.float64),
            np.ascontiguousarray(normals, dtype=np.float64),
            self.T_world_camera,
            self.depth_mm,
            self.K,
            np.array(self.distortion, dtype=np.float64),
        )


@kernel
def _count_views(
    points: np.ndarray, normals: np.ndarray, T: np.ndarray, depth: np.ndarray, K: np.ndarray, d: np.ndarray
) -> np.ndarray:
    seen = np.zeros(len(points), np.int32)
    height, width = depth.shape[1:]
    for i in range(len(points)):
        for k in range(len(T)):
            x, y, z = points[i, 0] - T[k, 0, 3], points[i, 1] - T[k, 1, 3], points[i, 2] - T[k, 2, 3]
            if normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z > -1e-4:
                continue
            cz = T[k, 0, 2] * x + T[k, 1, 2] * y + T[k, 2, 2] * z
            if cz < 0.05:
                continue
            cx = (T[k, 0, 0] * x + T[k, 1, 0] * y + T[k, 2, 0] * z) / cz
            cy = (T[k, 0, 1] * x + T[k, 1, 1] * y + T[k, 2, 1] * z) / cz
            r2 = cx * cx + cy * cy
            if r2 > 2.0:
                continue
            radial = 1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))
            u = K[0, 0] * (cx * radial + 2 * d[2] * cx * cy + d[3] * (r2 + 2 * cx * cx)) + K[0, 2]
            v = K[1, 1] * (cy * radial + d[2] * (r2 + 2 * cy * cy) + 2 * d[3] * cx * cy) + K[1, 2]
            column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            if 0 <= column < width and 0 <= row < height:
                there = depth[k, row, column] * 0.001
                if there > 0.0 and abs(there - cz) < 0.015 + 0.01 * cz:
                    seen[i] += 1
    return seen


def surface_points(
    scene: ShadingTables, depth_views: DepthViews, wanted: int, gain: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Sample points uniformly by area on the surface that is visible in at least one of the depth views.

    `gain` is the exposure gain for the colours.

    Returns:
        Points float32 [N, 3] in metres in the world frame, and their RGB colours uint8 [N, 3]. N = `wanted`,
        or less if almost no surface is visible.
    """
    area = np.linalg.norm(scene.normal, axis=1) / 2
    unit = scene.normal / np.maximum(2 * area[:, None], 1e-30)
    e1, e2 = _edges(scene)
    # Triangles are small: a triangle is not sampled if neither a corner nor its middle is visible.
    probes = np.stack(
        [
            scene.corner + 0.02 * (e1 + e2),
            scene.corner + 0.96 * e1,
            scene.corner + 0.96 * e2,
            scene.corner + (e1 + e2) / 3,
        ]
    )
    in_sight = np.any([depth_views.count(p, unit) > 0 for p in probes], axis=0)
    weight = np.where(in_sight, area, 0.0)
    if weight.sum() <= 0.0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    found, colours, total = [], [], 0
    for _ in range(12):
        triangle = rng.choice(len(area), size=wanted, p=weight / weight.sum())
        a, b = rng.random((2, len(triangle)))
        fold = a + b > 1
        a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
        points = scene.corner[triangle] + a[:, None] * e1[triangle] + b[:, None] * e2[triangle]
        keep = depth_views.count(points, unit[triangle]) > 0
        found.append(points[keep].astype(np.float32))
        colours.append(_colours(scene, triangle[keep], a[keep], b[keep], gain))
        total += int(keep.sum())
        if total >= wanted:
            break
    order = rng.permutation(total)[:wanted]
    return np.concatenate(found)[order], np.concatenate(colours)[order]


def _edges(scene: ShadingTables) -> tuple[np.ndarray, np.ndarray]:
    """Return both edge vectors [F, 3] of each triangle, recovered from its dual basis `scene.dual`.

    dual_1 = e2 x n / n^2 and dual_2 = n x e1 / n^2, hence n x dual_1 = e2 and dual_2 x n = e1.
    """
    dual = scene.dual.astype(np.float64)
    return np.cross(dual[:, 1], scene.normal), np.cross(scene.normal, dual[:, 0])


def _colours(
    scene: ShadingTables, triangle: np.ndarray, a: np.ndarray, b: np.ndarray, gain: float
) -> np.ndarray:
    radiance = np.empty((len(triangle), 3))
    _point_radiance(scene, triangle, a, b, radiance)
    at = np.clip(radiance * gain * WHITE + 0.5, 0, len(TONE) - 1).astype(int)
    return np.rint(TONE[at]).astype(np.uint8)


@kernel
def _point_radiance(
    s: ShadingTables, triangle: np.ndarray, a: np.ndarray, b: np.ndarray, out: np.ndarray
) -> None:
    texel = np.zeros(3)
    for i in range(len(triangle)):
        f = triangle[i]
        u = s.uv[f, 0, 0] + a[i] * s.uv[f, 1, 0] + b[i] * s.uv[f, 2, 0]
        v = s.uv[f, 0, 1] + a[i] * s.uv[f, 1, 1] + b[i] * s.uv[f, 2, 1]
        sample(s, s.texture[f], u, v, 1e-9, 0.0, 0.0, 1e-9, texel)
        for c in range(3):
            light = (1 - a[i] - b[i]) * s.light[f, 0, c] + a[i] * s.light[f, 1, c] + b[i] * s.light[f, 2, c]
            out[i, c] = texel[c] * s.tint[f, c] * (light + s.emission[f])


def write_extra_views(
    folder: Path,
    frame_renderer: FrameRenderer,
    space: ClearanceGrid,
    depth_views: DepthViews,
    times_s: np.ndarray,
    count: int,
    rng: np.random.Generator,
    progress: Callable[[int, int], None],
) -> int:
    """Write random held-out views off the path: pinhole images, depth and poses, no dynamic objects.

    The surface in at least MIN_SEEN_RATIO of the pixels of a view is visible in the depth views of the drive.

    Args:
        folder: new folder for the files.
        frame_renderer: renderer of the frames of the drive.
        space: free floor of the scene.
        depth_views: depth maps of the drive.
        times_s: float64 [N], times of the images in seconds since the start of the lap.
        count: wanted number of views.
        progress: called with the number of finished views and `count`.

    Returns:
        The number of written views: `count`, or fewer if too few random candidates qualify.
    """
    folder.mkdir()
    camera = frame_renderer.spec.camera
    table = ray_table(pixel_rays(camera.width_px, camera.height_px, camera.K))
    sensor = ImageSensor(table.rays, noise=0.0, vignetting=camera.vignetting, quality=camera.jpeg_quality)
    small = ray_table(pixel_rays(48, 36, _scaled(camera, 48)))
    path = frame_renderer.drive.pose_at(np.linspace(times_s[0], times_s[-1], 2000))[:, :2]
    views: list[dict[str, object]] = []
    for _ in range(count * 40):
        if len(views) == count:
            break
        T_world_camera, offset = _random_view(frame_renderer, space, path, times_s, rng)
        if T_world_camera is None:
            continue
        seen_ratio = _seen_ratio(
            frame_renderer,
            depth_views,
            T_world_camera,
            frame_renderer.render_static(T_world_camera, small),
            small.rays,
        )
        if seen_ratio < MIN_SEEN_RATIO:
            continue
        view = frame_renderer.render_static(T_world_camera, table)
        name = f"{len(views):03d}"
        bgr = sensor.develop(view.radiance, frame_renderer.gain, np.random.default_rng(0))
        (folder / f"{name}.jpg").write_bytes(sensor.jpeg(bgr))
        write_png(folder / f"{name}_depth.png", depth_mm(view.depth_z_m))
        pose = transform_json(T_world_camera)
        views.append(
            {
                "file": f"{name}.jpg",
                "depth": f"{name}_depth.png",
                "T_world_camera": pose["matrix"],
                "translation_xyz": pose["translation_xyz"],
                "quaternion_xyzw": pose["quaternion_xyzw"],
                "distance_to_trajectory_m": offset,
                "fraction_seen_in_sequence": seen_ratio,
            }
        )
        progress(len(views), count)
    K = camera.K
    intrinsics = {
        "width": camera.width_px,
        "height": camera.height_px,
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "distortion": [0, 0, 0, 0, 0],
    }
    (folder / "poses.json").write_text(
        json.dumps({"intrinsics": intrinsics, "views": views}, indent=1) + "\n"
    )
    return len(views)


def _scaled(camera: CameraSettings, width: int) -> np.ndarray:
    scale = width / camera.width_px
    K = camera.K * scale
    K[0, 2], K[1, 2], K[2, 2] = (width - 1) / 2, (width * camera.height_px / camera.width_px - 1) / 2, 1.0
    return K


def _random_view(
    frame_renderer: FrameRenderer,
    space: ClearanceGrid,
    path: np.ndarray,
    times_s: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray | None, float]:
    T_world_camera = frame_renderer.camera_pose(float(rng.choice(times_s)))
    sideways = rng.uniform(*OFF_PATH_M) * rng.choice([-1.0, 1.0])
    position = (
        T_world_camera[:3, 3]
        + T_world_camera[:3, 0] * sideways
        + T_world_camera[:3, 2] * rng.uniform(-0.2, 0.2)
    )
    offset = float(np.linalg.norm(path - position[:2], axis=1).min())
    if not OFF_PATH_M[0] <= offset <= OFF_PATH_M[1] or space.clearance(position[None, :2])[0] < 0.18:
        return None, offset
    turn = so3_exp([0.0, 0.0, rng.normal(0.0, 0.25)])
    tilt = so3_exp([rng.normal(0.0, 0.05), 0.0, rng.normal(0.0, 0.02)])
    out = np.eye(4)
    out[:3, :3] = turn @ T_world_camera[:3, :3] @ tilt
    out[:3, 3] = [position[0], position[1], rng.uniform(0.38, 0.62)]
    return out, offset


def _seen_ratio(
    frame_renderer: FrameRenderer,
    depth_views: DepthViews,
    T_world_camera: np.ndarray,
    view: RenderedView,
    rays: np.ndarray,
) -> float:
    depth, triangle = view.depth_z_m.ravel(), view.triangle.ravel()
    valid = triangle >= 0
    points = (rays.reshape(-1, 3) * depth[:, None])[valid] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    n = frame_renderer.renderer.scene.normal[triangle[valid]]
    flip = np.sign(np.einsum("ij,ij->i", n, T_world_camera[:3, 3] - points))[:, None]
    return float(np.sum(depth_views.count(points, n * flip) > 0) / len(depth))


def decode_depth(png: np.ndarray) -> np.ndarray:
    """Return the depth map uint16 [H, W] in millimetres that is encoded in the PNG bytes uint8 [B]."""
    depth = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    assert depth is not None  # written by the simulator
    return depth
