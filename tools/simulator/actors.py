"""Dynamic objects: persons and carts on closed paths, in view of the robot but clear of its path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.tools.simulator.atlas import Atlas
from beamsplat.tools.simulator.clearance_grid import ClearanceGrid
from beamsplat.tools.simulator.humanoid import ArticulatedBody, cart, person
from beamsplat.tools.simulator.mesh import Light, SceneMesh, merge
from beamsplat.tools.simulator.path import DrivePath
from beamsplat.tools.simulator.ray_caster import RayCaster
from beamsplat.tools.simulator.render import ActorSnapshot
from beamsplat.tools.simulator.shade import ShadingTables, shading_tables

TURN_RADIUS_M = 0.22  # of the half circles at both ends of a path
MIN_ROBOT_DISTANCE_M = 0.85  # smallest distance of an actor from the robot's centre
ACTOR_RADIUS_M = 0.75  # of a circle that contains a body with its limbs
PROBE_RAYS = 192  # rays of the light probe at the middle of an actor


@dataclass(frozen=True)
class ActorPath:
    """A closed stadium-shaped path between two points.

    An actor completes `rounds` rounds of this path while the robot completes one lap of `lap_s` seconds.
    Points are (x, y) in the world frame.
    """

    start_m: tuple[float, float]
    end_m: tuple[float, float]
    rounds: int
    phase: float  # 0..1, position on the path when a lap of the robot begins
    lap_s: float

    @property
    def round_length_m(self) -> float:
        """Length of one round in metres."""
        return 2.0 * float(np.hypot(*np.subtract(self.end_m, self.start_m))) + 2.0 * np.pi * TURN_RADIUS_M

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return poses and travelled distances of the actor at times in seconds since the start of the lap.

        Returns:
            Positions (x, y) [N, 2] in metres and headings [N] in radians, both in the world frame, and
            distances [N] in metres travelled since the start point of the path.
        """
        travelled_m = (self.rounds * np.asarray(time_s) / self.lap_s + self.phase) * self.round_length_m
        a, b = np.array(self.start_m), np.array(self.end_m)
        length = float(np.linalg.norm(b - a))
        ahead = (b - a) / length
        left = np.array([-ahead[1], ahead[0]])
        s = np.mod(travelled_m, self.round_length_m)[..., None]
        half = np.pi * TURN_RADIUS_M
        bend = np.where(s < length + half, s - length, s - 2 * length - half) / TURN_RADIUS_M
        turn_b = b + TURN_RADIUS_M * (left + np.sin(bend) * ahead - np.cos(bend) * left)
        turn_a = a + TURN_RADIUS_M * (left - np.sin(bend) * ahead + np.cos(bend) * left)
        back = b + 2 * TURN_RADIUS_M * left - (s - length - half) * ahead
        position = np.where(
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
        return position, base + turned, travelled_m


def choose_actor_paths(
    space: ClearanceGrid,
    drive: DrivePath,
    caster: RayCaster,
    count: int,
    duration_s: float,
    rng: np.random.Generator,
    *,
    tries: int = 500,
) -> list[ActorPath]:
    """Return `count` paths: for each actor, the random candidate that the robot's camera sees best.

    An actor is never nearer than MIN_ROBOT_DISTANCE_M to the robot, nor nearer than 0.8 m to another actor.

    Args:
        space: free floor of the scene.
        drive: path of the robot.
        caster: ray caster of the static scene, for visibility.
        count: number of actors.
        duration_s: duration of the recording.
        tries: random candidates per actor.

    Raises:
        ValueError: there is not enough free space for so many actors.
    """
    places = space.places(0.35)
    times = np.arange(0.0, min(duration_s, drive.lap_s), 0.25)
    robot = drive.pose_at(times)
    chosen: list[ActorPath] = []
    for _ in range(count):
        best, best_score = None, -1.0
        for _ in range(tries):
            path = _random_path(space, places, drive.lap_s, rng)
            if path is None:
                continue
            positions, _, _ = path.at(times)
            distance = np.linalg.norm(positions - robot[:, :2], axis=1)
            if distance.min() < MIN_ROBOT_DISTANCE_M:
                continue
            if any(np.linalg.norm(positions - other.at(times)[0], axis=1).min() < 0.8 for other in chosen):
                continue
            score = _visibility_score(caster, robot, positions, distance)
            if score > best_score:
                best, best_score = path, score
        if best is None:
            raise ValueError(
                f"the scene has not enough free space for {count} people and carts: choose fewer"
            )
        chosen.append(best)
    return chosen


def _random_path(
    space: ClearanceGrid, places: np.ndarray, lap_s: float, rng: np.random.Generator
) -> ActorPath | None:
    if len(places) == 0:
        return None
    a = places[int(rng.integers(len(places)))]
    b = a + rng.uniform(0.9, 4.0) * np.array([np.cos(t := rng.uniform(0, 2 * np.pi)), np.sin(t)])
    path = ActorPath(tuple(a.tolist()), tuple(b.tolist()), 1, float(rng.random()), lap_s)
    rounds = max(1, round(rng.uniform(0.45, 0.85) * lap_s / path.round_length_m))
    path = ActorPath(path.start_m, path.end_m, rounds, path.phase, lap_s)
    corners = path.at(np.linspace(0.0, lap_s / rounds, 24))[0]
    return path if space.clearance(corners).min() > 0.32 else None


def _visibility_score(
    caster: RayCaster, robot: np.ndarray, positions: np.ndarray, distance: np.ndarray
) -> float:
    to = positions - robot[:, :2]
    bearing = np.abs(np.angle(np.exp(1j * (np.arctan2(to[:, 1], to[:, 0]) - robot[:, 2]))))
    at = np.flatnonzero((bearing < 0.5) & (distance < 6.0))
    if len(at) == 0:
        return 0.0
    origins = np.column_stack([robot[at, :2], np.full(len(at), 0.5)])
    rays = np.column_stack([to[at], np.full(len(at), 0.3)])
    clear = ~caster.occluded(origins, rays, np.ones(len(at)))
    return float(np.sum(clear / (1.0 + 0.15 * distance[at])))


class ActorSet:
    """All dynamic objects of a scene, each a body on a path."""

    def __init__(self, bodies: list[ArticulatedBody], paths: list[ActorPath]) -> None:
        self.bodies, self.paths = bodies, paths

    @classmethod
    def of(
        cls,
        paths: list[ActorPath],
        people: int,
        sizes: dict[str, tuple[float, float]],
        rng: np.random.Generator,
    ) -> ActorSet:
        """Return a set with a person on each of the first `people` paths and a cart on each other path.

        `sizes` maps the name of a texture to the width and height in metres of one repeat.
        """
        makers = [person] * people + [cart] * (len(paths) - people)
        return cls([make(rng, sizes) for make in makers], paths)

    def bounding_circles(self, time_s: float) -> np.ndarray:
        """Return float64 [A, 3]: x, y and radius in metres of a circle around each of A bodies."""
        places = [path.at(np.array(time_s))[0] for path in self.paths]
        return np.array([[*position, ACTOR_RADIUS_M] for position in places])

    def ray_caster_of(self, index: int, time_s: float) -> RayCaster:
        """Return a ray caster of body number `index`, posed at `time_s` seconds after the lap start."""
        position, yaw, travelled_m = self.paths[index].at(np.array(time_s))
        mesh = self.bodies[index].posed(
            float(position[0]), float(position[1]), float(yaw), float(travelled_m)
        )
        return RayCaster.of(mesh)


class ActorLighting:
    """Computes the light on the actors from the surfaces and lamps of the static scene."""

    def __init__(
        self,
        actors: ActorSet,
        caster: RayCaster,
        scene: ShadingTables,
        atlas: Atlas,
        lights: tuple[Light, ...],
    ) -> None:
        self._actors, self._caster, self._atlas = actors, caster, atlas
        mean = atlas.mean[scene.texture] * scene.tint
        self._leaving = mean * (scene.light.mean(axis=1) + scene.emission[:, None])
        self._lamps = [light for light in lights if light.radius_m > 0]
        k = np.arange(PROBE_RAYS)
        z, angle = 1 - 2 * (k + 0.5) / PROBE_RAYS, 2.39996323 * k
        r = np.sqrt(1 - z * z)
        self._rays = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1).astype(np.float32)

    def snapshot(self, time_s: float) -> ActorSnapshot:
        """Return all actors, posed and lit, at `time_s` seconds after the start of the lap."""
        meshes, lights, bounds, occluder_spheres = [], [], [], []
        for body, path in zip(self._actors.bodies, self._actors.paths):
            position, yaw, travelled_m = path.at(np.array(time_s))
            mesh = body.posed(float(position[0]), float(position[1]), float(yaw), float(travelled_m))
            meshes.append(mesh)
            lights.append(self._light(mesh))
            low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
            bounds.append([*((low + high) / 2), float(np.linalg.norm(high - low) / 2)])
            occluder_spheres += self._occluder_spheres(mesh, body.kind)
        whole = merge(meshes)
        return ActorSnapshot(
            RayCaster.of(whole),
            shading_tables(whole, self._atlas, np.concatenate(lights)),
            np.array(bounds, dtype=np.float64),
            np.array(occluder_spheres, dtype=np.float64),
        )

    def _light(self, mesh: SceneMesh) -> np.ndarray:
        """Return irradiance / pi at the V vertices of a body, linear RGB float32 [V, 3].

        This is the sum of the light from a probe at the middle of the body and from the lamps visible there.
        """
        middle = ((mesh.vertices_m.min(axis=0) + mesh.vertices_m.max(axis=0)) / 2).astype(np.float64)
        hit = self._caster.first_hit_from(middle, self._rays)
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
    def _occluder_spheres(mesh: SceneMesh, kind: str) -> list[list[float]]:
        """Return spheres (x, y, z, radius) that cast contact shadows.

        The spheres are at the feet and the body of a person, or at the decks of a cart.
        """
        low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        x, y = ((low + high) / 2)[:2]
        if kind == "cart":
            return [[x, y, 0.30, 0.30], [x, y, 0.75, 0.25]]
        feet = mesh.vertices_m[mesh.vertices_m[:, 2] < low[2] + 0.06]
        side = feet[:, :2] @ (feet[:, :2].max(axis=0) - feet[:, :2].min(axis=0))
        split = side > np.median(side)
        out = [[*part[:, :2].mean(axis=0), 0.06, 0.10] for part in (feet[split], feet[~split]) if len(part)]
        return [*out, [x, y, 0.55, 0.22], [x, y, 1.15, 0.24]]
