"""A scene ready to be driven through: lit geometry, textures, a route; built once, then cached."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from beamsplat.tools.simulator import store
from beamsplat.tools.simulator.atlas import Atlas, build_atlas
from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.freespace import FreeSpace
from beamsplat.tools.simulator.glb import load_glb
from beamsplat.tools.simulator.home import build_home
from beamsplat.tools.simulator.humanoid import clothes
from beamsplat.tools.simulator.light import bake
from beamsplat.tools.simulator.mesh import Light, Material, Mesh
from beamsplat.tools.simulator.path import resample_closed

ROUTE_STEP_M = 0.30
MIN_CLEARANCE_M = 0.24

Report = Callable[[str], None]


@dataclass(frozen=True)
class World:
    """A lit scene and the control points [N, 2] of a closed drive through it."""

    mesh: Mesh
    atlas: Atlas
    light: np.ndarray  # float32 [V, 3], as `light.bake` gives it
    lights: tuple[Light, ...]
    route_m: np.ndarray

    @property
    def texture_size_m(self) -> dict[str, tuple[float, float]]:
        return {name: (float(w), float(h)) for name, (w, h) in zip(self.atlas.names, self.atlas.size_m)}


def world_key(seed: int, scene: str | None) -> str:
    """What the cache calls this world."""
    return store.key("world", seed, store.file_hash(Path(scene)) if scene else None)


def get_world(seed: int, scene: str | None, report: Report = lambda _: None) -> World:
    """From the cache, or built and put there (tens of seconds).

    Raises:
        ValueError: the scene file cannot be used; the text says why.
    """
    path = store.cache_root() / "worlds" / f"{world_key(seed, scene)}.npz"
    if not path.exists():
        world = build_world(seed, scene, report)
        with store.whole_file(path) as part, open(part, "wb") as out:
            _save(world, out)
    return load_world(path)


def build_world(seed: int, scene: str | None, report: Report = lambda _: None) -> World:
    """Generates or loads geometry, finds the route, bakes the light."""
    rng = np.random.default_rng([seed, 0x57])
    if scene is None:
        report("furnishing the home")
        home = build_home(seed)
        mesh, pictures, lights, hint = home.mesh, home.pictures, home.lights, home.route_m
    else:
        report(f"loading {scene}")
        mesh, pictures = load_glb(Path(scene))
        lights, hint = (), None
    caster = Caster.of(mesh)
    space = FreeSpace(mesh, caster)
    if hint is None:
        hint = resample_closed(space.tour(rng), 0.05)
        lights = _lamps(hint)
    route = space.relax(hint)
    # Bands shrink: even steps again, so that the spline sees no bunched points.
    route = resample_closed(route, ROUTE_STEP_M)
    if space.clearance(resample_closed(route, 0.05)).min() < MIN_CLEARANCE_M:
        raise ValueError(
            f"no drive keeps {MIN_CLEARANCE_M} m off everything in {scene or f'the home of seed {seed}'}: "
            "choose another seed or scene"
        )
    atlas = build_atlas({**pictures, **clothes(np.random.default_rng([seed, 0x43]))})
    report("baking light")
    return World(mesh, atlas, bake(mesh, atlas, lights, caster), lights, route)


def _lamps(route_m: np.ndarray) -> tuple[Light, ...]:
    """A file brings no lights we use: lamps at 2.2 m along the route, 2.5 m apart."""
    chosen: list[np.ndarray] = []
    for point in route_m:
        if all(np.linalg.norm(point - other) > 2.5 for other in chosen):
            chosen.append(point)
    return tuple(Light((float(x), float(y), 2.2), radius_m=0.2, intensity=(3.0, 2.9, 2.7)) for x, y in chosen)


def _save(world: World, out: object) -> None:
    mesh, atlas = world.mesh, world.atlas
    head = {
        "materials": [asdict(m) for m in mesh.materials],
        "lights": [asdict(light) for light in world.lights],
        "names": list(atlas.names),
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


def load_world(path: Path) -> World:
    """A world that `get_world` has put into the cache."""
    with np.load(path) as data:
        head = json.loads(data["head"].tobytes())
        materials = tuple(Material(**{**m, "tint": tuple(m["tint"])}) for m in head["materials"])
        lights = tuple(
            Light(**{k: tuple(v) if isinstance(v, list) else v for k, v in light.items()})
            for light in head["lights"]
        )
        mesh = Mesh(**{k: data[f"mesh_{k}"] for k in _MESH}, materials=materials)
        atlas = Atlas(tuple(head["names"]), **{k: data[f"atlas_{k}"] for k in _ATLAS})
        return World(mesh, atlas, data["light"], lights, data["route_m"])
