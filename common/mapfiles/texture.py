"""Texture of a mesh from the images of keyframes: each triangle takes its colours from one image.

View selection in the manner of Waechter et al. (2014): the image in which a triangle is largest, among those
that see it, with a preference for that of its neighbours; connected triangles of one image are a patch of the
texture, cut out of this image. Triangles that no image sees have the colour of their vertices.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.mapfiles.mesh import TriangleMesh
from beamsplat.common.mapfiles.surface import RenderedDepth
from beamsplat.common.raster.camera import RasterCamera

_CANDIDATES = 6  # views kept for each triangle
_MIN_COS = 0.2  # between the normal of a triangle and the direction to the camera
_MIN_DEPTH_M = 0.1
_DEPTH_TOLERANCE = (0.04, 0.02)  # m, and share of the depth: a triangle farther behind is hidden
_MARGIN_PX = 2.0  # from the border of an image
_NEIGHBOUR_GAIN = 0.25  # of a view that a neighbour has, as a share of the best view's score
_ROUNDS = 12  # of the choice among the candidates


@dataclass(frozen=True)
class ViewChoice:
    """The view of each triangle and its patch; -1 = no view sees it."""

    view: np.ndarray  # int32 [M]
    patch: np.ndarray  # int32 [M], numbered from 0; all triangles of a patch are connected and have one view


def choose_views(
    mesh: TriangleMesh, views: Iterable[RenderedDepth], cameras: list[RasterCamera]
) -> ViewChoice:
    """Choose an image for each triangle.

    Args:
        mesh: in the map frame, M triangles.
        views: the rendered depth of the map at each keyframe.
        cameras: of the images of these keyframes, at full size.
    """
    corners = mesh.vertices_m[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    centres = corners.mean(axis=1)
    best = np.full((len(corners), _CANDIDATES), -1, np.int32)
    score = np.zeros((len(corners), _CANDIDATES), np.float32)
    for number, (view, camera) in enumerate(zip(views, cameras)):
        new = _scores(corners, centres, normals, view, camera)
        worst = score.argmin(axis=1)
        rows = np.flatnonzero(new > score[np.arange(len(new)), worst])
        best[rows, worst[rows]], score[rows, worst[rows]] = number, new[rows]
    neighbours = _neighbours(mesh.faces)
    chosen = _smooth(best, score, neighbours)
    return ViewChoice(chosen, _patches(chosen, neighbours))


def project(points_map_m: np.ndarray, camera: RasterCamera, T_map_camera: np.ndarray) -> np.ndarray:
    """Return pixels and optical z (m) of points [..., 3], float64 [..., 3]."""
    x, y, z = np.moveaxis(transform_points(inverse(T_map_camera), points_map_m.reshape(-1, 3)), -1, 0)
    safe = np.where(np.abs(z) > 1e-6, z, 1e-6)
    u, v = camera.fx_px * x / safe + camera.cx_px, camera.fy_px * y / safe + camera.cy_px
    return np.stack([u, v, z], axis=-1).reshape(points_map_m.shape)


def _scores(
    corners: np.ndarray, centres: np.ndarray, normals: np.ndarray, view: RenderedDepth, camera: RasterCamera
) -> np.ndarray:
    """Return the area (px2) of each triangle in an image, float32 [M]; 0 where the image does not see it."""
    to_camera = view.T_map_camera[:3, 3] - centres
    cosine = (normals * to_camera).sum(axis=1) / np.maximum(np.linalg.norm(to_camera, axis=1), 1e-9)
    rows = np.flatnonzero(cosine > _MIN_COS)
    uvz = project(corners[rows], camera, view.T_map_camera)
    inside = np.all(
        (uvz[..., 2] > _MIN_DEPTH_M)
        & (np.abs(uvz[..., 0] - 0.5 * (camera.width_px - 1)) < 0.5 * camera.width_px - _MARGIN_PX)
        & (np.abs(uvz[..., 1] - 0.5 * (camera.height_px - 1)) < 0.5 * camera.height_px - _MARGIN_PX),
        axis=1,
    )
    rows, uvz = rows[inside], uvz[inside]
    u, v, z = np.moveaxis(project(centres[rows], view.camera, view.T_map_camera), -1, 0)
    height, width = view.depth_m.shape
    column = np.clip(np.round(u), 0, width - 1).astype(int)
    row = np.clip(np.round(v), 0, height - 1).astype(int)
    free_m, share = _DEPTH_TOLERANCE
    with np.errstate(invalid="ignore"):
        seen = z - view.depth_m[row, column] < free_m + share * z  # False where the depth is unknown
    rows, uvz = rows[seen], uvz[seen]
    a, b = uvz[:, 1, :2] - uvz[:, 0, :2], uvz[:, 2, :2] - uvz[:, 0, :2]
    out = np.zeros(len(corners), np.float32)
    out[rows] = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return out


def _neighbours(faces: np.ndarray) -> np.ndarray:
    """Return int32 [M, 3]: the triangle beyond each edge, -1 = none (or more than one)."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    side = np.repeat(np.arange(3), len(faces))
    _, which, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(count)[:-1]])[count == 2]
    a, b = order[first], order[first + 1]
    out = np.full((len(faces), 3), -1, np.int32)
    out[face[a], side[a]], out[face[b], side[b]] = face[b], face[a]
    return out


def _smooth(best: np.ndarray, score: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Return the view of each triangle, int32 [M]: iterated conditional modes over its candidates.

    The gain of a candidate is its score, as a share of the best one, plus `_NEIGHBOUR_GAIN` for each
    neighbour with the same view.
    """
    rows = np.arange(len(best))
    share = np.where(best >= 0, score / np.maximum(score.max(axis=1, keepdims=True), 1e-12), -np.inf)
    share = np.where((best >= 0).any(axis=1, keepdims=True), share, 0.0)
    view = best[rows, share.argmax(axis=1)]
    for turn in range(_ROUNDS):
        around = np.where(neighbours >= 0, view[neighbours], -1)
        same = (best[:, :, None] == around[:, None, :]).sum(axis=2)
        chosen = best[rows, (share + _NEIGHBOUR_GAIN * same).argmax(axis=1)]
        view = np.where(rows % 2 == turn % 2, chosen, view)  # half at a time, or neighbours would swap
    return view


def _patches(view: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Return the patch of each triangle, int32 [M]: connected triangles of one view; -1 without a view."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(view)
    face, side = np.nonzero(neighbours >= 0)
    other = neighbours[face, side]
    joined = (view[face] == view[other]) & (view[face] >= 0)
    pairs = face[joined], other[joined]
    links = coo_array((np.ones(len(pairs[0]), bool), pairs), (count, count))
    _, piece = connected_components(links, directed=False)
    out = np.full(count, -1, np.int32)
    _, out[view >= 0] = np.unique(piece[view >= 0], return_inverse=True)
    return out
