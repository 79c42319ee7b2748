"""Generates a home from a seed: four rooms in a ring with doorways, and a route through all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.changes import ObjectChange, Rearrangement
from beamsplat.tools.simulator.mesh import Light, Material, MeshBuilder, SceneMesh
from beamsplat.tools.simulator.palette import Textures, home_textures
from beamsplat.tools.simulator.place import Room, WallOpening
from beamsplat.tools.simulator.rearrange import rearrange
from beamsplat.tools.simulator.rooms import furnish
from beamsplat.tools.simulator.shapes import box
from beamsplat.tools.simulator.walls import HALF_WALL_M, RoomFinish, draw_shell

ROUTE_CLEARANCE_M = 0.42  # distance of furniture from the route


@dataclass(frozen=True)
class Home:
    """Geometry, textures, lights, and a closed route of points (x, y) [N, 2] in metres for a robot."""

    mesh: SceneMesh
    textures: Textures
    lights: tuple[Light, ...]
    route_m: np.ndarray
    changes: tuple[ObjectChange, ...] = ()  # what differs from the home of the same seed


def build_home(seed: int, rearrangement: Rearrangement | None = None) -> Home:
    """Return the home generated from `seed`; the same seed yields bit-identical arrays.

    With a rearrangement, some furniture is moved, removed or added; the rest is bit-identical.

    Raises:
        ValueError: the rearrangement asks for more than the home offers.
    """
    rng = np.random.default_rng([seed, 0x48])
    textures = home_textures(np.random.default_rng([seed, 0x54]))
    builder = MeshBuilder({name: size for name, (_, size) in textures.items()})
    rooms, route = floor_plan(rng)
    finishes = _finishes(rng, rooms)
    for room in rooms:
        draw_shell(builder, room, finishes[room.name], rng)
    pieces = [piece for room in rooms for piece in furnish(builder, room, route, ROUTE_CLEARANCE_M, rng)]
    _terrace(builder, rooms)
    changes: tuple[ObjectChange, ...] = ()
    if rearrangement is not None:
        changes = rearrange(builder, pieces, route, ROUTE_CLEARANCE_M, rearrangement)
    return Home(builder.build(), textures, builder.lights, route, changes)


def floor_plan(rng: np.random.Generator) -> tuple[list[Room], np.ndarray]:
    """Return the four rooms with their doorways and windows, and a closed route through all of them.

    Rooms are in counter-clockwise order, from the south-west. The route is float64 [N, 2], points (x, y) in
    metres at steps of 5 cm. The origin is the centre of the house.
    """
    width, depth = rng.uniform(11.4, 12.6), rng.uniform(8.8, 9.8)
    low_x, high_x = rng.uniform(0.45, 0.58, 2) * width
    mid_y = rng.uniform(0.47, 0.56) * depth
    names = ["living", "kitchen", "bedroom", "study"]
    shift = int(rng.integers(4))
    names = names[shift:] + names[:shift]
    if rng.random() < 0.5:
        names = names[::-1]
    t = HALF_WALL_M
    rooms = [
        Room(names[0], t, t, low_x - t, mid_y - t),
        Room(names[1], low_x + t, t, width - t, mid_y - t),
        Room(names[2], high_x + t, mid_y + t, width - t, depth - t),
        Room(names[3], t, mid_y + t, high_x - t, depth - t),
    ]
    inset = rng.uniform(1.35, 1.9, 4)
    doors = [
        ("x", low_x, inset[0]),
        ("y", mid_y, width - inset[1]),
        ("x", high_x, depth - inset[2]),
        ("y", mid_y, inset[3]),
    ]
    sides = [("east", "west"), ("north", "south"), ("west", "east"), ("south", "north")]
    for k, (axis, line, along) in enumerate(doors):
        half = rng.uniform(0.48, 0.78)
        for room, side in zip((rooms[k], rooms[(k + 1) % 4]), sides[k]):
            point = np.array([line, along] if axis == "x" else [along, line])
            s = _along(room, side, point)
            room.openings[side].append(WallOpening(s - half, s + half, 0.0, 2.08, "door"))
    for room, outer in zip(
        rooms, (("south", "west"), ("south", "east"), ("north", "east"), ("north", "west"))
    ):
        _windows(rng, room, outer)
    shifted = np.array([-width / 2, -depth / 2])
    route = _route(rng, rooms, doors) + shifted
    for room in rooms:
        room.x0, room.x1 = room.x0 + shifted[0], room.x1 + shifted[0]
        room.y0, room.y1 = room.y0 + shifted[1], room.y1 + shifted[1]
    return rooms, route


def _along(room: Room, side: str, point: np.ndarray) -> float:
    x, y = room.corner(side)
    return float(
        {"south": x - point[0], "north": point[0] - x, "east": y - point[1], "west": point[1] - y}[side]
    )


def _windows(rng: np.random.Generator, room: Room, outer: tuple[str, str]) -> None:
    for k, side in enumerate(outer):
        length = room.length(side)
        if k == 0 and room.name in ("living", "bedroom"):
            s = float(rng.uniform(0.3, 0.7) * length)
            room.openings[side].append(WallOpening(s - 0.9, s + 0.9, 0.05, 2.12, "glass"))
            continue
        half = float(rng.uniform(0.6, 0.95))
        s = float(rng.uniform(half + 0.5, length - half - 0.5))
        sill = 1.02 if room.name == "kitchen" else float(rng.uniform(0.85, 0.95))
        room.openings[side].append(WallOpening(s - half, s + half, sill, 2.12, "window"))


def _route(rng: np.random.Generator, rooms: list[Room], doors: list[tuple[str, float, float]]) -> np.ndarray:
    """Return a closed route [N, 2]: straight through the doorways, in each room towards its outer corner."""
    corners = [
        (rooms[0].x0, rooms[0].y0),
        (rooms[1].x1, rooms[1].y0),
        (rooms[2].x1, rooms[2].y1),
        (rooms[3].x0, rooms[3].y1),
    ]
    points: list[np.ndarray] = []
    for k in range(4):
        room = rooms[k]
        centre = np.array([room.x0 + room.x1, room.y0 + room.y1]) / 2
        corner = np.array(corners[k])
        inward = np.sign(centre - corner)
        entry, leave = doors[k - 1], doors[k]
        points.append(_door_point(entry, room, 0.55))
        points.append(corner + inward * rng.uniform(1.30, 1.75, 2))
        points.append(_door_point(leave, room, 0.55))
    from beamsplat.tools.simulator.path import resample_closed

    return resample_closed(np.array(points), 0.05)


def _door_point(door: tuple[str, float, float], room: Room, distance: float) -> np.ndarray:
    axis, line, along = door
    centre = np.array([room.x0 + room.x1, room.y0 + room.y1]) / 2
    if axis == "x":
        return np.array([line + np.sign(centre[0] - line) * distance, along])
    return np.array([along, line + np.sign(centre[1] - line) * distance])


def _finishes(rng: np.random.Generator, rooms: list[Room]) -> dict[str, RoomFinish]:
    floors = dict(zip(("living", "study", "bedroom"), rng.permutation(["floor_a", "floor_c", "floor_d"])))
    floors["kitchen"] = str(rng.choice(["floor_b", "checker"]))
    walls = dict(
        zip(
            ("living", "kitchen", "bedroom", "study"),
            rng.permutation(["wall_a", "wall_b", "wall_c", "wall_d"]),
        )
    )
    accents = {"living": "brick", "bedroom": "damask", "study": str(rng.choice(["wall_c", "stonebrick"]))}
    out = {}
    for k, room in enumerate(rooms):
        inner = (("north", "east"), ("north", "west"), ("south", "west"), ("south", "east"))[k]
        accent = accents.get(room.name)
        out[room.name] = RoomFinish(
            floor=Material(str(floors[room.name])),
            wall=Material(str(walls[room.name])),
            ceiling=Material("panelling" if room.name == "living" else "ceiling"),
            accent=Material(accent) if accent else None,
            accent_side=str(rng.choice(inner)),
            dado=Material("front", tint=(0.95, 0.95, 0.95)) if room.name == "study" else None,
            beams=room.name == "study",
        )
    return out


def _terrace(b: MeshBuilder, rooms: list[Room]) -> None:
    """Draw a garden wall around the home, where lidar beams that pass through a glazed door end."""
    x0, y0 = min(r.x0 for r in rooms) - 2.6, min(r.y0 for r in rooms) - 2.6
    x1, y1 = max(r.x1 for r in rooms) + 2.6, max(r.y1 for r in rooms) + 2.6
    wall = Material("stonebrick")
    outdoors = b.placed((x0 + x1) / 2, (y0 + y1) / 2, 0.0, edge_m=1.5)
    w, d = x1 - x0, y1 - y0
    for x, y, sx, sy in ((0, -d / 2, w, 0.2), (0, d / 2, w, 0.2), (-w / 2, 0, 0.2, d), (w / 2, 0, 0.2, d)):
        box(outdoors, (x, y, 0.0), (sx, sy, 0.6), wall)
