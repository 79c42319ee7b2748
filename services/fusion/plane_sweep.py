"""`field`: metric depth everywhere, from surfaces that beams and floor predict, past images, and a network.

Neither a network nor extruded beams can be trusted alone. Every candidate only makes its depth cheaper in
a cost volume; past images, seen from poses that the lidar knows to a centimetre, decide per pixel.

`refine_relative_pose` is the step of a keyframe (plane sweep, semi-global matching); `predict` is the step of every
other image: it carries the keyframes' depth over.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.fusion import volume_kernels as kernels
from beamsplat.services.fusion.inputs import (
    FusionInput,
    PlaneSweepConfig,
    SweepResult,
    WorkingImage,
    features,
)
from beamsplat.services.fusion.keyframe_depth import KeyframeDepths, WarpedDepth
from beamsplat.services.fusion.lidar_map import LidarMap
from beamsplat.services.fusion.metric_estimate import MetricEstimate, metric_estimate
from beamsplat.services.fusion.relative_pose import detect_corners, refine_from_images
from beamsplat.services.fusion.surfaces import CandidateSurfaces, CeilingDetector, SurfacePredictor

_TILTED_WALL_M = 0.05  # a lidar in the hand: walls are not upright in its frame


class PlaneSweep:
    """State of a drive: past images, the lidar's map, keyframe depth, ceilings."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, *, floor_known: bool, planar: bool,
        config: PlaneSweepConfig | None = None,
    ) -> None:  # fmt: skip
        if camera.is_distorted:
            raise ValueError("fusion works on undistorted images: pass Pinhole.undistorted()")
        self.config = config or (PlaneSweepConfig() if planar else PlaneSweepConfig.in_hand())
        self.camera = camera
        self.T_body_camera = T_body_camera
        width = self.config.width_px
        height = round(camera.height_px * width / camera.width_px)
        self.small_camera = camera.resized(width, height)
        self._middle_camera = camera.resized(2 * width, 2 * height)
        c = self.small_camera
        self._K = np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px], dtype=np.float32)
        self._finder = SurfacePredictor(c, T_body_camera, floor_known=floor_known)
        self._floor_known = floor_known
        self._ceilings = CeilingDetector()
        self._planar = planar
        self._lidar_map = LidarMap() if planar else None
        self._memory = KeyframeDepths(self._K, c.shape, self.config.memory_keyframes)
        self._past: deque[WorkingImage] = deque(maxlen=240)
        self._log_z = np.linspace(
            np.log(self.config.z_near_m), np.log(self.config.z_far_m), self.config.labels
        )
        limit = np.where(np.isfinite(self._finder.floor), self._finder.floor * 1.08, np.inf)
        self._z_last = np.maximum(limit, 1.1 * self.config.z_near_m).astype(np.float32)

    def add_scan(self, points_map_m: np.ndarray) -> None:
        """Returns [N, 3] of a scan in the map frame, for walls occluded_walls walls."""
        if self._lidar_map is not None:
            self._lidar_map.add(points_map_m)

    def downscale(self, frame: FusionInput) -> WorkingImage:
        """The image at the working size."""
        grey = cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)
        h, w = self.small_camera.shape
        middle = cv2.resize(grey, (2 * w, 2 * h), interpolation=cv2.INTER_AREA)
        small = cv2.resize(middle, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32)
        return WorkingImage(frame.T_map_body @ self.T_body_camera, small, features(small), middle)

    def keep_if_moved(self, frame: FusionInput) -> None:
        """Remembers an image for later sweeps, unless the camera stands where the last one was taken."""
        if self._is_new(frame.T_map_body @ self.T_body_camera):
            self._past.append(self.downscale(frame))

    def keep(self, small: WorkingImage) -> None:
        """`keep_if_moved` of an image that is small already."""
        if self._is_new(small.T_map_camera):
            self._past.append(small)

    def _is_new(self, T_map_camera: np.ndarray) -> bool:
        if not self._past:
            return True
        T = inverse(self._past[-1].T_map_camera) @ T_map_camera
        return bool(np.linalg.norm(T[:3, 3]) >= 0.03 or np.trace(T[:3, :3]) <= 1.0 + 2.0 * np.cos(0.05))

    def surfaces(self, frame: FusionInput, *, occluded_walls: bool = True) -> CandidateSurfaces:
        """Candidate surfaces; without `occluded_walls` those in front only, which cost less."""
        heights = self._ceilings.heights(self.config.ceiling_evidence) if self._floor_known else ()
        lidar_map = self._lidar_map if occluded_walls else None
        return self._finder.find(frame.beams, lidar_map, frame.T_map_body, heights)

    def warp_into(self, small: WorkingImage) -> WarpedDepth:
        return self._memory.warp_into(small.T_map_camera)

    def refine(
        self, frame: FusionInput, small: WorkingImage, remembered: WarpedDepth | None = None
    ) -> SweepResult:
        """Depth of a keyframe: sweep over past images, candidates as priors, semi-global matching.

        `remembered` is what `warp_into` gives for it, where that is known already.
        """
        cost, views = self._sweep(frame, small)
        if self._floor_known and views:
            surfaces = self._finder.find(frame.beams, None, frame.T_map_body, ())
            self._find_ceilings(cost, surfaces.background_wall)
        surfaces = self.surfaces(frame)
        np.minimum(cost, self.config.cost_cap, out=cost)
        remembered = remembered or self.warp_into(small)
        self._add_priors(cost, frame, surfaces, remembered if len(self._memory) else None)
        solved = self._solve(cost, small, surfaces, views)
        sure = solved.spread < self.config.memory_spread
        self._memory.add(small.T_map_camera, np.where(sure, solved.depth_m, np.nan))
        return self._outvote(solved, self.warp_into(small)) if self.config.outvote else solved

    def _outvote(self, solved: SweepResult, remembered: WarpedDepth) -> SweepResult:
        """Where several keyframes agree on another depth than this sweep alone, theirs counts.

        Not on a floor: there all keyframes take their depth from the same walls where images tell
        little, and their agreement is no evidence.
        """
        others = (remembered.votes >= self.config.outvote) & ~solved.snapped
        depth, spread = solved.depth_m.copy(), solved.spread.copy()
        depth[others] = remembered.depth_m[others]
        spread[others] = np.minimum(spread[others], 0.02)
        return SweepResult(depth, spread, solved.snapped & ~others, solved.views)

    def choose_views(self, T_map_camera: np.ndarray) -> list[WorkingImage]:
        """Past images whose baselines come nearest to the wished ones, facing the same way."""
        if not self._past:
            return []
        past = list(self._past)
        T = np.array([p.T_map_camera for p in past])
        distance = np.linalg.norm(T[:, :3, 3] - T_map_camera[:3, 3], axis=1)
        turn_cos = (np.einsum("nij,ij->n", T[:, :3, :3], T_map_camera[:3, :3]) - 1.0) / 2.0
        free = (turn_cos > np.cos(self.config.max_turn_rad)) & (distance > 0.04)
        age = np.arange(len(past))[::-1] * 1e-4
        chosen = []
        for wished in self.config.baselines_m:
            score = np.where(free, np.abs(distance - wished) + age, np.inf)
            k = int(np.argmin(score))
            if score[k] < 0.5 * wished:
                chosen.append(past[k])
                free[k] = False
        return chosen

    def _sweep(self, frame: FusionInput, small: WorkingImage) -> tuple[np.ndarray, int]:
        """(costs float32 [h, w, D], number of views)."""
        h, w = self.small_camera.shape
        views = self.choose_views(small.T_map_camera)
        if not views:
            return np.full((h, w, self.config.labels), 0.5 * self.config.cost_scale, np.float32), 0
        uv = detect_corners(small.middle)
        initial_depth_m = (
            float(np.median(np.linalg.norm(frame.beams.points_body_m, axis=1))) if len(frame.beams) else 2.5
        )
        T = [
            refine_from_images(
                inverse(view.T_map_camera) @ small.T_map_camera, small.middle, view.middle, uv,
                self._middle_camera, initial_depth_m, self.config.rotation_sigma_rad,
                self.config.translation_sigma_m,
            )
            for view in views
        ]  # fmt: skip
        raw = np.empty((h, w, self.config.labels), np.float32)
        kernels.cost_volume(
            small.features, np.stack([view.features for view in views]),
            np.array([t[:3, :3] for t in T], np.float32), np.array([t[:3, 3] for t in T], np.float32),
            self._K, np.exp(self._log_z).astype(np.float32), self._z_last, 1.0, raw,
        )  # fmt: skip
        cost = np.empty_like(raw)
        kernels.box3(raw, self.config.cost_scale, cost)
        return cost, len(views)

    def _find_ceilings(self, cost: np.ndarray, wall: np.ndarray) -> None:
        gain = np.zeros(len(self._ceilings.heights_m))
        step = self._log_z[1] - self._log_z[0]
        kernels.plane_gain(
            cost, self._finder.rise, wall, self._finder.camera_z_m, self._log_z[0], step,
            self._ceilings.heights_m, gain,
        )  # fmt: skip
        self._ceilings.add(gain)

    def _add_priors(
        self,
        cost: np.ndarray,
        frame: FusionInput,
        surfaces: CandidateSurfaces,
        remembered: WarpedDepth | None,
    ) -> None:
        c = self.config
        on_floor = surfaces.on_floor
        near = np.exp(-np.nan_to_num(surfaces.wall_offset_m) / c.wall_reach_m)
        self._dig(
            cost,
            np.where(on_floor, np.nan, surfaces.wall),
            c.wall_near * near,
        )
        if self._planar:
            self._dig(cost, np.where(on_floor, np.nan, surfaces.background_wall), c.wall_far)
        self._dig(cost, np.where(on_floor, surfaces.floor, np.nan), c.floor)
        for layer in surfaces.occluded_walls:
            self._dig(cost, layer, c.occluded_walls)
        for ceiling in surfaces.ceilings:
            self._dig(cost, ceiling, c.ceiling)
        if remembered is not None:
            self._dig(cost, remembered.depth_m, c.memory * np.minimum(remembered.votes, 3) / 3.0)
        estimate = self.metric_estimate_of(frame)
        if estimate is not None:
            trust = float(np.exp(-((estimate.spread / c.estimate_spread) ** 2)))
            h, w = self.small_camera.shape
            self._dig(cost, estimate.at_size(w, h), c.estimate * trust, width=4.0)
        unlikely = c.near * np.maximum(np.log(c.near_m) - self._log_z, 0.0)
        cost += unlikely.astype(np.float32)

    def metric_estimate_of(self, frame: FusionInput) -> MetricEstimate | None:
        """The network's estimate in metres, or None."""
        if frame.estimate is None or frame.estimate_kind == "none":
            return None
        uv, z, _ = project_beams(frame.beams, self.camera, self.T_body_camera)
        return metric_estimate(frame.estimate, frame.estimate_kind, uv, z)

    def _dig(self, cost: np.ndarray, z: np.ndarray, weight: np.ndarray | float, width: float = 1.0) -> None:
        step = self._log_z[1] - self._log_z[0]
        weights = np.broadcast_to(np.asarray(weight, np.float32), z.shape)
        z32 = np.asarray(z, dtype=np.float32)
        kernels.add_prior(cost, z32, np.ascontiguousarray(weights), self._log_z[0], step, width)

    def _solve(
        self, cost: np.ndarray, small: WorkingImage, surfaces: CandidateSurfaces, views: int
    ) -> SweepResult:
        c = self.config
        total = np.zeros_like(cost)
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            kernels.aggregate(cost, small.grey, dv, du, c.p1, c.p2, c.edge_grey, total)
        depth = np.empty(cost.shape[:2], np.float32)
        spread = np.empty_like(depth)
        kernels.winner_takes_all(total, self._log_z, c.temperature, depth, spread)
        reach_m = np.inf if self._planar else _TILTED_WALL_M
        snapped = snap(depth, surfaces, 1.2 * (self._log_z[1] - self._log_z[0]), reach_m)
        return SweepResult(depth, spread, snapped, views)


def snap(depth: np.ndarray, surfaces: CandidateSurfaces, tolerance: float, wall_reach_m: float) -> np.ndarray:
    """Moves depth [h, w], in place, onto the nearest surface within `tolerance` (log); bool [h, w] where.

    Walls count up to `wall_reach_m` from the lidar plane.
    """
    wall = np.where(surfaces.on_floor | ~(surfaces.wall_offset_m < wall_reach_m), np.nan, surfaces.wall)
    best = np.full(depth.shape, tolerance)
    result = depth.copy()
    background_wall = (
        np.where(surfaces.on_floor, np.nan, surfaces.background_wall) if np.isinf(wall_reach_m) else wall
    )
    for surface in (wall, background_wall, surfaces.floor, *surfaces.occluded_walls, *surfaces.ceilings):
        with np.errstate(invalid="ignore"):
            error = np.abs(np.log(surface / depth))
            nearer = error < best
        result[nearer] = surface[nearer]
        best = np.where(nearer, error, best)
    depth[:] = result
    return best < tolerance
