"""A training home that is built in a second: a room with a table, and objects on it."""

import numpy as np
import pytest

pytest.importorskip("embreex", reason="the simulator needs the [sim] extra")
pytest.importorskip("torch", reason="training needs the [train] extra")

from beamsplat.tools.simulator.atlas import build_atlas
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.light import bake
from beamsplat.tools.simulator.mesh import Light, Material, MeshBuilder
from beamsplat.tools.simulator.path import DrivePath, MotionLimits, resample_closed
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.shapes import box
from beamsplat.tools.simulator.world import World
from beamsplat.tools.training.generate import HomeTask, generate_home
from beamsplat.tools.training.homes import TrainingHome
from tests.tools.simulator.room import draw_room

ROUTE = np.array([[-2.0, -1.2], [2.0, -1.2], [2.3, 0.0], [2.0, 1.2], [-2.0, 1.2], [-2.3, 0.0]])
TABLE_M = 0.75


@pytest.fixture(scope="session")
def room_home():
    """A 6 x 4 x 2.5 m room with a table of 0.75 m in the middle."""
    rng = np.random.default_rng(3)
    noise = rng.uniform(0.2, 0.9, (64, 64, 3)).astype(np.float32)
    textures = {"noise": (noise, (1.0, 1.0)), "plain": (np.full((4, 4, 3), 0.8, np.float32), (1.0, 1.0))}
    builder = MeshBuilder({name: size for name, (_, size) in textures.items()}, edge_m=0.5)
    draw_room(builder)
    box(builder, (0.0, 0.0, 0.0), (1.6, 0.8, TABLE_M), Material("plain"))
    box(builder, (0.3, 0.1, TABLE_M), (0.2, 0.2, 0.25), Material("noise"))
    mesh, lights = builder.build(), (Light((0.0, 0.0, 2.2), radius_m=0.1, intensity=(3.0, 3.0, 3.0)),)
    caster, atlas = RayCaster.of(mesh), build_atlas(textures)
    route = resample_closed(ROUTE, 0.3)
    world = World(mesh, atlas, bake(mesh, atlas, lights, caster, rays=8), lights, route)
    return TrainingHome(world, caster, ClearanceGrid(mesh, caster), DrivePath(route, MotionLimits()))


# Of a home without people, for which the room has no textures, and of drives that begin without a fault.
SEED = 3


@pytest.fixture(scope="session")
def samples(room_home, tmp_path_factory):
    """(folder with the samples of the room as a home, its record)."""
    folder = tmp_path_factory.mktemp("training") / "train"
    record = generate_home(HomeTask(SEED, 2, "", folder=str(folder / "home_0000")), room_home)
    return folder, record
