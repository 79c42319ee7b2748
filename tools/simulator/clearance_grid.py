"""Free floor of a scene for a robot or a person: a grid of obstacle clearances, and routes on free floor."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from beamsplat.tools.simulator.mesh import SceneMesh
from beamsplat.tools.simulator.ray_caster import RayCaster

RESOLUTION_M = 0.05
BODY_M = (0.03, 1.25)  # surfaces between these heights are obstacles


class ClearanceGrid:
    """A grid in the world xy plane that stores the clearance of each cell.

    The clearance is the distance in metres to the nearest obstacle or missing floor; 0 inside an obstacle or
    where there is no floor.
    """

    def __init__(self, mesh: SceneMesh, caster: RayCaster) -> None:
        points = _surface_points(mesh)
        points = points[(points[:, 2] > BODY_M[0]) & (points[:, 2] < BODY_M[1])]
        low, high = mesh.vertices_m[:, :2].min(axis=0) - 0.2, mesh.vertices_m[:, :2].max(axis=0) + 0.2
        self.origin_m = low.astype(np.float64)
        columns, rows = (np.ceil((high - low) / RESOLUTION_M)).astype(int)
        free = np.ones((rows, columns), np.uint8)
        cell = ((points[:, :2] - low) / RESOLUTION_M).astype(int)
        free[cell[:, 1], cell[:, 0]] = 0
        free &= self._has_floor(caster, free.shape)
        free = np.pad(free[1:-1, 1:-1], 1)
        self.clearance_m = cv2.distanceTransform(free, cv2.DIST_L2, 5) * RESOLUTION_M

    def _has_floor(self, caster: RayCaster, shape: tuple[int, int]) -> np.ndarray:
        row, column = np.mgrid[: shape[0], : shape[1]]
        xy = np.stack([column, row], axis=-1).reshape(-1, 2) * RESOLUTION_M + RESOLUTION_M / 2 + self.origin_m
        origins = np.column_stack([xy, np.full(len(xy), BODY_M[0] + 0.02)]).astype(np.float32)
        down = np.broadcast_to(np.array([0.0, 0.0, -1.0], np.float32), origins.shape)
        return caster.occluded(origins, down, np.full(len(xy), 0.12)).astype(np.uint8).reshape(shape)

    def clearance(self, points_m: np.ndarray) -> np.ndarray:
        """Return the clearance in metres at points (x, y) [..., 2], by bilinear interpolation."""
        at = (np.asarray(points_m) - self.origin_m) / RESOLUTION_M - 0.5
        return ndimage.map_coordinates(self.clearance_m, [at[..., 1], at[..., 0]], order=1, mode="nearest")

    def relax(self, route_m: np.ndarray, wanted_m: float = 0.5, *, iterations: int = 160) -> np.ndarray:
        """Return a closed route [N, 2] smoothed and pushed away from obstacles.

        This is an elastic band (Quinlan and Khatib 1993): points (x, y) in metres whose clearance is less
        than `wanted_m` are pushed towards larger clearance.
        """
        gradient = np.stack(np.gradient(self.clearance_m, RESOLUTION_M)[::-1], axis=0)
        points = route_m.copy()
        for _ in range(iterations):
            points += 0.45 * (0.5 * (np.roll(points, 1, axis=0) + np.roll(points, -1, axis=0)) - points)
            at = (points - self.origin_m) / RESOLUTION_M - 0.5
            push = np.stack(
                [ndimage.map_coordinates(g, [at[:, 1], at[:, 0]], order=1, mode="nearest") for g in gradient],
                axis=1,
            )
            lack = np.clip(wanted_m - self.clearance(points), 0.0, wanted_m)
            points += 0.12 * lack[:, None] * push
        return points

    def tour(self, rng: np.random.Generator, *, stops: int = 7, margin_m: float = 0.38) -> np.ndarray:
        """Return a closed route [N, 2] in metres through `stops` distant cells of the largest free area.

        Args:
            margin_m: smallest clearance on the route, in metres.

        Raises:
            ValueError: there is too little connected floor for a robot.
        """
        cells, graph = self._graph(margin_m)
        if len(cells) < 200:
            raise ValueError(
                "the scene has no connected floor to drive on: the floor must be flat, near z = 0 and at "
                f"least {2 * margin_m:.1f} m wide (glTF is y-up, in metres)"
            )
        chosen = [int(rng.integers(len(cells)))]
        distance, paths = [], []
        for _ in range(stops):
            d, before = dijkstra(graph, indices=chosen[-1], return_predecessors=True)  # type: ignore[call-overload]  # the stubs miss single indices
            distance.append(d)
            paths.append(before)
            chosen.append(int(np.argmax(np.where(np.isfinite(d), np.min(distance, axis=0), -1))))
        order = _round_trip(np.array([[distance[i][chosen[j]] for j in range(stops)] for i in range(stops)]))
        legs = []
        for i, j in zip(order, [*order[1:], order[0]]):
            walk = [chosen[j]]
            while walk[-1] != chosen[i]:
                walk.append(int(paths[i][walk[-1]]))
            legs.append(walk[::-1][:-1])
        return np.concatenate([self._centres(cells[leg]) for leg in legs])

    def _centres(self, cells: np.ndarray) -> np.ndarray:
        return (cells[:, ::-1] + 0.5) * RESOLUTION_M + self.origin_m

    def places(self, margin_m: float) -> np.ndarray:
        """Return the centres (x, y) [N, 2] in metres of all cells with more clearance than `margin_m`."""
        return self._centres(np.argwhere(self.clearance_m > margin_m))

    def _graph(self, margin_m: float) -> tuple[np.ndarray, sparse.csr_matrix]:
        label, count = ndimage.label(self.clearance_m > margin_m)
        if count == 0:
            return np.zeros((0, 2), int), sparse.csr_matrix((0, 0))
        largest = 1 + int(np.argmax(np.bincount(label.ravel())[1:]))
        inside = label == largest
        number = np.full(inside.shape, -1)
        number[inside] = np.arange(inside.sum())
        cost = 1.0 + 0.6 / np.maximum(self.clearance_m, 0.05)
        rows, columns, weights = [], [], []
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
            a = number[: -dy or None, max(0, -dx) : -dx if dx > 0 else None]
            c = number[dy:, max(0, dx) : dx if dx < 0 else None]
            w = cost[: -dy or None, max(0, -dx) : -dx if dx > 0 else None] * np.hypot(dx, dy)
            both = (a >= 0) & (c >= 0)
            rows.append(a[both])
            columns.append(c[both])
            weights.append(w[both])
        n = int(inside.sum())
        i, j, w = np.concatenate(rows), np.concatenate(columns), np.concatenate(weights)
        graph = sparse.csr_matrix((np.r_[w, w], (np.r_[i, j], np.r_[j, i])), shape=(n, n))
        return np.argwhere(inside), graph


def _surface_points(mesh: SceneMesh, spacing_m: float = 0.025) -> np.ndarray:
    """Return points [N, 3] in metres on all triangles at obstacle height, at most `spacing_m` apart."""
    v = mesh.vertices_m[mesh.triangles].astype(np.float64)
    tall = (v[:, :, 2].max(axis=1) > BODY_M[0]) & (v[:, :, 2].min(axis=1) < BODY_M[1])
    v = v[tall]
    edge = np.linalg.norm(v - np.roll(v, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(edge / spacing_m)).astype(int)
    out = []
    for n in np.unique(steps):
        some = v[steps == n]
        i, j = np.nonzero(np.add.outer(np.arange(n + 1), np.arange(n + 1)) <= n)
        weights = np.stack([i, j, n - i - j], axis=1) / n
        out.append(np.einsum("kc,tcx->tkx", weights, some).reshape(-1, 3))
    return np.concatenate(out)


def _round_trip(distance: np.ndarray) -> list[int]:
    """Return the stop indices in the order of a short closed tour, by 2-opt; `distance` is [S, S]."""
    order = list(range(len(distance)))

    def length(o: list[int]) -> float:
        return float(sum(distance[a][b] for a, b in zip(o, [*o[1:], o[0]])))

    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                other = order[:i] + order[i : j + 1][::-1] + order[j + 1 :]
                if length(other) < length(order) - 1e-9:
                    order, improved = other, True
    return order
