"""Ray casting by Embree: first hits and occlusion, for batches of rays.

Embree works in float32 and tells us the triangle; where exactly the ray meets its plane is computed
again by whoever needs it precisely.
"""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from beamsplat.tools.simulator.mesh import Mesh


class Caster:
    """An immutable triangle soup that rays can be shot at."""

    def __init__(self, vertices_m: np.ndarray, triangles: np.ndarray) -> None:
        self._vertices = np.ascontiguousarray(vertices_m, dtype=np.float32)
        self._triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, self._vertices, self._triangles)
        v = self._vertices.astype(np.float64)[self._triangles]
        self._corner = v[:, 0]
        self._normal = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])

    @classmethod
    def of(cls, mesh: Mesh) -> Caster:
        return cls(mesh.vertices_m, mesh.triangles)

    def first(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """int32 [N]: the triangle each ray [N, 3] meets first, or -1."""
        return self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="INTERSECT",
        )

    def first_from(self, origin_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """int32 [N]: as `first`, all rays from one point [3]."""
        return self.first(np.broadcast_to(origin_m.astype(np.float32), directions.shape), directions)

    def occluded(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """bool [N]: something lies on the ray nearer than reach [N] (in lengths of its direction)."""
        hit = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            dists=np.ascontiguousarray(reach, dtype=np.float32),
            query="OCCLUDED",
        )
        return hit >= 0

    def distance(self, origins: np.ndarray, directions: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """float64 [N]: where the rays meet the planes of their triangles, +inf for triangle -1."""
        n, corner = self._normal[triangle], self._corner[triangle]
        along = np.einsum("ij,ij->i", n, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.einsum("ij,ij->i", n, corner - origins) / along
        return np.where((triangle >= 0) & np.isfinite(t), t, np.inf)
