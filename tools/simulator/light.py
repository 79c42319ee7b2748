"""Light baking: direct light of windows and lamps with soft shadows, and indirect light between surfaces.

Light is computed per vertex; all surfaces are Lambertian. Direct light is computed from several sample points
on each area light. Indirect light is radiosity by gathering: the irradiance E = E_direct + mean of albedo * E
at the hits of cosine-weighted rays. Each bounce is one iteration over the same hits, so that no further rays
are cast.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from beamsplat.tools.simulator.atlas import Atlas
from beamsplat.tools.simulator.mesh import Light, SceneMesh
from beamsplat.tools.simulator.ray_caster import RayCaster

LIGHT_SAMPLES = 8  # points on each area light
GATHER_RAYS = 48  # rays per vertex for indirect light
BOUNCES = 5
AMBIENT = 0.03  # constant irradiance / pi where gather rays leave the scene; 15 % of it everywhere
BLOCK = 1 << 16  # vertices processed at once, bounds memory


def bake(
    mesh: SceneMesh, atlas: Atlas, lights: tuple[Light, ...], caster: RayCaster, *, rays: int = GATHER_RAYS
) -> np.ndarray:
    """Return irradiance / pi at every vertex, linear RGB float32 [V, 3].

    This is the radiance of a white surface at the vertex. `rays` is the number of rays per vertex for
    indirect light.
    """
    direct = np.zeros((len(mesh.vertices_m), 3), np.float32)
    for number, light in enumerate(lights):
        direct += _direct(mesh, light, caster, number)
    hits = _gather(mesh, caster, rays)
    return _bounce(mesh, atlas, direct, hits)


def _direct(mesh: SceneMesh, light: Light, caster: RayCaster, number: int) -> np.ndarray:
    out = np.zeros((len(mesh.vertices_m), 3), np.float32)
    points, normals = mesh.bake_points_m, mesh.normals
    centre = np.array(light.centre_m, np.float32)
    to = centre - points
    reach = np.linalg.norm(np.abs(light.right_m) + np.abs(light.up_m)) + light.radius_m
    facing = np.einsum("ij,ij->i", to, normals) > -reach
    strength = max(light.intensity) / np.maximum(np.einsum("ij,ij->i", to, to), 0.05)
    chosen = np.flatnonzero(facing & (strength > 0.012))
    if len(chosen) == 0:
        return out
    rng = np.random.default_rng([number, 0x4C])
    samples, sample_normals = _light_points(light, rng, points[chosen])
    total = np.zeros(len(chosen), np.float32)
    # Most lights are hidden from most vertices: all samples are computed only where one of three arrives.
    probes = (0, 3, 6)
    everyone = np.arange(len(chosen))
    for k in probes:
        total += _arriving(
            points[chosen], normals[chosen], light, samples[:, k], sample_normals[:, k], caster
        )
    some = everyone[total > 0]
    at = chosen[some]
    for k in set(range(LIGHT_SAMPLES)) - set(probes):
        total[some] += _arriving(
            points[at], normals[at], light, samples[some, k], sample_normals[some, k], caster
        )
    out[chosen] = (total / LIGHT_SAMPLES / np.pi)[:, None] * np.array(light.intensity, np.float32)
    return out


def _arriving(
    points: np.ndarray,
    normals: np.ndarray,
    light: Light,
    samples: np.ndarray,
    sample_normals: np.ndarray,
    caster: RayCaster,
) -> np.ndarray:
    """Return the irradiance float32 [N] at points [N, 3], for a light of intensity 1; 0 in shadow.

    Point i receives light only from sample i of the area light.
    """
    to = samples - points
    squared = np.maximum(np.einsum("ij,ij->i", to, to), 1e-3)
    cos_here = np.einsum("ij,ij->i", to, normals)
    cos_there = -np.einsum("ij,ij->i", to, sample_normals)
    part = np.maximum(cos_here, 0) * np.maximum(cos_there, 0) / squared**2
    lit = np.flatnonzero(part > 1e-5)
    blocked = caster.occluded(points[lit], to[lit], np.full(len(lit), 0.995))
    part[lit[blocked]] = 0.0
    part[part <= 1e-5] = 0.0
    return part


def _light_points(
    light: Light, rng: np.random.Generator, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return stratified sample points on the light for each receiver in `points` [N, 3], and their normals.

    Both arrays are float32 [N, LIGHT_SAMPLES, 3].
    """
    count = len(points)
    centre = np.array(light.centre_m, np.float32)
    if light.radius_m > 0:
        # Uniform over the disc that the receiver sees, projected onto the sphere: equal weights.
        toward = points - centre
        toward /= np.linalg.norm(toward, axis=1, keepdims=True) + np.float32(1e-9)
        helper = np.where(np.abs(toward[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]).astype(
            np.float32
        )
        side = np.cross(toward, helper)
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        other = np.cross(toward, side)
        ring = np.array([0, 4, 2, 6, 1, 5, 3, 7])  # few samples already cover the disc
        squared = (ring + rng.random((count, LIGHT_SAMPLES), dtype=np.float32)) / LIGHT_SAMPLES
        angle = 2.39996 * np.arange(LIGHT_SAMPLES) + 2 * np.pi * rng.random((count, 1), dtype=np.float32)
        r = np.sqrt(squared)
        unit = (
            (r * np.cos(angle))[..., None] * side[:, None]
            + (r * np.sin(angle))[..., None] * other[:, None]
            + np.sqrt(1 - squared)[..., None] * toward[:, None]
        )
        normals = np.broadcast_to(toward[:, None], unit.shape)
        return (centre + light.radius_m * unit).astype(np.float32), normals.astype(np.float32)
    columns = LIGHT_SAMPLES // 2
    i, j = np.divmod(np.arange(LIGHT_SAMPLES), columns)
    s = 2 * (j + rng.random((count, LIGHT_SAMPLES), dtype=np.float32)) / columns - 1
    t = 2 * (i + rng.random((count, LIGHT_SAMPLES), dtype=np.float32)) / 2 - 1
    right, up = np.array(light.right_m, np.float32), np.array(light.up_m, np.float32)
    spots = centre + s[..., None] * right + t[..., None] * up
    normal = np.cross(right, up)
    normal /= np.linalg.norm(normal)
    return spots.astype(np.float32), np.broadcast_to(normal, spots.shape).astype(np.float32)


def _gather(mesh: SceneMesh, caster: RayCaster, rays: int) -> np.ndarray:
    """Return int32 [V, rays]: the index of the triangle that each cosine-weighted ray from a vertex hits.

    -1 = no hit, -2 = a hit on a back face.
    """
    count = len(mesh.vertices_m)
    hits = np.empty((count, rays), np.int32)
    k = np.arange(rays, dtype=np.float32)
    rng = np.random.default_rng(0x47)
    v = mesh.vertices_m[mesh.triangles]
    face = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    block = max(1, BLOCK // rays * 8)
    for start in range(0, count, block):
        stop = min(start + block, count)
        n = mesh.normals[start:stop].astype(np.float32)
        helper = np.where(np.abs(n[:, 2:3]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]).astype(np.float32)
        side = np.cross(n, helper)
        side /= np.linalg.norm(side, axis=1, keepdims=True) + 1e-12
        other = np.cross(n, side)
        turn = rng.random((len(n), 2), dtype=np.float32)
        u = (k / rays + turn[:, :1]) % 1.0
        angle = np.float32(2 * np.pi) * ((np.float32(0.618034) * k + turn[:, 1:]) % 1.0)
        r, height = np.sqrt(u), np.sqrt(1 - u)
        d = (
            (r * np.cos(angle))[..., None] * side[:, None]
            + (r * np.sin(angle))[..., None] * other[:, None]
            + height[..., None] * n[:, None]
        ).astype(np.float32)
        origins = np.repeat(mesh.bake_points_m[start:stop], rays, axis=0)
        flat = d.reshape(-1, 3)
        hit = caster.first_hit(origins, flat)
        back = np.einsum("ij,ij->i", face[hit], flat) > 0
        hits[start:stop] = np.where((hit >= 0) & back, -2, hit).reshape(-1, rays)
    return hits


def _bounce(mesh: SceneMesh, atlas: Atlas, direct: np.ndarray, hits: np.ndarray) -> np.ndarray:
    names = [atlas.index(m.texture) for m in mesh.materials]
    tints = np.array([m.tint for m in mesh.materials], np.float32)
    glowing = np.array([m.emission > 0 for m in mesh.materials])
    albedo = (atlas.mean[names] * tints)[mesh.material]
    # Emissive surfaces already light the room as sampled lights: their texture reflects little.
    albedo[glowing[mesh.material]] *= 0.3
    smooth = _smoothing_matrix(mesh)
    rays = hits.shape[1]
    missed = (hits == -1).sum(axis=1, keepdims=True) / rays
    kept = np.where(hits >= 0, hits, len(albedo))
    indirect = np.zeros_like(direct)
    for _ in range(BOUNCES):
        total = direct + indirect
        leaving = albedo * total[mesh.triangles].mean(axis=1)
        leaving = np.vstack([leaving, np.zeros((1, 3), np.float32)])
        gathered = np.empty_like(direct)
        for start in range(0, len(kept), BLOCK):
            gathered[start : start + BLOCK] = leaving[kept[start : start + BLOCK]].sum(axis=1)
        indirect = smooth @ (smooth @ (gathered / rays + AMBIENT * (0.15 + missed)))
    return (smooth @ direct + indirect).astype(np.float32)


def _smoothing_matrix(mesh: SceneMesh) -> sparse.csr_matrix:
    """Return a row-stochastic matrix [V, V] that averages each vertex with its neighbours.

    Multiplication by this matrix removes sampling noise.
    """
    i = mesh.triangles[:, [0, 1, 2, 1, 2, 0]].ravel()
    j = mesh.triangles[:, [1, 2, 0, 0, 1, 2]].ravel()
    n = len(mesh.vertices_m)
    graph = sparse.coo_matrix((np.ones(len(i), np.float32), (i, j)), shape=(n, n)).tocsr()
    graph.data[:] = 1.0
    graph = graph + 2.0 * sparse.identity(n, dtype=np.float32, format="csr")
    scale = sparse.diags(1.0 / np.asarray(graph.sum(axis=1)).ravel()).astype(np.float32)
    return sparse.csr_matrix(scale @ graph)
