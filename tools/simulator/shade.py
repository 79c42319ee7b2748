"""Compiled shading: plane intersection, barycentric light, anisotropic trilinear texture lookup."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamsplat.common.compiled import kernel
from beamsplat.tools.simulator.atlas import Atlas
from beamsplat.tools.simulator.mesh import SceneMesh

MAX_ANISOTROPY = 6


class ShadingTables(NamedTuple):
    """Data of F triangles and all textures, laid out for the compiled shading kernels."""

    corner: np.ndarray  # float64 [F, 3], position of corner 0 in metres
    normal: np.ndarray  # float64 [F, 3], not normalised
    dual: np.ndarray  # float32 [F, 2, 3]: barycentric coordinates 1 and 2 of point P = dual @ (P - corner)
    uv: np.ndarray  # float32 [F, 3, 2]: (u, v) at corner 0, and the differences to corners 1 and 2
    light: np.ndarray  # float32 [F, 3, 3]: irradiance / pi at the three corners, linear RGB
    tint: np.ndarray  # float32 [F, 3], linear RGB
    emission: np.ndarray  # float32 [F]
    texture: np.ndarray  # int32 [F], index in the atlas
    surface: np.ndarray  # int32 [F], as in `SceneMesh`
    texels: np.ndarray  # this field and all below are as in `Atlas`
    offset: np.ndarray
    width_px: np.ndarray
    height_px: np.ndarray
    levels: np.ndarray


def shading_tables(mesh: SceneMesh, atlas: Atlas, light: np.ndarray) -> ShadingTables:
    """Return the shading tables of a mesh; `light` is irradiance / pi [V, 3], as `light.bake` returns."""
    v = mesh.vertices_m.astype(np.float64)[mesh.triangles]
    e1, e2 = v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]
    normal = np.cross(e1, e2)
    squared = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-30)[:, None]
    dual = np.stack([np.cross(e2, normal) / squared, np.cross(normal, e1) / squared], axis=1)
    uv = mesh.uvs[mesh.triangles]
    names = np.array([atlas.index(m.texture) for m in mesh.materials], np.int32)
    tints = np.array([m.tint for m in mesh.materials], np.float32)
    emission = np.array([m.emission for m in mesh.materials], np.float32)
    return ShadingTables(
        np.ascontiguousarray(v[:, 0]),
        normal,
        dual.astype(np.float32),
        np.stack([uv[:, 0], uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=1).astype(np.float32),
        np.ascontiguousarray(light[mesh.triangles], dtype=np.float32),
        tints[mesh.material],
        emission[mesh.material],
        names[mesh.material],
        mesh.surface,
        atlas.texels,
        atlas.offset,
        atlas.width_px,
        atlas.height_px,
        atlas.levels,
    )


@kernel(fastmath=True)
def _bilinear(
    s: ShadingTables, texture: int, level: int, u: float, v: float, weight: float
) -> tuple[np.float32, np.float32, np.float32]:
    width, height = s.width_px[texture, level], s.height_px[texture, level]
    x = np.float32((u - np.floor(u)) * width - 0.5)
    y = np.float32((1.0 - (v - np.floor(v))) * height - 0.5)
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - np.float32(x0), y - np.float32(y0)
    x1, y1 = x0 + 1, y0 + 1
    x0 = x0 + width if x0 < 0 else x0
    y0 = y0 + height if y0 < 0 else y0
    x1 = x1 - width if x1 >= width else x1
    y1 = y1 - height if y1 >= height else y1
    base = s.offset[texture, level]
    a, b = base + y0 * width + x0, base + y0 * width + x1
    c, d = base + y1 * width + x0, base + y1 * width + x1
    one = np.float32(1.0)
    scale = np.float32(weight / 65025.0)
    wa, wb = (one - fx) * (one - fy) * scale, fx * (one - fy) * scale
    wc, wd = (one - fx) * fy * scale, fx * fy * scale
    t = s.texels
    ra, rb, rc, rd = np.float32(t[a, 0]), np.float32(t[b, 0]), np.float32(t[c, 0]), np.float32(t[d, 0])
    ga, gb, gc, gd = np.float32(t[a, 1]), np.float32(t[b, 1]), np.float32(t[c, 1]), np.float32(t[d, 1])
    ba, bb, bc, bd = np.float32(t[a, 2]), np.float32(t[b, 2]), np.float32(t[c, 2]), np.float32(t[d, 2])
    return (
        wa * ra * ra + wb * rb * rb + wc * rc * rc + wd * rd * rd,
        wa * ga * ga + wb * gb * gb + wc * gc * gc + wd * gd * gd,
        wa * ba * ba + wb * bb * bb + wc * bc * bc + wd * bd * bd,
    )


@kernel(fastmath=True)
def sample(
    s: ShadingTables,
    texture: int,
    u: float,
    v: float,
    ux: float,
    vx: float,
    uy: float,
    vy: float,
    out: np.ndarray,
) -> None:
    """Write the linear RGB colour of a texture at (u, v), averaged over the footprint of a pixel, to out [3].

    The footprint is a parallelogram with edges (ux, vx) and (uy, vy), in texture repeats. The average is
    anisotropic filtering: several trilinear lookups along the longer edge.
    """
    width, height = s.width_px[texture, 0], s.height_px[texture, 0]
    long, short = np.hypot(ux * width, vx * height), np.hypot(uy * width, vy * height)
    step_u, step_v = ux, vx
    if short > long:
        long, short = short, long
        step_u, step_v = uy, vy
    probes = int(min(MAX_ANISOTROPY, max(1.0, np.ceil(long / max(short, 1e-6)))))
    width_px = max(short, long / probes)
    level = np.log2(max(width_px, 1e-6))
    top = s.levels[texture] - 1
    level = min(max(level, 0.0), float(top))
    low = int(level)
    high = min(low + 1, top)
    fraction = level - low
    # Interpolate between mip levels only where the difference is visible: not close to a level, and not
    # with many lookups, which already blur the step.
    if fraction < 0.12 or (probes > 2 and fraction < 0.5):
        fraction = 0.0
    elif fraction > 0.88 or probes > 2:
        low, fraction = high, 0.0
    weight = 1.0 / probes
    r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(probes):
        f = (k + 0.5) / probes - 0.5
        red, green, blue = _bilinear(
            s, texture, low, u + f * step_u, v + f * step_v, weight * (1.0 - fraction)
        )
        r, g, b = r + red, g + green, b + blue
        if fraction > 0.0:
            red, green, blue = _bilinear(s, texture, high, u + f * step_u, v + f * step_v, weight * fraction)
            r, g, b = r + red, g + green, b + blue
    out[0], out[1], out[2] = r, g, b


@kernel
def rotate_rays(table: np.ndarray, R: np.ndarray, out: np.ndarray) -> None:
    """Write the rays of table [N, 3], rotated by R [3, 3], to out [N, 3].

    This is a kernel and not a matrix product, because BLAS would start threads.
    """
    for i in range(len(table)):
        x, y, z = table[i, 0], table[i, 1], table[i, 2]
        for c in range(3):
            out[i, c] = R[c, 0] * x + R[c, 1] * y + R[c, 2] * z


@kernel(fastmath={"contract", "arcp", "nsz"})
def shade(
    s: ShadingTables,
    triangle: np.ndarray,  # int32 [N], -1 = none
    origin: np.ndarray,  # float64 [3]
    rays: np.ndarray,  # float32 [N, 3], world frame, scaled to z = 1 in the camera frame
    rays_x: np.ndarray,  # float32 [N, 3], difference to the next pixel's ray in x
    rays_y: np.ndarray,  # float32 [N, 3], difference to the next pixel's ray in y
    scale: float,  # width of a ray's footprint in pixels
    spheres: np.ndarray,  # float64 [K, 4], centre and radius of spheres that cast contact shadows
    colour: np.ndarray,  # float32 [N, 3] out: linear radiance
    depth: np.ndarray,  # float32 [N] in and out: metres along optical z; only nearer hits are written
) -> None:
    """Write `colour` and `depth` of each ray whose triangle is nearer than the present `depth` of the ray."""
    texel = np.zeros(3)
    for i in range(len(triangle)):
        f = triangle[i]
        if f < 0:
            continue
        dx, dy, dz = float(rays[i, 0]), float(rays[i, 1]), float(rays[i, 2])
        nx, ny, nz = s.normal[f, 0], s.normal[f, 1], s.normal[f, 2]
        ox, oy, oz = s.corner[f, 0] - origin[0], s.corner[f, 1] - origin[1], s.corner[f, 2] - origin[2]
        along = nx * dx + ny * dy + nz * dz
        height = nx * ox + ny * oy + nz * oz
        t = height / along
        if not (t > 0.0 and t < depth[i]):
            continue
        depth[i] = t
        a1, a2, a3 = s.dual[f, 0, 0], s.dual[f, 0, 1], s.dual[f, 0, 2]
        c1, c2, c3 = s.dual[f, 1, 0], s.dual[f, 1, 1], s.dual[f, 1, 2]
        px, py, pz = t * dx - ox, t * dy - oy, t * dz - oz
        b1 = a1 * px + a2 * py + a3 * pz
        b2 = c1 * px + c2 * py + c3 * pz
        u = s.uv[f, 0, 0] + b1 * s.uv[f, 1, 0] + b2 * s.uv[f, 2, 0]
        v = s.uv[f, 0, 1] + b1 * s.uv[f, 1, 1] + b2 * s.uv[f, 2, 1]
        reach = 8.0 * t  # bounds the footprint where the neighbouring ray misses the plane
        ex, ey, ez = dx + scale * rays_x[i, 0], dy + scale * rays_x[i, 1], dz + scale * rays_x[i, 2]
        slope = nx * ex + ny * ey + nz * ez
        t2 = min(height / slope, reach) if slope * along > 0 else reach
        qx, qy, qz = t2 * ex - t * dx, t2 * ey - t * dy, t2 * ez - t * dz
        g1 = a1 * qx + a2 * qy + a3 * qz
        g2 = c1 * qx + c2 * qy + c3 * qz
        ux = g1 * s.uv[f, 1, 0] + g2 * s.uv[f, 2, 0]
        vx = g1 * s.uv[f, 1, 1] + g2 * s.uv[f, 2, 1]
        ex, ey, ez = dx + scale * rays_y[i, 0], dy + scale * rays_y[i, 1], dz + scale * rays_y[i, 2]
        slope = nx * ex + ny * ey + nz * ez
        t2 = min(height / slope, reach) if slope * along > 0 else reach
        qx, qy, qz = t2 * ex - t * dx, t2 * ey - t * dy, t2 * ez - t * dz
        g1 = a1 * qx + a2 * qy + a3 * qz
        g2 = c1 * qx + c2 * qy + c3 * qz
        uy = g1 * s.uv[f, 1, 0] + g2 * s.uv[f, 2, 0]
        vy = g1 * s.uv[f, 1, 1] + g2 * s.uv[f, 2, 1]
        sample(s, s.texture[f], u, v, ux, vx, uy, vy, texel)
        b1, b2 = min(max(b1, 0.0), 1.0), min(max(b2, 0.0), 1.0)
        b0 = max(0.0, 1.0 - b1 - b2)
        shadow = 1.0
        if len(spheres):
            x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            flip = -1.0 if along > 0 else 1.0
            shadow = _sphere_occlusion(
                spheres, x, y, z, flip * nx / length, flip * ny / length, flip * nz / length
            )
        glow = s.emission[f]
        for c in range(3):
            light = b0 * s.light[f, 0, c] + b1 * s.light[f, 1, c] + b2 * s.light[f, 2, c]
            colour[i, c] = texel[c] * s.tint[f, c] * (light * shadow + glow)


@kernel
def _sphere_occlusion(
    spheres: np.ndarray, x: float, y: float, z: float, nx: float, ny: float, nz: float
) -> float:
    """Return the factor on the light at (x, y, z) near spheres [K, 4]: product of 1 - 0.8 cos r^2 / d^2.

    Sphere ambient occlusion after Inigo Quilez; 0.8 keeps contact shadows from becoming black.
    """
    left = 1.0
    for k in range(len(spheres)):
        dx, dy, dz = spheres[k, 0] - x, spheres[k, 1] - y, spheres[k, 2] - z
        squared = dx * dx + dy * dy + dz * dz
        if squared > 36.0 * spheres[k, 3] ** 2:
            continue
        squared = max(squared, spheres[k, 3] ** 2)
        cos = (nx * dx + ny * dy + nz * dz) / np.sqrt(squared)
        if cos > 0.0:
            left *= 1.0 - 0.8 * cos * spheres[k, 3] ** 2 / squared
    return left


@kernel
def mark_cones(rays: np.ndarray, axis: np.ndarray, cosine: np.ndarray, inside: np.ndarray) -> None:
    """Set `inside` [N] to True for each of the rays [N, 3] that is within at least one of A cones.

    `axis` [A, 3] contains the unit axes of the cones, `cosine` [A] the cosines of their half-angles.
    """
    for i in range(len(rays)):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        squared = x * x + y * y + z * z
        for k in range(len(axis)):
            along = axis[k, 0] * x + axis[k, 1] * y + axis[k, 2] * z
            if along > 0.0 and along * along > cosine[k] * cosine[k] * squared:
                inside[i] = True


@kernel
def find_edges(surface: np.ndarray, depth: np.ndarray, edge: np.ndarray) -> None:
    """Set `edge` [H, W] to True at adjacent pixels with different surfaces or over 4 % depth difference."""
    height, width = surface.shape
    for y in range(height):
        for x in range(width):
            here, z = surface[y, x], depth[y, x]
            if x + 1 < width and (surface[y, x + 1] != here or abs(depth[y, x + 1] - z) > 0.04 * z):
                edge[y, x] = edge[y, x + 1] = True
            if y + 1 < height and (surface[y + 1, x] != here or abs(depth[y + 1, x] - z) > 0.04 * z):
                edge[y, x] = edge[y + 1, x] = True
