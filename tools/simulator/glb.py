"""Loads a scene from a glTF/GLB file, or from another 3D format that trimesh reads.

The file is y-up and in metres; the mesh is z-up, with triangles refined to edges of at most EDGE_M.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from beamsplat.tools.simulator.mesh import Material, SceneMesh, merge
from beamsplat.tools.simulator.palette import Textures

EDGE_M = 0.18  # longest edge after refinement: resolution of the baked light
MAX_TRIANGLES = 1_500_000  # baking more takes too long and too much memory
WHITE = np.ones((4, 4, 3), np.float32)


def load_glb(path: Path) -> tuple[SceneMesh, Textures]:
    """Return the refined mesh (z up, metres) and the textures by name of a scene file.

    Raises:
        ValueError: the file is unreadable, has no triangles, or is too large to bake.
    """
    try:
        scene = trimesh.load_scene(path)
    except Exception as error:  # the loaders of trimesh raise the errors of many libraries
        raise ValueError(f"{path} is not a 3D scene that can be read: {error}") from error
    to_z_up = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    textures: Textures = {"plain": (WHITE, (1.0, 1.0))}
    parts: list[SceneMesh] = []
    for name in scene.graph.nodes_geometry:
        transform, geometry_name = scene.graph[name]
        geometry = scene.geometry[geometry_name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        texture, tint = _material(geometry, f"file_{geometry_name}", textures)
        parts.append(_part(geometry, to_z_up @ transform, texture, tint, len(parts)))
    if not parts:
        raise ValueError(f"{path} has no triangles: export meshes, not points or curves")
    mesh = merge(parts)
    if len(mesh.triangles) > MAX_TRIANGLES:
        raise ValueError(
            f"{path} has {len(mesh.triangles)} triangles at {EDGE_M} m (limit {MAX_TRIANGLES}): "
            "is it in metres?"
        )
    return mesh, textures


def _part(
    geometry: trimesh.Trimesh,
    T_world_part: np.ndarray,
    texture: str,
    tint: tuple[float, float, float],
    number: int,
) -> SceneMesh:
    vertices = trimesh.transformations.transform_points(geometry.vertices, T_world_part)
    uv = getattr(geometry.visual, "uv", None)
    uv = np.zeros((len(vertices), 2)) if uv is None else np.asarray(uv, dtype=np.float64)
    joined = np.hstack([vertices, uv])
    faces = np.asarray(geometry.faces)
    extent = float(np.ptp(vertices, axis=0).max())
    if extent > EDGE_M:
        if len(faces) * (extent / EDGE_M) ** 2 > 50 * MAX_TRIANGLES:
            raise ValueError(
                f"a mesh of {extent:.0f} m is too large to refine to {EDGE_M} m: is the file in metres?"
            )
        joined, faces = _refine(joined, faces)
    corners = joined[:, :3][faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    faces, normal, area = faces[area > 1e-12], normal[area > 1e-12], area[area > 1e-12]
    # Flat shading needs one normal per face, so every face gets its own vertices.
    flat = faces.ravel()
    normals = np.repeat(normal / area[:, None], 3, axis=0)
    centre = np.repeat(joined[:, :3][faces].mean(axis=1), 3, axis=0)
    points = joined[flat, :3]
    count = len(faces)
    return SceneMesh(
        points.astype(np.float32),
        normals.astype(np.float32),
        (points + 0.03 * (centre - points) + 0.004 * normals).astype(np.float32),
        joined[flat, 3:].astype(np.float32),
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        np.zeros(count, np.int32),
        np.full(count, 0, np.int32),
        (Material(texture, tint=tint),),
    )


def _refine(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bisect triangles at their longest edge until no edge is longer than EDGE_M.

    `vertices` is [V, 3 + K]: position in metres and K more values, which are interpolated at new vertices.

    Returns:
        Vertices and faces int [F, 3]; no vertex is shared by two faces.
    """
    done_v, done_f, offset = [], [], 0
    for _ in range(14):
        corners = vertices[faces]
        edge = np.linalg.norm((corners - np.roll(corners, 1, axis=1))[..., :3], axis=2)
        long = edge.max(axis=1) > EDGE_M
        short = corners[~long]
        done_v.append(short.reshape(-1, vertices.shape[1]))
        done_f.append(np.arange(3 * len(short)).reshape(-1, 3) + offset)
        offset += 3 * len(short)
        if not long.any():
            break
        corners, edge = corners[long], edge[long]
        # Edge k of `edge` joins corners k - 1 and k: rotate the corners so that the longest edge is 0 - 1.
        turn = (np.argmax(edge, axis=1) - 1) % 3
        pick = (turn[:, None] + np.arange(3)) % 3
        corners = np.take_along_axis(corners, pick[..., None], axis=1)
        middle = 0.5 * (corners[:, 0] + corners[:, 1])
        halves = np.concatenate(
            [
                np.stack([corners[:, 0], middle, corners[:, 2]], 1),
                np.stack([middle, corners[:, 1], corners[:, 2]], 1),
            ]
        )
        vertices, faces = halves.reshape(-1, vertices.shape[1]), np.arange(3 * len(halves)).reshape(-1, 3)
    return np.concatenate(done_v), np.concatenate(done_f)


def _material(
    geometry: trimesh.Trimesh, name: str, textures: Textures
) -> tuple[str, tuple[float, float, float]]:
    """Return the texture name and the linear RGB tint of a geometry; add its image, if any, to `textures`."""
    material = getattr(geometry.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        factor = getattr(geometry.visual, "main_color", None) if image is None else None
    tint = (1.0, 1.0, 1.0)
    if factor is not None:
        values = np.asarray(factor, dtype=np.float64)[:3]
        values = values / 255.0 if values.max() > 1.0 or np.asarray(factor).dtype == np.uint8 else values
        tint = (float(values[0]), float(values[1]), float(values[2]))
    if image is None:
        return "plain", tint
    texels = np.asarray(image.convert("RGB"), dtype=np.float32) / 255.0
    if texels.size == 0:
        return "plain", tint
    textures[name] = (np.clip(texels, 0.0, 1.0), (1.0, 1.0))
    return name, tint
