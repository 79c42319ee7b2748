"""Homes for training: generated homes with white walls, other ceiling heights and clutter within reach."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beamsplat.tools.simulator.atlas import build_atlas
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.home import build_home
from beamsplat.tools.simulator.humanoid import clothes
from beamsplat.tools.simulator.light import bake
from beamsplat.tools.simulator.mesh import Light, Material, MeshBuilder, SceneMesh, merge
from beamsplat.tools.simulator.palette import WALLS
from beamsplat.tools.simulator.path import DrivePath, MotionLimits, resample_closed
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.shapes import box, cylinder
from beamsplat.tools.simulator.world import MIN_CLEARANCE_M, ROUTE_STEP_M, World

_GATHER_RAYS = 16  # per vertex, for indirect light: a third of a recording's, noise is not visible at 160 px
_CEILINGS = (0.92, 1.25)  # factors on all heights of a home: ceilings of 2.35 to 3.19 m
_WHITE_WALLS = 0.4  # probability that a wall finish is replaced by plain paint
_ON_FURNITURE, _ON_FLOOR = 70, 24  # objects in a home, at most
_SUPPORT_M = (0.30, 1.25)  # heights of surfaces on which objects stand
_FLOOR_CLEARANCE_M = 0.45  # objects on the floor stay this far from the route
_ATTEMPTS = 6  # variations of a seed that are tried until the robot has a route


@dataclass(frozen=True)
class TrainingHome:
    """A home with light and textures, and a robot's path through it."""

    world: World
    caster: RayCaster
    space: ClearanceGrid
    drive: DrivePath


def build_training_home(seed: int) -> TrainingHome:
    """Return the home of a seed (about 10 s of CPU time); the same seed yields the same home.

    Raises:
        ValueError: no variation of the seed has a route for the robot.
    """
    for attempt in range(_ATTEMPTS):
        home = _variation(np.random.default_rng([seed, attempt, 0x54]), seed + 7_000_003 * attempt)
        if home is not None:
            return home
    raise ValueError(f"no home of seed {seed} has a route that keeps {MIN_CLEARANCE_M} m from obstacles")


def _variation(rng: np.random.Generator, seed: int) -> TrainingHome | None:
    home = build_home(seed)
    textures = {**home.textures, **clothes(rng)}
    clutter = MeshBuilder({name: size for name, (_, size) in textures.items()}, edge_m=0.08)
    _draw_clutter(clutter, home.mesh, home.route_m, [n for n in textures if not n.startswith("garden")], rng)
    painted = replace(home.mesh, materials=_painted(home.mesh.materials, rng))
    factor = rng.uniform(*_CEILINGS)
    mesh = stretched(merge([painted, clutter.build()]), factor)
    lights = tuple(_stretched_light(light, factor) for light in home.lights)
    caster = RayCaster.of(mesh)
    space = ClearanceGrid(mesh, caster)
    route = resample_closed(space.relax(home.route_m), ROUTE_STEP_M)
    if space.clearance(resample_closed(route, 0.05)).min() < MIN_CLEARANCE_M:
        return None
    atlas = build_atlas(textures)
    light = bake(mesh, atlas, lights, caster, rays=_GATHER_RAYS)
    world = World(mesh, atlas, light, lights, route)
    return TrainingHome(world, caster, space, DrivePath(route, MotionLimits(), start=float(rng.random())))


def _painted(materials: tuple[Material, ...], rng: np.random.Generator) -> tuple[Material, ...]:
    """Return the materials, with some wall finishes replaced by plain paint, which has hardly any texture."""
    paint: dict[str, Material] = {}
    for name in (*WALLS, "brick", "damask", "stonebrick"):
        if rng.random() < _WHITE_WALLS:
            grey = rng.uniform(0.75, 0.97)
            tint = tuple((grey * rng.uniform(0.96, 1.0, 3)).tolist())
            paint[name] = Material("plain" if rng.random() < 0.6 else "ceiling", tint=tint)
    return tuple(paint.get(material.texture, material) for material in materials)


def stretched(mesh: SceneMesh, factor: float) -> SceneMesh:
    """Return the mesh with all heights multiplied by `factor`."""
    scale = np.array([1.0, 1.0, factor], np.float32)
    normals = mesh.normals / scale
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return replace(
        mesh, vertices_m=mesh.vertices_m * scale, normals=normals.astype(np.float32),
        bake_points_m=mesh.bake_points_m * scale,
    )  # fmt: skip


def _stretched_light(light: Light, factor: float) -> Light:
    def scaled(v: tuple[float, float, float]) -> tuple[float, float, float]:
        return v[0], v[1], v[2] * factor

    return replace(light, centre_m=scaled(light.centre_m), up_m=scaled(light.up_m))


def _draw_clutter(
    b: MeshBuilder, mesh: SceneMesh, route_m: np.ndarray, textures: list[str], rng: np.random.Generator
) -> None:
    """Draw boxes and cylinders on furniture and, off the robot's route, on the floor."""
    caster = RayCaster.of(mesh)
    low, high = mesh.vertices_m[:, :2].min(axis=0), mesh.vertices_m[:, :2].max(axis=0)
    count = 4000
    xy = rng.uniform(low, high, (count, 2))
    radius = rng.uniform(0.02, 0.14, count)
    level = _support_heights(caster, xy, radius)
    tables = np.flatnonzero((level > _SUPPORT_M[0]) & (level < _SUPPORT_M[1]))[:_ON_FURNITURE]
    gap = np.array([np.hypot(*(route_m - point).T).min() for point in xy])
    free = (np.abs(level) < 0.01) & (gap > _FLOOR_CLEARANCE_M + radius)
    floor = np.flatnonzero(free)[:_ON_FLOOR]
    for k in np.concatenate([tables, floor]):
        material = Material(str(rng.choice(textures)), tint=tuple(rng.uniform(0.6, 1.0, 3).tolist()))
        height = float(rng.uniform(0.05, 0.35))
        frame = b.placed(float(xy[k, 0]), float(xy[k, 1]), float(level[k]), float(rng.uniform(0, np.pi)))
        _draw_object(frame, float(radius[k]), height, material, rng)


def _draw_object(
    b: MeshBuilder, radius_m: float, height_m: float, material: Material, rng: np.random.Generator
) -> None:
    if rng.random() < 0.5:
        side = 2.0 * radius_m * float(rng.uniform(0.4, 0.9))
        box(b, (0.0, 0.0, 0.0), (1.4 * radius_m, side, height_m), material, skip=("bottom",))
    else:
        cylinder(
            b, (0.0, 0.0, 0.0), 0.7 * radius_m, height_m, material,
            top_radius_m=0.7 * radius_m * float(rng.uniform(0.6, 1.0)), sides=12,
        )  # fmt: skip


def _support_heights(caster: RayCaster, xy_m: np.ndarray, radius_m: np.ndarray) -> np.ndarray:
    """Return the height (m) of the level surface below each disc, seen from 1.7 m; NaN where it is not level.

    `xy_m` [N, 2] are the centres of the discs, `radius_m` [N] their radii.
    """
    top = 1.7
    levels = []
    for dx, dy in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        origins = np.column_stack([xy_m + radius_m[:, None] * np.array([dx, dy]), np.full(len(xy_m), top)])
        down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), origins.shape)
        levels.append(top - caster.hit_distance(origins, down, caster.first_hit(origins, down)))
    table = np.stack(levels)
    with np.errstate(invalid="ignore"):
        flat = np.isfinite(table).all(axis=0) & (np.ptp(table, axis=0) < 0.005)
    return np.where(flat, table[0], np.nan)
