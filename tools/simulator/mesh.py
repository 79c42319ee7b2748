"""Triangle meshes with materials, and the builder into which all furniture is drawn.

Surfaces are finely tessellated because light is computed per vertex: the builder's `edge_m`, the longest edge
of a triangle, is the resolution of shadows.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

BAKE_OFFSET_M = 0.004  # irradiance is computed this far in front of the surface
BAKE_INSET_M = 0.012  # and this far inside the rim of a flat piece, because its rim may be inside a neighbour


@dataclass(frozen=True)
class Material:
    """Appearance of a triangle: the texture called `texture`, multiplied by a linear RGB tint."""

    texture: str = "plain"
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    emission: float = 0.0  # radiance = emission * albedo, besides reflected light
    glass: bool = False  # lidar beams may pass; the camera sees the texture of the pane


@dataclass(frozen=True)
class SceneMesh:
    """Geometry in metres; V vertices, F triangles; front faces are counter-clockwise."""

    vertices_m: np.ndarray  # float32 [V, 3]
    normals: np.ndarray  # float32 [V, 3]
    bake_points_m: np.ndarray  # float32 [V, 3], where the irradiance of each vertex is computed
    uvs: np.ndarray  # float32 [V, 2], in texture repeats, v up
    triangles: np.ndarray  # int32 [F, 3]
    material: np.ndarray  # int32 [F], index into `materials`
    surface: np.ndarray  # int32 [F], triangles of one smooth surface have the same number
    materials: tuple[Material, ...]

    def posed(self, vertices_m: np.ndarray, normals: np.ndarray) -> SceneMesh:
        """Return a copy of the mesh with these vertices and normals [V, 3]; the triangles are the same."""
        return replace(
            self,
            vertices_m=vertices_m.astype(np.float32),
            normals=normals.astype(np.float32),
            bake_points_m=vertices_m.astype(np.float32),
        )


def merge(meshes: Iterable[SceneMesh]) -> SceneMesh:
    """Return one mesh of all meshes; materials and surfaces get new numbers, so that they stay distinct."""
    parts = list(meshes)
    vertices = np.cumsum([0, *(len(p.vertices_m) for p in parts)])
    materials = np.cumsum([0, *(len(p.materials) for p in parts)])
    surfaces = np.cumsum([0, *(int(p.surface.max(initial=-1)) + 1 for p in parts)])
    return SceneMesh(
        vertices_m=np.concatenate([p.vertices_m for p in parts]),
        normals=np.concatenate([p.normals for p in parts]),
        bake_points_m=np.concatenate([p.bake_points_m for p in parts]),
        uvs=np.concatenate([p.uvs for p in parts]),
        triangles=np.concatenate([p.triangles + np.int32(o) for p, o in zip(parts, vertices)]),
        material=np.concatenate([p.material + np.int32(o) for p, o in zip(parts, materials)]),
        surface=np.concatenate([p.surface + np.int32(o) for p, o in zip(parts, surfaces)]),
        materials=tuple(m for p in parts for m in p.materials),
    )


@dataclass(frozen=True)
class Light:
    """An area light: a parallelogram (a window), or a sphere if `right_m` and `up_m` are zero."""

    centre_m: tuple[float, float, float]
    right_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # from the centre to the middle of the right side
    up_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # from the centre to the middle of the upper side
    radius_m: float = 0.0
    intensity: tuple[float, float, float] = (1.0, 1.0, 1.0)  # irradiance at 1 m, facing the light


@dataclass
class _MeshBuffers:
    """Surfaces and lights of one mesh, shared by all builders that `placed` and `tilted` derive."""

    lights: list[Light | None] = field(default_factory=list)  # None = removed
    # Vertices, normals, bake points, uvs, triangles, material of each triangle; None = removed.
    pieces: list[tuple[np.ndarray, ...] | None] = field(default_factory=list)
    materials: dict[Material, int] = field(default_factory=dict)


@dataclass(frozen=True)
class MeshPart:
    """Surfaces and lights of a mesh builder, drawn one after the other: a piece of furniture, for example."""

    surfaces: range
    lights: range


class MeshBuilder:
    """Collects the surfaces and lights of a mesh; coordinates are in the builder's local frame, in metres.

    The local frame is x right, y away from the viewer, z up. `placed` and `tilted` return a builder with
    another local frame that adds to the same mesh.
    """

    def __init__(self, texture_size_m: dict[str, tuple[float, float]], edge_m: float = 0.11) -> None:
        self.texture_size_m = texture_size_m
        self.edge_m = edge_m
        self._buffers = _MeshBuffers()
        self._R = np.eye(3)
        self._t = np.zeros(3)

    def placed(
        self, x_m: float, y_m: float, z_m: float = 0.0, yaw_rad: float = 0.0, edge_m: float | None = None
    ) -> MeshBuilder:
        """Return a builder of the same mesh with the frame moved to (x, y, z), then rotated by yaw about z.

        Position and yaw are in the frame of this builder. `edge_m` None = the same as of this builder.
        """
        child = MeshBuilder.__new__(MeshBuilder)
        child.texture_size_m, child._buffers = self.texture_size_m, self._buffers
        child.edge_m = self.edge_m if edge_m is None else edge_m
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        child._R = self._R @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        child._t = self._t + self._R @ np.array([x_m, y_m, z_m])
        return child

    def tilted(self, axis: str, angle_rad: float) -> MeshBuilder:
        """Return a builder of the same mesh with the frame rotated about its x, y or z axis."""
        child = self.placed(0.0, 0.0)
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        R = np.eye(3)
        R[i, i] = R[j, j] = cos
        R[i, j], R[j, i] = -sin, sin
        child._R = self._R @ R
        return child

    def add(
        self,
        vertices: np.ndarray,  # [V, 3] local metres
        normals: np.ndarray,  # [V, 3] local, unit
        uvs: np.ndarray,  # [V, 2] texture repeats
        triangles: np.ndarray,  # [F, 3]
        material: Material,
        bake_points: np.ndarray | None = None,
    ) -> None:
        """Add one smooth surface.

        `bake_points` [V, 3] are the points at which the light of each vertex is computed; None = the
        vertices.
        """
        store = self._buffers
        number = store.materials.setdefault(material, len(store.materials))
        bake = vertices if bake_points is None else bake_points
        bake = bake + BAKE_OFFSET_M * normals
        store.pieces.append(
            (
                vertices @ self._R.T + self._t,
                normals @ self._R.T,
                bake @ self._R.T + self._t,
                uvs,
                triangles,
                np.full(len(triangles), number),
            )
        )

    def quad(
        self,
        origin: npt.ArrayLike,
        right: npt.ArrayLike,
        up: npt.ArrayLike,
        material: Material,
        *,
        fit: bool = False,
        offset: tuple[float, float] | None = None,
        turn: bool = False,
        edge_m: float | None = None,
    ) -> None:
        """Add a parallelogram; `origin` is its lower left corner, seen from its front.

        Args:
            origin, right, up: float [3], the corner and the two edges from this corner, in local metres.
            fit: stretch one repeat of the texture over the parallelogram, instead of its real size.
            offset: start of the repeated texture, in repeats; None = a different start for each surface.
            turn: map the u axis of the texture to `up`.
            edge_m: longest edge of the tessellation; None = `edge_m` of the builder.
        """
        origin, right, up = (np.asarray(v, dtype=np.float64) for v in (origin, right, up))
        width, height = float(np.linalg.norm(right)), float(np.linalg.norm(up))
        if width < 1e-6 or height < 1e-6:
            return
        edge = edge_m or self.edge_m
        columns, rows = int(np.ceil(width / edge)) + 1, int(np.ceil(height / edge)) + 1
        s, t = np.meshgrid(np.linspace(0.0, 1.0, columns), np.linspace(0.0, 1.0, rows))
        s, t = s.ravel()[:, None], t.ravel()[:, None]
        inset_s, inset_t = min(BAKE_INSET_M / width, 0.3), min(BAKE_INSET_M / height, 0.3)
        bake = origin + np.clip(s, inset_s, 1 - inset_s) * right + np.clip(t, inset_t, 1 - inset_t) * up
        normal = np.cross(right, up)
        normal /= np.linalg.norm(normal)
        uv = np.hstack([s, t])
        if not fit:
            size = self.texture_size_m[material.texture]
            metres = np.hstack([t * height, s * width]) if turn else np.hstack([s * width, t * height])
            k = len(self._buffers.pieces)
            shift = (k * 0.6180339 % 1.0, k * 0.7548776 % 1.0) if offset is None else offset
            uv = metres / np.array(size) + np.array(shift)
        self.add(
            origin + s * right + t * up,
            np.broadcast_to(normal, (len(s), 3)),
            uv,
            grid_triangles(rows, columns),
            material,
            bake,
        )

    def lamp(self, at: tuple[float, float, float], radius_m: float, power: float, tint: np.ndarray) -> None:
        """Add a spherical light at `at` (local metres) with intensity `power` * `tint` (linear RGB [3]).

        The geometry of the lamp must be inside the sphere, because surfaces inside it do not block the light.
        """
        centre = tuple((self._R @ np.asarray(at, dtype=np.float64) + self._t).tolist())
        intensity = tuple((power * np.asarray(tint, dtype=np.float64)).tolist())
        self._buffers.lights.append(Light(centre, radius_m=radius_m, intensity=intensity))

    def window(self, origin: np.ndarray, right: np.ndarray, up: np.ndarray, radiance: np.ndarray) -> None:
        """Add an area light of RGB `radiance` [3] for a window pane; origin, right and up as for `quad`."""
        origin, right, up = (np.asarray(v, dtype=np.float64) for v in (origin, right, up))
        centre = self._R @ (origin + right / 2 + up / 2) + self._t
        area = float(np.linalg.norm(np.cross(right, up)))
        self._buffers.lights.append(
            Light(
                tuple(centre.tolist()),
                tuple((self._R @ right / 2).tolist()),
                tuple((self._R @ up / 2).tolist()),
                intensity=tuple((area * np.asarray(radiance)).tolist()),
            )
        )

    @property
    def lights(self) -> tuple[Light, ...]:
        """All lights added until now and not removed, in the frame of the mesh."""
        return tuple(light for light in self._buffers.lights if light is not None)

    def part_from(self, before: MeshPart | None = None) -> MeshPart:
        """Return the part that was added since `before` was returned; None = since the start."""
        first = (0, 0) if before is None else (before.surfaces.stop, before.lights.stop)
        store = self._buffers
        return MeshPart(range(first[0], len(store.pieces)), range(first[1], len(store.lights)))

    def vertices_of(self, part: MeshPart) -> np.ndarray:
        """Return the vertices of a part that was not removed, float64 [V, 3] in metres in the mesh frame."""
        pieces = (self._buffers.pieces[k] for k in part.surfaces)
        return np.concatenate([piece[0] for piece in pieces if piece is not None])

    def move(self, part: MeshPart, T_new_old: np.ndarray) -> None:
        """Apply a rigid transform [4, 4] in the mesh frame to a part; its look stays the same."""
        R, t, store = T_new_old[:3, :3], T_new_old[:3, 3], self._buffers
        for k in part.surfaces:
            piece = store.pieces[k]
            if piece is not None:
                vertices, normals, bake, *rest = piece
                store.pieces[k] = (vertices @ R.T + t, normals @ R.T, bake @ R.T + t, *rest)
        for k in part.lights:
            light = store.lights[k]
            if light is not None:
                centre, right, up = (R @ np.array(v) for v in (light.centre_m, light.right_m, light.up_m))
                at = [tuple(v.tolist()) for v in (centre + t, right, up)]
                store.lights[k] = replace(light, centre_m=at[0], right_m=at[1], up_m=at[2])

    def remove(self, part: MeshPart) -> None:
        """Remove the surfaces and lights of a part."""
        for k in part.surfaces:
            self._buffers.pieces[k] = None
        for k in part.lights:
            self._buffers.lights[k] = None

    def build(self) -> SceneMesh:
        """Return the mesh of all surfaces added until now and not removed."""
        pieces = [piece for piece in self._buffers.pieces if piece is not None]
        vertices, normals, bake, uvs, _, material = (np.concatenate(column) for column in zip(*pieces))
        first = np.cumsum([0, *(len(piece[0]) for piece in pieces)])
        triangles = np.concatenate([piece[4] + offset for piece, offset in zip(pieces, first)])
        surface = np.repeat(np.arange(len(pieces)), [len(piece[4]) for piece in pieces])
        return SceneMesh(
            vertices.astype(np.float32),
            normals.astype(np.float32),
            bake.astype(np.float32),
            uvs.astype(np.float32),
            triangles.astype(np.int32),
            material.astype(np.int32),
            surface.astype(np.int32),
            tuple(self._buffers.materials),
        )


def grid_triangles(rows: int, columns: int) -> np.ndarray:
    """Return the triangles, int [2 (rows-1) (columns-1), 3], of a row-major grid of vertices.

    Row 0 is at the bottom, column 0 on the left.
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
