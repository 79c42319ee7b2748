"""CandidateSurfaces an image may show, as the lidar and the floor predict them: candidates, not answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beamsplat.common.geometry.beams import Beams, hidden_beams, plan_polar, plane_depth, wall_ranges
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import yaw_of
from beamsplat.services.fusion.lidar_map import LidarMap
from beamsplat.services.fusion.wall_lines import find_lines, ranges_to_lines

_LAYER_RAYS_PER_PX, _WALL_RAYS_PER_PX = 2, 8
_CONTINUED = 3  # continued walls a ray may meet
_POST_HEIGHT_M = 0.35  # how far from the lidar plane legs and posts are taken to reach


@dataclass(frozen=True)
class CandidateSurfaces:
    """Optical z [h, w] of each candidate surface, NaN where it is not met."""

    wall: np.ndarray  # the nearest beam of the column, extruded upright
    background_wall: (
        np.ndarray
    )  # the same without what is narrow (legs, posts): what stands occluded_walls it
    wall_offset_m: np.ndarray  # how far above or below the lidar plane the pixel meets that wall
    floor: np.ndarray
    occluded_walls: tuple[np.ndarray, ...]  # walls farther back, from the drive so far
    ceilings: tuple[np.ndarray, ...]

    @property
    def nearest(self) -> np.ndarray:
        """What one sees if nothing but these surfaces exists (`stixel`, and ceilings)."""
        with np.errstate(invalid="ignore"):
            high = self.wall_offset_m > _POST_HEIGHT_M
        near = np.fmin(np.where(high, self.background_wall, self.wall), self.floor)
        for ceiling in self.ceilings:
            near = np.fmin(near, ceiling)
        return near

    @property
    def on_floor(self) -> np.ndarray:
        """bool [h, w]: the floor comes before the wall."""
        with np.errstate(invalid="ignore"):
            return np.isfinite(self.floor) & ~(self.wall < self.floor)


class SurfacePredictor:
    """Rays of the working size in the body frame, and the surfaces they meet."""

    def __init__(self, camera: Pinhole, T_body_camera: np.ndarray, *, floor_known: bool) -> None:
        self._T_body_camera = T_body_camera
        self._floor_known = floor_known
        self.rays_body = camera.ray_grid() @ T_body_camera[:3, :3].T
        self._azimuth = np.arctan2(self.rays_body[..., 1], self.rays_body[..., 0])
        self._across = np.maximum(np.hypot(self.rays_body[..., 0], self.rays_body[..., 1]), 1e-9)
        self.rise = np.ascontiguousarray(self.rays_body[..., 2])
        self.camera_z_m = float(T_body_camera[2, 3])
        empty = np.full(self.rise.shape, np.nan)
        self.floor = plane_depth(self.rays_body, self.camera_z_m) if floor_known else empty
        self._fan, self._fan_index = self._fan_of(_LAYER_RAYS_PER_PX * camera.width_px)
        self._wall_fan, self._wall_index = self._fan_of(_WALL_RAYS_PER_PX * camera.width_px)

    def _fan_of(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """(azimuths [count], int64 [h, w]: the one nearest to each pixel's)."""
        low, high = float(self._azimuth.min()), float(self._azimuth.max())
        place = (self._azimuth - low) / max(high - low, 1e-9) * (count - 1)
        index = np.clip(np.rint(place).astype(np.int64), 0, count - 1)
        return np.linspace(low, high, count), index

    def _upright(self, azimuth: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Optical z [h, w] of beams extruded upright: on a fan of rays finer than pixels."""
        return wall_ranges(self._wall_fan, azimuth, reach)[self._wall_index] / self._across

    def _behind(self, ranges: np.ndarray, wall: np.ndarray) -> list[np.ndarray]:
        """Optical z [h, w] of ranges [L, fan] where they lie occluded_walls the wall and before the floor."""
        layers = []
        for layer in ranges[:, self._fan_index] / self._across:
            with np.errstate(invalid="ignore"):
                farther = (layer > 1.08 * wall) & ~(self.floor < layer)
            if farther.any():
                layers.append(np.where(farther, layer, np.nan))
        return layers

    def find(
        self,
        beams: Beams,
        lidar_map: LidarMap | None,
        T_map_body: np.ndarray,
        ceiling_heights_m: tuple[float, ...],
    ) -> CandidateSurfaces:
        """Candidate surfaces of one view; `ceiling_heights_m` are above the floor."""
        points = beams.points_body_m
        points = points[~hidden_beams(points, self._T_body_camera)]
        azimuth, reach = plan_polar(points, self._T_body_camera)
        wall = self._upright(azimuth, reach)
        lidar_z_m = float(np.median(points[:, 2])) if len(points) else 0.0
        off = np.abs(self.camera_z_m + wall * self.rise - lidar_z_m)
        background_wall = self._upright(azimuth, remove_narrow_objects(azimuth, reach))
        occluded_walls: list[np.ndarray] = []
        if lidar_map is not None:
            position = (T_map_body @ self._T_body_camera)[:2, 3]
            ranges = lidar_map.layers(position, self._fan + float(yaw_of(T_map_body)))
            occluded_walls += self._behind(ranges, wall)
            lines = find_lines(lidar_map.points(), lidar_map.cell_m)
            front = wall_ranges(self._fan, azimuth, reach)
            beyond = np.maximum(np.nan_to_num(front, nan=np.inf) * 1.08, front + 0.15)
            met = ranges_to_lines(lines, position, self._fan + float(yaw_of(T_map_body)), beyond, _CONTINUED)
            occluded_walls += self._behind(met, wall)
        ceilings = []
        for height in ceiling_heights_m:
            plane = plane_depth(self.rays_body, self.camera_z_m, height)
            with np.errstate(invalid="ignore"):
                ceilings.append(np.where((self.rise > 0.02) & (plane < background_wall), plane, np.nan))
        return CandidateSurfaces(
            wall, background_wall, off, self.floor, tuple(occluded_walls), tuple(ceilings)
        )


def remove_narrow_objects(
    azimuth_rad: np.ndarray, reach_m: np.ndarray, width_m: float = 0.3, jump: float = 1.15
) -> np.ndarray:
    """Ranges [N] with narrow things replaced by what stands beside them.

    A run of beams no wider than `width_m` whose neighbours on both sides are farther by `jump` is a leg,
    a post, the end of a rail: it seldom reaches the ceiling.
    """
    order = np.argsort(azimuth_rad, kind="stable")
    a, r = azimuth_rad[order], reach_m[order].copy()
    for _ in range(2):  # a post before a post
        cut = np.flatnonzero(np.maximum(r[1:], r[:-1]) > jump * np.minimum(r[1:], r[:-1])) + 1
        starts, stops = np.concatenate([[0], cut]), np.concatenate([cut, [len(r)]])
        out = r.copy()
        for first, stop in zip(starts, stops):
            if first == 0 or stop == len(r):
                continue
            middle = float(np.median(r[first:stop]))
            left, right = r[first - 1], r[stop]
            narrow = (a[stop - 1] - a[first]) * middle < width_m
            if narrow and min(left, right) > jump * middle:
                share = np.linspace(0.0, 1.0, stop - first + 2)[1:-1]
                out[first:stop] = 1.0 / ((1.0 - share) / left + share / right)
        r = out
    result = np.empty_like(r)
    result[order] = r
    return result


class CeilingDetector:
    """Heights of horizontal planes overhead: where they explain images better than the walls occluded_walls.

    Evidence fades by a tenth a keyframe, so that the next room may have another ceiling.
    """

    def __init__(self, low_m: float = 1.6, high_m: float = 4.5, step_m: float = 0.05) -> None:
        self.heights_m = np.arange(low_m, high_m, step_m)
        self._evidence = np.zeros(len(self.heights_m))
        self._apart = round(0.2 / step_m)

    def add(self, gain: np.ndarray) -> None:
        """Evidence [n] of one keyframe."""
        self._evidence = 0.9 * self._evidence + gain

    def heights(self, least: float, most: int = 2) -> tuple[float, ...]:
        """Heights of up to `most` peaks of the evidence above `least`, strongest first, 0.25 m apart."""
        e = self._evidence
        peaks = [k for k in range(1, len(e) - 1) if e[k] > least and e[k] > e[k - 1] and e[k] >= e[k + 1]]
        found: list[int] = []
        for k in sorted(peaks, key=lambda k: -e[k]):
            if len(found) < most and all(abs(k - other) > self._apart for other in found):
                found.append(k)
        step_m = self.heights_m[1] - self.heights_m[0]
        bend = [e[k - 1] - 2.0 * e[k] + e[k + 1] for k in found]
        tops = [0.5 * (e[k - 1] - e[k + 1]) / b if b < 0.0 else 0.0 for k, b in zip(found, bend)]
        return tuple(float(self.heights_m[k] + step_m * top) for k, top in zip(found, tops))
