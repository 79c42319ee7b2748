"""Triangle mesh of a map: rendered depth fused into a TSDF volume (Curless & Levoy 1996), then surface nets.

Each cell with eight observed corners has its part of the surface, and neighbours share vertices: the mesh is
closed in observed space and open only at its border.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.common.mapfiles.surface import RenderedDepth
from beamsplat.common.raster.camera import RasterCamera

MAX_VOXELS = 40_000_000  # 24 bytes each, 1 GB in all
TRUNCATION = 4.0  # truncation distance in voxels
_MIN_DEPTH_M = 0.1  # voxels nearer to the camera are not updated


@dataclass
class TsdfVolume:
    """A truncated signed distance field (TSDF) with colour, on a voxel grid in the map frame.

    Distances to the surface are measured along the camera rays, positive in front of the surface.
    """

    origin_m: np.ndarray  # float64 [3]: centre of voxel (0, 0, 0)
    voxel_m: float
    distance: np.ndarray  # float32 [X, Y, Z] in [-1, 1], in units of the truncation distance
    weight: np.ndarray  # float32 [X, Y, Z]: number of views; 0 = not observed
    colour: np.ndarray  # float32 [X, Y, Z, 3]: sum over views near the surface
    near: np.ndarray  # float32 [X, Y, Z]: number of views near the surface

    @staticmethod
    def around(low_m: np.ndarray, high_m: np.ndarray, voxel_m: float) -> TsdfVolume:
        """Return an empty volume over a box in the map frame, plus a margin.

        Args:
            low_m, high_m: corners of the box with the smallest and the largest coordinates, [3] each.
            voxel_m: edge of a voxel.

        Raises:
            ValueError: too many voxels; the text contains the smallest possible `voxel_m`.
        """
        margin = (TRUNCATION + 1.0) * voxel_m
        shape = np.ceil((high_m - low_m + 2.0 * margin) / voxel_m).astype(int) + 1
        count = float(np.prod(shape.astype(np.float64)))
        if count > MAX_VOXELS:
            enough = voxel_m * (count / MAX_VOXELS) ** (1 / 3) * 1.02
            raise ValueError(
                f"{count / 1e6:.0f} million voxels of {voxel_m:g} m are too many; use {enough:.3f} m or more"
            )
        x, y, z = shape
        return TsdfVolume(
            low_m - margin, voxel_m, np.zeros((x, y, z), np.float32), np.zeros((x, y, z), np.float32),
            np.zeros((x, y, z, 3), np.float32), np.zeros((x, y, z), np.float32),
        )  # fmt: skip

    def add(self, views: Iterable[RenderedDepth]) -> None:
        """Fuse the depth and colour of rendered views into the volume."""
        for view in views:
            c, R, t = view.camera, view.T_map_camera[:3, :3], view.T_map_camera[:3, 3]
            numbers = np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px, self.voxel_m])
            _fuse(
                self.distance, self.weight, self.colour, self.near, numbers, np.ascontiguousarray(R.T),
                R.T @ (self.origin_m - t), view.depth_m, np.ascontiguousarray(view.rgb),
            )  # fmt: skip


@kernel
def _fuse(
    distance: np.ndarray, weight: np.ndarray, colour: np.ndarray, near: np.ndarray, numbers: np.ndarray,
    R_camera_map: np.ndarray, first_camera: np.ndarray, depth: np.ndarray, rgb: np.ndarray,
) -> None:  # fmt: skip
    """Fuse one view into the arrays of a TsdfVolume; `first_camera` [3] is voxel (0, 0, 0) in the camera
    frame.
    """
    fx, fy, cx, cy, voxel = numbers
    reach = TRUNCATION * voxel
    height, width = depth.shape
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            for k in range(distance.shape[2]):
                z = first_camera[2] + voxel * (
                    R_camera_map[2, 0] * i + R_camera_map[2, 1] * j + R_camera_map[2, 2] * k
                )
                if z < _MIN_DEPTH_M:
                    continue
                x = first_camera[0] + voxel * (
                    R_camera_map[0, 0] * i + R_camera_map[0, 1] * j + R_camera_map[0, 2] * k
                )
                y = first_camera[1] + voxel * (
                    R_camera_map[1, 0] * i + R_camera_map[1, 1] * j + R_camera_map[1, 2] * k
                )
                u, v = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                surface = depth[v, u]
                if not surface > 0.0 or surface - z < -reach:
                    continue
                d = min((surface - z) / reach, 1.0)
                w = weight[i, j, k]
                distance[i, j, k] = (distance[i, j, k] * w + d) / (w + 1.0)
                weight[i, j, k] = w + 1.0
                if d < 1.0:
                    near[i, j, k] += 1.0
                    for channel in range(3):
                        colour[i, j, k, channel] += rgb[v, u, channel]


@dataclass(frozen=True)
class TriangleMesh:
    """A coloured mesh; the normals of its triangles point to free space."""

    vertices_m: np.ndarray  # float64 [N, 3]
    colours: np.ndarray  # uint8 [N, 3]
    faces: np.ndarray  # int32 [M, 3]


def surface_nets(field: TsdfVolume) -> TriangleMesh:
    """Return the surface of a volume (distance 0) as a triangle mesh, by surface nets (Gibson 1998).

    Each cell that the surface crosses has one vertex, each crossed voxel edge one quad (two triangles).
    """
    corners = list(product((0, 1), repeat=3))
    shape = tuple(n - 1 for n in field.distance.shape)

    def at(array: np.ndarray, corner: tuple[int, ...]) -> np.ndarray:
        return array[tuple(slice(c, c + n) for c, n in zip(corner, shape))]

    seen = np.ones(shape, bool)
    inside = np.zeros(shape, np.uint8)
    for corner in corners:
        seen &= at(field.weight, corner) > 0
        inside += at(field.distance, corner) < 0
    cells = np.argwhere(seen & (inside > 0) & (inside < 8))
    number = np.full(shape, -1, np.int32)
    number[tuple(cells.T)] = np.arange(len(cells))
    values = np.stack([field.distance[tuple((cells + c).T)] for c in corners], axis=1).astype(np.float64)
    vertices = field.origin_m + (cells + _crossings(values, corners)) * field.voxel_m
    near = sum(field.near[tuple((cells + c).T)] for c in corners)
    colour = sum(field.colour[tuple((cells + c).T)] for c in corners)
    rgb = colour / np.maximum(near, 1.0)[:, None]
    faces = _quads_as_triangles(field, number)
    return TriangleMesh(vertices, np.clip(rgb * 255.0 + 0.5, 0, 255).astype(np.uint8), faces)


def _crossings(values: np.ndarray, corners: list[tuple[int, ...]]) -> np.ndarray:
    """Return float64 [N, 3] in [0, 1]: the mean zero crossing of the 12 cell edges, from corner values [N,
    8].
    """
    total, count = np.zeros((len(values), 3)), np.zeros(len(values))
    for a, b in combinations(range(8), 2):
        p, q = np.array(corners[a]), np.array(corners[b])
        if np.abs(p - q).sum() != 1:
            continue
        first, second = values[:, a], values[:, b]
        crosses = (first < 0) != (second < 0)
        share = np.where(crosses, first / np.where(crosses, first - second, 1.0), 0.0)
        total += crosses[:, None] * (p + share[:, None] * (q - p))
        count += crosses
    return total / np.maximum(count, 1)[:, None]


def _quads_as_triangles(field: TsdfVolume, number: np.ndarray) -> np.ndarray:
    """Return int32 [M, 3]: two triangles for each zero-crossing voxel edge with vertices in all cells."""
    out = []
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        before, after = field.distance[tuple(low)] < 0, field.distance[tuple(high)] < 0
        both = (field.weight[tuple(low)] > 0) & (field.weight[tuple(high)] > 0)
        edges = np.argwhere((before != after) & both)
        b, c = (axis + 1) % 3, (axis + 2) % 3
        inner = np.all(edges[:, [b, c]] > 0, axis=1) & np.all(
            edges[:, [b, c]] < np.array(number.shape)[[b, c]], axis=1
        )
        edges = edges[inner]
        step_b, step_c = np.eye(3, dtype=int)[b], np.eye(3, dtype=int)[c]
        around = (edges - step_b - step_c, edges - step_c, edges, edges - step_b)
        quad = np.stack([number[tuple(cell.T)] for cell in around], axis=1)
        turned = after[
            tuple(edges.T)
        ]  # free in front of it, solid behind: the normal points against the axis
        whole = np.all(quad >= 0, axis=1)
        quad = np.where(turned[:, None], quad[:, ::-1], quad)[whole]
        out += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(out).astype(np.int32)


def remove_small_components(mesh: TriangleMesh, min_faces: int) -> TriangleMesh:
    """Return the mesh without connected components of fewer than `min_faces` triangles."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count, faces = len(mesh.vertices_m), mesh.faces
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    _, piece = connected_components(links, directed=False)
    size = np.bincount(piece[faces[:, 0]], minlength=piece.max(initial=0) + 1)
    faces = faces[size[piece[faces[:, 0]]] >= min_faces]
    used, faces = np.unique(faces, return_inverse=True)
    return TriangleMesh(mesh.vertices_m[used], mesh.colours[used], faces.reshape(-1, 3).astype(np.int32))


def warm() -> None:
    """Compile the fusion kernel with the array types used in production."""
    camera = RasterCamera(10.0, 10.0, 3.5, 3.5, 8, 8)
    view = RenderedDepth(camera, np.eye(4), np.zeros((8, 8, 3), np.float32), np.ones((8, 8), np.float32))
    TsdfVolume.around(np.zeros(3), np.ones(3), 0.5).add([view])
