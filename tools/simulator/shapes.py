"""Solid shapes for furniture, drawn in the local frame of the `MeshBuilder` `b`; lengths are metres."""

from __future__ import annotations

import numpy as np

from beamsplat.tools.simulator.mesh import Material, MeshBuilder, grid_triangles

FACES = ("front", "back", "left", "right", "top", "bottom")


def box(
    b: MeshBuilder,
    centre: tuple[float, float, float],
    size: tuple[float, float, float],
    material: Material,
    *,
    faces: dict[str, Material] | None = None,
    fit: tuple[str, ...] = (),
    skip: tuple[str, ...] = (),
    turn: bool = False,
) -> None:
    """Draw a box of `size` (x, y, z) whose base has its centre at `centre` and whose front faces -y.

    Args:
        faces: materials of single faces by the names in FACES, instead of `material`.
        fit: faces over which one repeat of the texture is stretched.
        skip: faces that are not drawn.
        turn: whether the u axis (grain) of the texture is vertical on the four vertical faces.
    """
    x, y, z = centre
    w, d, h = (max(v, 1e-4) for v in size)
    x0, x1, y0, y1, z0, z1 = x - w / 2, x + w / 2, y - d / 2, y + d / 2, z, z + h
    corners = {
        "front": ((x0, y0, z0), (w, 0, 0), (0, 0, h)),
        "back": ((x1, y1, z0), (-w, 0, 0), (0, 0, h)),
        "left": ((x0, y1, z0), (0, -d, 0), (0, 0, h)),
        "right": ((x1, y0, z0), (0, d, 0), (0, 0, h)),
        "top": ((x0, y0, z1), (w, 0, 0), (0, d, 0)),
        "bottom": ((x0, y1, z0), (w, 0, 0), (0, -d, 0)),
    }
    for face in FACES:
        if face in skip:
            continue
        origin, right, up = corners[face]
        upright = turn and face not in ("top", "bottom")
        b.quad(origin, right, up, (faces or {}).get(face, material), fit=face in fit, turn=upright)


def lathe(
    b: MeshBuilder,
    centre: tuple[float, float, float],
    profile: list[tuple[float, float]],  # (radius, height), from the bottom up
    material: Material,
    *,
    sides: int = 20,
    smooth: bool = True,
    fit: bool = False,
) -> None:
    """Draw a surface of revolution about the vertical axis through `centre`, where the profile has height 0.

    If `smooth`, the bands between profile points have common normals, so that edges between them are
    invisible.
    """
    points = np.array(profile, dtype=np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    bands = [points] if smooth else [points[i : i + 2] for i in range(len(points) - 1)]
    size = b.texture_size_m[material.texture]
    for band in bands:
        tangent = np.gradient(band, axis=0)
        outward = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
        outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-12
        radius, height = band[:, 0][:, None], band[:, 1][:, None]
        vertices = np.stack(
            [radius * ring[:, 0], radius * ring[:, 1], np.broadcast_to(height, (len(band), sides + 1))],
            axis=-1,
        )
        normals = np.stack(
            [
                outward[:, :1] * ring[:, 0],
                outward[:, :1] * ring[:, 1],
                np.broadcast_to(outward[:, 1:], (len(band), sides + 1)),
            ],
            axis=-1,
        )
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(band, axis=0), axis=1))])
        if fit:
            u, v = angle / (2 * np.pi), along / max(along[-1], 1e-9)
        else:
            u = np.maximum(1.0, np.round(2 * np.pi * points[:, 0].max() / size[0])) * angle / (2 * np.pi)
            v = along / size[1]
        uvs = np.stack(np.meshgrid(u, v), axis=-1)
        b.add(
            vertices.reshape(-1, 3) + np.array(centre),
            normals.reshape(-1, 3),
            uvs.reshape(-1, 2),
            grid_triangles(len(band), sides + 1),
            material,
        )


def cylinder(
    b: MeshBuilder,
    centre: tuple[float, float, float],
    radius_m: float,
    height_m: float,
    material: Material,
    *,
    top_radius_m: float | None = None,
    sides: int = 16,
    caps: bool = True,
) -> None:
    """Draw an upright cylinder, or a frustum of a cone, whose base has its centre at `centre`."""
    top = radius_m if top_radius_m is None else top_radius_m
    rings = max(2, int(np.ceil(height_m / b.edge_m)) + 1)
    side = list(zip(np.linspace(radius_m, top, rings), np.linspace(0.0, height_m, rings)))
    lathe(b, centre, side, material, sides=sides)
    if caps:
        lathe(b, centre, [(0.0, 0.0), (radius_m, 0.0)], material, sides=sides)
        b_top = (centre[0], centre[1], centre[2])
        lathe(b, b_top, [(top, height_m), (0.0, height_m)], material, sides=sides)


def rod(
    b: MeshBuilder,
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    radius_m: float,
    material: Material,
    *,
    sides: int = 8,
) -> None:
    """Draw a round bar between two points."""
    p, q = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
    axis = q - p
    length = float(np.linalg.norm(axis))
    axis /= length
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    rings = max(2, int(np.ceil(length / b.edge_m)) + 1)
    s = np.linspace(0.0, 1.0, rings)
    vertices = p + s[:, None, None] * (q - p) + radius_m * ring
    size = b.texture_size_m[material.texture]
    u, v = np.meshgrid(angle / (2 * np.pi), s * length / size[1])
    normals = np.broadcast_to(ring, vertices.shape)
    b.add(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.stack([u, v], axis=-1).reshape(-1, 2),
        grid_triangles(rings, sides + 1),
        material,
    )


def cushion(
    b: MeshBuilder,
    centre: tuple[float, float, float],
    size: tuple[float, float, float],
    material: Material,
    *,
    power: float = 0.35,
    detail: int = 18,
    squash: float = 0.55,
) -> None:
    """Draw a superellipsoid with its base at `centre`: a pillow (`power` 0.5) or a padded block (0.2).

    `power` and `squash` are the exponents of the horizontal and the vertical outline; small = like a box.
    """
    rows = max(7, detail // 2 + 1)
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rows)
    longitude = np.linspace(-np.pi, np.pi, detail * 2 + 1)
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")

    def signed(value: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(value) * np.abs(value) ** exponent

    unit = np.stack(
        [
            signed(np.cos(lat), squash) * signed(np.cos(lon), power),
            signed(np.cos(lat), squash) * signed(np.sin(lon), power),
            signed(np.sin(lat), squash),
        ],
        axis=-1,
    )
    half = np.array(size) / 2.0
    vertices = unit * half + np.array(centre) + np.array([0.0, 0.0, half[2]])
    normals = np.stack(
        [
            signed(np.cos(lat), 2 - squash) * signed(np.cos(lon), 2 - power) / half[0],
            signed(np.cos(lat), 2 - squash) * signed(np.sin(lon), 2 - power) / half[1],
            signed(np.sin(lat), 2 - squash) / half[2],
        ],
        axis=-1,
    )
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    texture = np.array(b.texture_size_m[material.texture])
    # A triplanar mapping would need three surfaces; projecting x + y and z hides the stretch on cloth.
    flat = np.abs(normals[..., 2]) > 0.7
    u = np.where(flat, vertices[..., 0], vertices[..., 0] + vertices[..., 1])
    v = np.where(flat, vertices[..., 1], vertices[..., 2])
    uvs = np.stack([u / texture[0], v / texture[1]], axis=-1)
    b.add(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        uvs.reshape(-1, 2),
        grid_triangles(rows, detail * 2 + 1),
        material,
    )


def curtain(
    b: MeshBuilder,
    left: tuple[float, float, float],
    width_m: float,
    height_m: float,
    material: Material,
    *,
    wave_m: float = 0.03,
    folds: float = 7.0,
) -> None:
    """Draw hanging cloth in the local xz plane, facing -y, with folds in y.

    `left` is the lower left corner of the cloth; the folds have the amplitude `wave_m`.
    """
    columns, rows = int(folds * 8) + 1, max(2, int(height_m / 0.15))
    s, t = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
    phase = 2 * np.pi * folds * s + 0.8 * np.sin(3.0 * s + 2.0 * t)
    depth = wave_m * np.sin(phase) * (1.0 - 0.3 * t)
    slope = wave_m * np.cos(phase) * 2 * np.pi * folds / width_m
    vertices = np.stack([left[0] + s * width_m, left[1] + depth, left[2] + t * height_m], axis=-1)
    normals = np.stack([slope, -np.ones_like(slope), np.zeros_like(slope)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    size = b.texture_size_m[material.texture]
    uvs = np.stack([s * width_m * 1.5 / size[0], t * height_m / size[1]], axis=-1)
    b.add(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        uvs.reshape(-1, 2),
        grid_triangles(rows, columns),
        material,
    )
