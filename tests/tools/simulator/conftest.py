"""Fixtures: the box room as a mesh with textures, and a small furnished scene as a GLB file."""

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh", reason="the simulator needs the [sim] extra")
pytest.importorskip("embreex", reason="the simulator needs the [sim] extra")

from beamsplat.tools.simulator.atlas import build_atlas  # noqa: E402
from beamsplat.tools.simulator.mesh import Light, MeshBuilder  # noqa: E402
from tests.tools.simulator.room import draw_room  # noqa: E402


@pytest.fixture(scope="session")
def textures():
    noise = np.random.default_rng(3).uniform(0.2, 0.9, (64, 64, 3)).astype(np.float32)
    return {"noise": (noise, (1.0, 1.0)), "plain": (np.full((4, 4, 3), 0.8, np.float32), (1.0, 1.0))}


@pytest.fixture(scope="session")
def sizes(textures):
    return {name: size for name, (_, size) in textures.items()}


@pytest.fixture(scope="session")
def room(sizes):
    builder = MeshBuilder(sizes, edge_m=0.5)
    draw_room(builder)
    return builder.build()


@pytest.fixture(scope="session")
def room_atlas(textures):
    from beamsplat.tools.simulator.humanoid import clothes

    return build_atlas(
        {
            **textures,
            **clothes(np.random.default_rng(0)),
            "oak": textures["noise"],
            "steel": textures["plain"],
            "black": textures["plain"],
            "cushion_b": textures["noise"],
        }
    )


@pytest.fixture(scope="session")
def lamp():
    return Light((0.0, 0.0, 2.0), radius_m=0.1, intensity=(3.0, 3.0, 3.0))


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory):
    """A 6 x 5 m room with a block in the middle, y-up as glTF wants it."""
    parts = []

    def block(extents, centre, colour):
        mesh = trimesh.creation.box(extents=extents)
        mesh.apply_translation(centre)
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(baseColorFactor=[*colour, 255])
        )
        parts.append(mesh)

    block((6.4, 0.1, 5.4), (0, -0.05, 0), (150, 110, 70))
    block((6.4, 0.1, 5.4), (0, 2.55, 0), (230, 230, 225))
    for x in (-3.1, 3.1):
        block((0.2, 2.5, 5.4), (x, 1.25, 0), (200, 190, 160))
    for z in (-2.6, 2.6):
        block((6.0, 2.5, 0.2), (0, 1.25, z), (120, 150, 180))
    block((1.6, 0.8, 1.0), (0.2, 0.4, 0.1), (160, 60, 50))
    scene = trimesh.Scene()
    for k, mesh in enumerate(parts):
        scene.add_geometry(mesh, geom_name=f"part{k}", node_name=f"part{k}")
    path = tmp_path_factory.mktemp("scene") / "room.glb"
    path.write_bytes(scene.export(file_type="glb"))
    return path


@pytest.fixture(scope="session")
def own_cache(tmp_path_factory):
    """A cache folder for these tests instead of the user's."""
    patch = pytest.MonkeyPatch()
    folder = tmp_path_factory.mktemp("cache")
    patch.setenv("BEAMSPLAT_CACHE", str(folder))
    yield folder
    patch.undo()
