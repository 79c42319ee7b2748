"""Who walks where: closed stadium-shaped walks, chosen to be seen by the robot and never to touch it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.atlas import Atlas
from beamsplat.tools.simulator.cast import Caster
from beamsplat.tools.simulator.freespace import FreeSpace
from beamsplat.tools.simulator.humanoid import Body, cart, person
from beamsplat.tools.simulator.mesh import Light, Mesh, merge
from beamsplat.tools.simulator.path import Drive
from beamsplat.tools.simulator.render import Actors
from beamsplat.tools.simulator.shade import Surfaces, surfaces

TURN_M = 0.22  # radius of the turns at both ends
KEEP_OFF_M = 0.85  # from the robot's centre
REACH_M = 0.75  # of a body's limbs from its place
PROBE_RAYS = 192


@dataclass(frozen=True)
class Walk:
    """Round and round a stadium between two points, a whole number of rounds a lap."""

    start_m: tuple[float, float]
    end_m: tuple[float, float]
    rounds: int
    phase: float  # 0..1, where on the round a lap begins
    lap_s: float

    @property
    def round_m(self) -> float:
        return 2.0 * float(np.hypot(*np.subtract(self.end_m, self.start_m))) + 2.0 * np.pi * TURN_M

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places [N, 2], headings [N] and metres walked [N]."""
        walked = (self.rounds * np.asarray(time_s) / self.lap_s + self.phase) * self.round_m
        a, b = np.array(self.start_m), np.array(self.end_m)
        length = float(np.linalg.norm(b - a))
        ahead = (b - a) / length
        left = np.array([-ahead[1], ahead[0]])
        s = np.mod(walked, self.round_m)[..., None]
        half = np.pi * TURN_M
        bend = np.where(s < length + half, s - length, s - 2 * length - half) / TURN_M
        turn_b = b + TURN_M * (left + np.sin(bend) * ahead - np.cos(bend) * left)
        turn_a = a + TURN_M * (left - np.sin(bend) * ahead + np.cos(bend) * left)
        back = b + 2 * TURN_M * left - (s - length - half) * ahead
        place = np.where(
            s < length,
            a + s * ahead,
            np.where(s < length + half, turn_b, np.where(s < 2 * length + half, back, turn_a)),
        )
        base = np.arctan2(ahead[1], ahead[0])
        s = s[..., 0]
        turned = np.where(
            s < length,
            0.0,
            np.where(
                s < length + half, bend[..., 0], np.where(s < 2 * length + half, np.pi, np.pi + bend[..., 0])
            ),
        )
        return place, base + turned, walked


def choose_walks(
    space: FreeSpace,
    drive: Drive,
    caster: Caster,
    count: int,
    duration_s: float,
    rng: np.random.Generator,
    *,
    tries: int = 500,
) -> list[Walk]:
    """The walks most often in the robot's view among random ones that keep off it and off each other.

    Raises:
        ValueError: there is no room for so many movers.
    """
    places = space.places(0.35)
    times = np.arange(0.0, min(duration_s, drive.lap_s), 0.25)
    robot = drive.pose_at(times)
    chosen: list[Walk] = []
    for _ in range(count):
        best, best_score = None, -1.0
        for _ in range(tries):
            walk = _random_walk(space, places, drive.lap_s, rng)
            if walk is None:
                continue
            spots, _, _ = walk.at(times)
            distance = np.linalg.norm(spots - robot[:, :2], axis=1)
            if distance.min() < KEEP_OFF_M:
                continue
            if any(np.linalg.norm(spots - other.at(times)[0], axis=1).min() < 0.8 for other in chosen):
                continue
            score = _seen(caster, robot, spots, distance)
            if score > best_score:
                best, best_score = walk, score
        if best is None:
            raise ValueError(f"the scene has no room for {count} movers beside the robot: ask for fewer")
        chosen.append(best)
    return chosen


def _random_walk(space: FreeSpace, places: np.ndarray, lap_s: float, rng: np.random.Generator) -> Walk | None:
    if len(places) == 0:
        return None
    a = places[int(rng.integers(len(places)))]
    b = a + rng.uniform(0.9, 4.0) * np.array([np.cos(t := rng.uniform(0, 2 * np.pi)), np.sin(t)])
    walk = Walk(tuple(a.tolist()), tuple(b.tolist()), 1, float(rng.random()), lap_s)
    rounds = max(1, round(rng.uniform(0.45, 0.85) * lap_s / walk.round_m))
    walk = Walk(walk.start_m, walk.end_m, rounds, walk.phase, lap_s)
    corners = walk.at(np.linspace(0.0, lap_s / rounds, 24))[0]
    return walk if space.clearance(corners).min() > 0.32 else None


def _seen(caster: Caster, robot: np.ndarray, spots: np.ndarray, distance: np.ndarray) -> float:
    to = spots - robot[:, :2]
    bearing = np.abs(np.angle(np.exp(1j * (np.arctan2(to[:, 1], to[:, 0]) - robot[:, 2]))))
    at = np.flatnonzero((bearing < 0.5) & (distance < 6.0))
    if len(at) == 0:
        return 0.0
    origins = np.column_stack([robot[at, :2], np.full(len(at), 0.5)])
    rays = np.column_stack([to[at], np.full(len(at), 0.3)])
    clear = ~caster.occluded(origins, rays, np.ones(len(at)))
    return float(np.sum(clear / (1.0 + 0.15 * distance[at])))


class Cast:
    """All movers of a scene, posed and lit at any time."""

    def __init__(self, bodies: list[Body], walks: list[Walk]) -> None:
        self.bodies, self.walks = bodies, walks

    @classmethod
    def of(
        cls, walks: list[Walk], people: int, sizes: dict[str, tuple[float, float]], rng: np.random.Generator
    ) -> Cast:
        """The first `people` walks are people's, the others carts'."""
        makers = [person] * people + [cart] * (len(walks) - people)
        return cls([make(rng, sizes) for make in makers], walks)

    def mesh_at(self, time_s: float) -> Mesh:
        """All bodies at a time in seconds of the lap."""
        meshes = []
        for body, walk in zip(self.bodies, self.walks):
            place, yaw, walked = walk.at(np.array(time_s))
            meshes.append(body.posed(float(place[0]), float(place[1]), float(yaw), float(walked)))
        return merge(meshes)

    def circles(self, time_s: float) -> np.ndarray:
        """float64 [A, 3]: place and reach of each body."""
        places = [walk.at(np.array(time_s))[0] for walk in self.walks]
        return np.array([[*place, REACH_M] for place in places])

    def caster_of(self, index: int, time_s: float) -> Caster:
        """One body at a time."""
        place, yaw, walked = self.walks[index].at(np.array(time_s))
        mesh = self.bodies[index].posed(float(place[0]), float(place[1]), float(yaw), float(walked))
        return Caster.of(mesh)


class Stage:
    """Lights the cast by what the static scene around each body sends out."""

    def __init__(
        self, cast: Cast, caster: Caster, scene: Surfaces, atlas: Atlas, lights: tuple[Light, ...]
    ) -> None:
        self._cast, self._caster, self._atlas = cast, caster, atlas
        mean = atlas.mean[scene.texture] * scene.tint
        self._leaving = mean * (scene.light.mean(axis=1) + scene.emission[:, None])
        self._lamps = [light for light in lights if light.radius_m > 0]
        k = np.arange(PROBE_RAYS)
        z, angle = 1 - 2 * (k + 0.5) / PROBE_RAYS, 2.39996323 * k
        r = np.sqrt(1 - z * z)
        self._rays = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1).astype(np.float32)

    def actors_at(self, time_s: float) -> Actors:
        """Everybody at a time, ready to be drawn."""
        meshes, lights, bounds, balls = [], [], [], []
        for body, walk in zip(self._cast.bodies, self._cast.walks):
            place, yaw, walked = walk.at(np.array(time_s))
            mesh = body.posed(float(place[0]), float(place[1]), float(yaw), float(walked))
            meshes.append(mesh)
            lights.append(self._light(mesh))
            low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
            bounds.append([*((low + high) / 2), float(np.linalg.norm(high - low) / 2)])
            balls += self._balls(mesh, body.kind)
        whole = merge(meshes)
        return Actors(
            Caster.of(whole),
            surfaces(whole, self._atlas, np.concatenate(lights)),
            np.array(bounds, dtype=np.float64),
            np.array(balls, dtype=np.float64),
        )

    def _light(self, mesh: Mesh) -> np.ndarray:
        """Irradiance / pi [V, 3]: a probe of the surroundings at the body's middle, and unhidden lamps."""
        middle = ((mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0)) / 2).astype(np.float64)
        hit = self._caster.first_from(middle, self._rays)
        sent = np.where((hit >= 0)[:, None], self._leaving[hit], 0.0)
        facing = np.maximum(mesh.normals @ self._rays.T, 0.0)
        light = facing @ sent * np.float32(4.0 / PROBE_RAYS)
        for lamp in self._lamps:
            to = np.array(lamp.centre_m) - middle
            distance = float(np.linalg.norm(to))
            if distance > 6.0 or distance < lamp.radius_m:
                continue
            reach = 1.0 - 1.1 * lamp.radius_m / distance
            if self._caster.occluded(middle[None], to[None], np.array([reach]))[0]:
                continue
            from_vertex = np.array(lamp.centre_m) - mesh.vertices_m
            squared = np.maximum(np.einsum("ij,ij->i", from_vertex, from_vertex), 0.1)
            cos = np.einsum("ij,ij->i", from_vertex, mesh.normals) / np.sqrt(squared)
            light += (np.maximum(cos, 0) / squared / np.pi)[:, None] * np.array(lamp.intensity)
        return light.astype(np.float32)

    @staticmethod
    def _balls(mesh: Mesh, kind: str) -> list[list[float]]:
        """Round stand-ins for what darkens the floor: the feet and the body, or the cart's decks."""
        low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        x, y = ((low + high) / 2)[:2]
        if kind == "cart":
            return [[x, y, 0.30, 0.30], [x, y, 0.75, 0.25]]
        feet = mesh.vertices_m[mesh.vertices_m[:, 2] < low[2] + 0.06]
        side = feet[:, :2] @ (feet[:, :2].max(axis=0) - feet[:, :2].min(axis=0))
        split = side > np.median(side)
        out = [[*part[:, :2].mean(axis=0), 0.06, 0.10] for part in (feet[split], feet[~split]) if len(part)]
        return [*out, [x, y, 0.55, 0.22], [x, y, 1.15, 0.24]]
