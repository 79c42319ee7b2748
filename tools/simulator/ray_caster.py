"""Ray casting with Embree: first hits and occlusion, for batches of rays.

Embree computes in float32, so only the triangle index of its hits is used; `hit_distance` computes the
intersection with the plane of the triangle in float64.

Rays have origins [N, 3] in metres and directions [N, 3] of any length.
"""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from beamsplat.tools.simulator.mesh import SceneMesh


class RayCaster:
    """An immutable set of triangles that is tested for hits of rays."""

    def __init__(self, vertices_m: np.ndarray, triangles: np.ndarray) -> None:
        self._vertices = np.ascontiguousarray(vertices_m, dtype=np.float32)
        self._triangles = np.ascontiguousarray(triangles, dtype=np.int32)
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, self._vertices, self._triangles)
        v = self._vertices.astype(np.float64)[self._triangles]
        self._corner = v[:, 0]
        self._normal = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])

    @classmethod
    def of(cls, mesh: SceneMesh) -> RayCaster:
        """Return a ray caster of all triangles of a mesh."""
        return cls(mesh.vertices_m, mesh.triangles)

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return int32 [N]: the index of the first triangle that each ray hits; -1 = no hit."""
        return self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            query="INTERSECT",
        )

    def first_hit_from(self, origin_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return int32 [N]: as `first_hit`, for rays that all start at the point `origin_m` [3]."""
        return self.first_hit(np.broadcast_to(origin_m.astype(np.float32), directions.shape), directions)

    def occluded(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return bool [N]: whether each ray hits a triangle within `reach` [N].

        `reach` is a multiple of the length of the ray's direction.
        """
        hit = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            dists=np.ascontiguousarray(reach, dtype=np.float32),
            query="OCCLUDED",
        )
        return hit >= 0

    def hit_distance(self, origins: np.ndarray, directions: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """Return float64 [N]: the distance along each ray to the plane of `triangle` [N], +inf for -1.

        Distances are multiples of the length of the ray's direction.
        """
        n, corner = self._normal[triangle], self._corner[triangle]
        along = np.einsum("ij,ij->i", n, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.einsum("ij,ij->i", n, corner - origins) / along
        return np.where((triangle >= 0) & np.isfinite(t), t, np.inf)
