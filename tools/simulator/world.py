"""Builds, caches and loads worlds: scenes with precomputed light, textures and a route for the robot."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from beamsplat.tools.simulator import store
from beamsplat.tools.simulator.atlas import Atlas, build_atlas
from beamsplat.tools.simulator.changes import ObjectChange, Rearrangement
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.glb import load_glb
from beamsplat.tools.simulator.home import build_home
from beamsplat.tools.simulator.humanoid import clothes
from beamsplat.tools.simulator.light import bake
from beamsplat.tools.simulator.mesh import Light, Material, SceneMesh
from beamsplat.tools.simulator.path import resample_closed
from beamsplat.tools.simulator.ray_caster import RayCaster

ROUTE_STEP_M = 0.30  # distance between control points of the route
MIN_CLEARANCE_M = 0.24  # smallest distance of the route from obstacles: about the robot's radius

Report = Callable[[str], None]


@dataclass(frozen=True)
class World:
    """A scene with precomputed light, and control points (x, y) [N, 2] in metres of a closed route."""

    mesh: SceneMesh
    atlas: Atlas
    light: np.ndarray  # float32 [V, 3], irradiance / pi as `light.bake` returns
    lights: tuple[Light, ...]
    route_m: np.ndarray
    changes: tuple[ObjectChange, ...] = ()  # what a rearrangement has changed in the home

    @property
    def texture_size_m(self) -> dict[str, tuple[float, float]]:
        """Width and height of one repeat of each texture, by name."""
        return {name: (float(w), float(h)) for name, (w, h) in zip(self.atlas.names, self.atlas.size_m)}


def world_key(seed: int, scene: str | None, rearrangement: Rearrangement | None = None) -> str:
    """Return the cache key of the world of a seed, and of a scene file or a rearrangement if there is one."""
    parts = [] if rearrangement is None else [rearrangement]
    return store.key("world", seed, store.file_hash(Path(scene)) if scene else None, *parts)


def get_world(
    seed: int,
    scene: str | None,
    report: Report = lambda _: None,
    rearrangement: Rearrangement | None = None,
) -> World:
    """Return a world from the cache; if it is not there, build and store it first (tens of seconds).

    Args:
        seed: seed of the generated home, or of the route through the scene file.
        scene: path of a 3D scene file; None = a generated home.
        report: called with the name of each stage of the build.
        rearrangement: furniture that is moved, removed and added in the generated home.

    Raises:
        ValueError: the scene file cannot be used, no route is clear of obstacles, or a scene file or a home
            cannot be rearranged so.
    """
    path = store.cache_root() / "worlds" / f"{world_key(seed, scene, rearrangement)}.npz"
    if not path.exists():
        world = build_world(seed, scene, report, rearrangement)
        with store.atomic_file(path) as part, open(part, "wb") as out:
            _save(world, out)
    return load_world(path)


def build_world(
    seed: int,
    scene: str | None,
    report: Report = lambda _: None,
    rearrangement: Rearrangement | None = None,
) -> World:
    """Return a new world: generate or load the geometry, find a route, compute the light.

    The arguments are the same as of `get_world`; the cache is not used.

    Raises:
        ValueError: the scene file cannot be used, there is no route clear of obstacles, or the home cannot be
            rearranged so.
    """
    if scene is not None and rearrangement is not None:
        raise ValueError("--moved, --removed and --added change a generated home: leave out --scene")
    changes: tuple[ObjectChange, ...] = ()
    rng = np.random.default_rng([seed, 0x57])
    if scene is None:
        report("furnishing the home")
        home = build_home(seed, rearrangement)
        changes = home.changes
        mesh, textures, lights, hint = home.mesh, home.textures, home.lights, home.route_m
    else:
        report(f"loading {scene}")
        mesh, textures = load_glb(Path(scene))
        lights, hint = (), None
    caster = RayCaster.of(mesh)
    space = ClearanceGrid(mesh, caster)
    if hint is None:
        hint = resample_closed(space.tour(rng), 0.05)
        lights = _lamps(hint)
    route = space.relax(hint)
    # The elastic band contracts unevenly: resample, because a spline through bunched points oscillates.
    route = resample_closed(route, ROUTE_STEP_M)
    if space.clearance(resample_closed(route, 0.05)).min() < MIN_CLEARANCE_M:
        raise ValueError(
            f"no route keeps {MIN_CLEARANCE_M} m distance from all obstacles in "
            f"{scene or f'the home of seed {seed}'}: choose another seed or scene"
        )
    atlas = build_atlas({**textures, **clothes(np.random.default_rng([seed, 0x43]))})
    report("baking light")
    return World(mesh, atlas, bake(mesh, atlas, lights, caster), lights, route, changes)


def _lamps(route_m: np.ndarray) -> tuple[Light, ...]:
    """Return lamps 2.2 m above the route, 2.5 m apart, because lights in scene files are not read."""
    chosen: list[np.ndarray] = []
    for point in route_m:
        if all(np.linalg.norm(point - other) > 2.5 for other in chosen):
            chosen.append(point)
    return tuple(Light((float(x), float(y), 2.2), radius_m=0.2, intensity=(3.0, 2.9, 2.7)) for x, y in chosen)


def _save(world: World, out: BinaryIO) -> None:
    mesh, atlas = world.mesh, world.atlas
    head = {
        "materials": [asdict(m) for m in mesh.materials],
        "lights": [asdict(light) for light in world.lights],
        "names": list(atlas.names),
        "changes": [asdict(change) for change in world.changes],
    }
    arrays = {f"mesh_{k}": getattr(mesh, k) for k in _MESH}
    arrays |= {f"atlas_{k}": getattr(atlas, k) for k in _ATLAS}
    np.savez(
        out,
        head=np.frombuffer(json.dumps(head).encode(), np.uint8),
        light=world.light,
        route_m=world.route_m,
        **arrays,
    )


_MESH = ("vertices_m", "normals", "bake_points_m", "uvs", "triangles", "material", "surface")
_ATLAS = ("size_m", "texels", "offset", "width_px", "height_px", "levels", "mean")


def _with_tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}


def load_world(path: Path) -> World:
    """Return a world, read from a file that `get_world` wrote."""
    with np.load(path) as data:
        head = json.loads(data["head"].tobytes())
        materials = tuple(Material(**{**m, "tint": tuple(m["tint"])}) for m in head["materials"])
        lights = tuple(Light(**_with_tuples(light)) for light in head["lights"])
        mesh = SceneMesh(**{k: data[f"mesh_{k}"] for k in _MESH}, materials=materials)
        atlas = Atlas(tuple(head["names"]), **{k: data[f"atlas_{k}"] for k in _ATLAS})
        changes = tuple(ObjectChange(**_with_tuples(change)) for change in head["changes"])
        return World(mesh, atlas, data["light"], lights, data["route_m"], changes)
