"""Method `field`: dense metric depth by a multi-view plane sweep with priors from lidar, floor and a network.

Candidate surfaces (extruded beams, floor, walls from the lidar map, ceilings), the warped depth of past
keyframes and the depth estimate are priors: each lowers the matching cost at its depth in the cost volume.
The images themselves decide per pixel, by matching with past images whose poses are accurate to about 1 cm
from lidar localization (plane sweep: Collins 1996; aggregation: semi-global matching, Hirschmueller 2008).
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np

from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse
from beamsplat.services.fusion import volume_kernels as kernels
from beamsplat.services.fusion.aggregation import Aggregation, SemiGlobalMatching, SweepEvidence
from beamsplat.services.fusion.inputs import (
    FusionInput,
    KeyframeTask,
    PlaneSweepConfig,
    SweepResult,
    WorkingImage,
    features,
)
from beamsplat.services.fusion.keyframe_depth import KeyframeDepths, WarpedDepth
from beamsplat.services.fusion.learned_kernels import quantised_cost
from beamsplat.services.fusion.lidar_map import LidarMap
from beamsplat.services.fusion.metric_estimate import MetricEstimate, metric_estimate
from beamsplat.services.fusion.relative_pose import detect_corners, refine_from_images
from beamsplat.services.fusion.surfaces import CandidateSurfaces, CeilingDetector, SurfacePredictor, snap

_TILTED_WALL_M = 0.05  # snapping distance to extruded beams of a hand-held lidar: its walls are tilted


class PlaneSweep:
    """Plane sweep over the images of a drive; stores past images, lidar map, keyframe depth, ceilings."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, *, floor_known: bool, planar: bool,
        config: PlaneSweepConfig | None = None, aggregation: Aggregation | None = None,
    ) -> None:  # fmt: skip
        """Prepare the sweep for one camera.

        Args:
            camera: pinhole of the full-size images, without distortion.
            T_body_camera: float64 [4, 4].
            floor_known: the camera height in `T_body_camera` is reliable.
            planar: the body stays level on a floor.
            config: None = the defaults if `planar`, else `PlaneSweepConfig.in_hand()`, with the number of
                labels that `aggregation` requires.
            aggregation: None = semi-global matching.

        Raises:
            ValueError: `camera` has distortion, or `aggregation` requires another number of labels.
        """
        if camera.is_distorted:
            raise ValueError("fusion needs undistorted images: pass Pinhole.undistorted()")
        self.aggregation: Aggregation = aggregation or SemiGlobalMatching()
        labels = self.aggregation.labels
        if config is None:
            config = PlaneSweepConfig() if planar else PlaneSweepConfig.in_hand()
            config = config if labels is None else replace(config, labels=labels)
        if labels not in (None, config.labels):
            raise ValueError(f"the aggregation requires {labels} labels, not {config.labels}")
        self.config = config
        self.camera = camera
        self.T_body_camera = T_body_camera
        width = self.config.width_px
        height = round(camera.height_px * width / camera.width_px)
        self.working_camera = camera.resized(width, height)
        self._camera_2x = camera.resized(2 * width, 2 * height)
        c = self.working_camera
        self._K = np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px], dtype=np.float32)
        self._predictor = SurfacePredictor(c, T_body_camera, floor_known=floor_known)
        self._floor_known = floor_known
        self._ceilings = CeilingDetector()
        self._planar = planar
        self._lidar_map = LidarMap() if planar else None
        self._keyframe_depths = KeyframeDepths(self._K, c.shape, self.config.keyframes_kept)
        self._source_images: deque[WorkingImage] = deque(maxlen=240)
        self._deferred_scans: list[np.ndarray] | None = None  # while a sweep reads the lidar map
        self._log_z = np.linspace(
            np.log(self.config.z_near_m), np.log(self.config.z_far_m), self.config.labels
        )
        limit = np.where(np.isfinite(self._predictor.floor), self._predictor.floor * 1.08, np.inf)
        self._z_last = np.maximum(limit, 1.1 * self.config.z_near_m).astype(np.float32)
        self._rise = self._predictor.ray_z if planar else np.zeros_like(self._predictor.ray_z)

    def add_scan(self, points_map_m: np.ndarray) -> None:
        """Add the returns float64 [N, 3] of a scan, in the map frame, to the lidar map (only if `planar`)."""
        if self._lidar_map is None:
            return
        if self._deferred_scans is not None:
            self._deferred_scans.append(points_map_m)
        else:
            self._lidar_map.add(points_map_m)

    def downscale(self, frame: FusionInput) -> WorkingImage:
        """Return the image of `frame` at the working size, with its features and camera pose."""
        grey = cv2.cvtColor(frame.image_rgb, cv2.COLOR_RGB2GRAY)
        h, w = self.working_camera.shape
        middle = cv2.resize(grey, (2 * w, 2 * h), interpolation=cv2.INTER_AREA)
        working = cv2.resize(middle, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32)
        return WorkingImage(frame.T_map_body @ self.T_body_camera, working, features(working), middle)

    def keep_if_moved(self, frame: FusionInput) -> None:
        """Store the image of `frame` for later sweeps if the camera moved >= 3 cm or rotated >= 0.05 rad."""
        if self._has_moved(frame.T_map_body @ self.T_body_camera):
            self._source_images.append(self.downscale(frame))

    def keep(self, working: WorkingImage) -> None:
        """Store an image made by `downscale` for later sweeps; same condition as in `keep_if_moved`."""
        if self._has_moved(working.T_map_camera):
            self._source_images.append(working)

    def _has_moved(self, T_map_camera: np.ndarray) -> bool:
        if not self._source_images:
            return True
        T = inverse(self._source_images[-1].T_map_camera) @ T_map_camera
        return bool(np.linalg.norm(T[:3, 3]) >= 0.03 or np.trace(T[:3, :3]) <= 1.0 + 2.0 * np.cos(0.05))

    def surfaces_between_keyframes(self, frame: FusionInput) -> CandidateSurfaces:
        """Return the candidate surfaces of a frame, without walls that others hide (fast)."""
        return self._surfaces(frame, None, self._ceilings)

    def _surfaces(
        self, frame: FusionInput, lidar_map: LidarMap | None, ceilings: CeilingDetector
    ) -> CandidateSurfaces:
        heights = ceilings.heights(self.config.ceiling_evidence) if self._floor_known else ()
        return self._predictor.find(frame.beams, lidar_map, frame.T_map_body, heights)

    def warp_into(self, working: WorkingImage) -> WarpedDepth:
        """Return the depth of past keyframes, warped into the view of `working`."""
        return self._keyframe_depths.warp_into(working.T_map_camera)

    @property
    def keyframe_depths(self) -> KeyframeDepths:
        """Return the depth of the past keyframes; another object after each `commit`."""
        return self._keyframe_depths

    def prepare(
        self, frame: FusionInput, working: WorkingImage, views: list[WorkingImage], warped: WarpedDepth | None
    ) -> KeyframeTask:
        """Return the task for `sweep`. Until `commit`, no other task may be prepared.

        Args:
            views: source images, from `choose_views`.
            warped: the result of `warp_into(working)` if no keyframe was committed since; None = compute it.
        """
        self._deferred_scans = []
        return KeyframeTask(
            frame, working, views, warped, self._keyframe_depths.copy(), self._ceilings.copy()
        )

    def sweep(self, task: KeyframeTask) -> tuple[SweepResult, CandidateSurfaces]:
        """Return the depth of a keyframe at the working size, and its candidate surfaces.

        Changes only `task`. It may run in another thread while this object is used for other images.
        """
        frame, working = task.frame, task.working
        # Matching cost against past images, float32 [h, w, D].
        cost = self._cost_volume(frame, working, task.views)
        if self._floor_known and task.views:
            surfaces = self._predictor.find(frame.beams, None, frame.T_map_body, ())
            self._find_ceilings(cost, surfaces.background_wall, task.ceilings)
        # Candidate surfaces as priors.
        surfaces = self._surfaces(frame, self._lidar_map, task.ceilings)
        matching_cost = quantised_cost(cost) if self.aggregation.uses_matching_cost else None
        np.minimum(cost, self.config.cost_cap, out=cost)
        warped = task.warped or task.depths.warp_into(working.T_map_camera)
        known = warped if len(task.depths) else None
        estimate = self.metric_estimate_of(frame)
        self._add_priors(cost, estimate, surfaces, known)
        # Aggregation: depth per pixel.
        h, w = self.working_camera.shape
        evidence = SweepEvidence(
            cost, matching_cost, self._log_z, working, frame.image_rgb, surfaces, known,
            None if estimate is None else estimate.at_size(w, h), self._trust(estimate), self._rise,
            len(task.views),
        )  # fmt: skip
        swept = self._solve(evidence)
        certain = swept.spread < self.config.keyframe_max_spread
        task.depths.add(working.T_map_camera, np.where(certain, swept.depth_m, np.nan))
        if self.config.min_override_votes:
            swept = self._override_by_votes(swept, task.depths.warp_into(working.T_map_camera))
        return swept, surfaces

    def commit(self, task: KeyframeTask) -> None:
        """Use the depth and the ceilings of a swept keyframe for later images."""
        self._keyframe_depths, self._ceilings = task.depths, task.ceilings
        scans, self._deferred_scans = self._deferred_scans or [], None
        for points_map_m in scans:
            self.add_scan(points_map_m)

    def _override_by_votes(self, swept: SweepResult, warped: WarpedDepth) -> SweepResult:
        """Return the sweep result, with depth replaced where >= `min_override_votes` keyframes disagree.

        Used for hand-held sensors only. On a level body, all keyframes take the depth of untextured pixels
        from the same extruded walls, so the agreement of keyframes is no evidence.
        """
        others = (warped.votes >= self.config.min_override_votes) & ~swept.snapped
        depth, spread = swept.depth_m.copy(), swept.spread.copy()
        depth[others] = warped.depth_m[others]
        spread[others] = np.minimum(spread[others], 0.02)
        return SweepResult(depth, spread, swept.snapped & ~others, swept.views)

    def choose_views(self, T_map_camera: np.ndarray) -> list[WorkingImage]:
        """Return past images of similar viewing direction with baselines nearest to `baselines_m`."""
        if not self._source_images:
            return []
        past = list(self._source_images)
        T = np.array([p.T_map_camera for p in past])
        distance = np.linalg.norm(T[:, :3, 3] - T_map_camera[:3, 3], axis=1)
        turn_cos = (np.einsum("nij,ij->n", T[:, :3, :3], T_map_camera[:3, :3]) - 1.0) / 2.0
        usable = (turn_cos > np.cos(self.config.max_turn_rad)) & (distance > 0.04)
        age = np.arange(len(past))[::-1] * 1e-4
        chosen = []
        for preferred_m in self.config.baselines_m:
            score = np.where(usable, np.abs(distance - preferred_m) + age, np.inf)
            k = int(np.argmin(score))
            if score[k] < 0.5 * preferred_m:
                chosen.append(past[k])
                usable[k] = False
        return chosen

    def _cost_volume(
        self, frame: FusionInput, working: WorkingImage, views: list[WorkingImage]
    ) -> np.ndarray:
        """Return the matching cost against the source images `views`, float32 [h, w, D] (D depth labels)."""
        h, w = self.working_camera.shape
        if not views:
            return np.full((h, w, self.config.labels), 0.5 * self.config.cost_scale, np.float32)
        uv = detect_corners(working.grey_2x)
        initial_depth_m = (
            float(np.median(np.linalg.norm(frame.beams.points_body_m, axis=1))) if len(frame.beams) else 2.5
        )
        T = [
            refine_from_images(
                inverse(view.T_map_camera) @ working.T_map_camera, working.grey_2x, view.grey_2x, uv,
                self._camera_2x, initial_depth_m, self.config.rotation_sigma_rad,
                self.config.translation_sigma_m,
            )
            for view in views
        ]  # fmt: skip
        raw = np.empty((h, w, self.config.labels), np.float32)
        kernels.cost_volume(
            working.features, np.stack([view.features for view in views]),
            np.array([t[:3, :3] for t in T], np.float32), np.array([t[:3, 3] for t in T], np.float32),
            self._K, np.exp(self._log_z).astype(np.float32), self._z_last, 1.0, raw,
        )  # fmt: skip
        cost = np.empty_like(raw)
        kernels.box3(raw, self.config.cost_scale, cost)
        return cost

    def _find_ceilings(self, cost: np.ndarray, wall: np.ndarray, ceilings: CeilingDetector) -> None:
        gain = np.zeros(len(ceilings.heights_m))
        step = self._log_z[1] - self._log_z[0]
        kernels.plane_gain(
            cost, self._predictor.ray_z, wall, self._predictor.camera_z_m, self._log_z[0], step,
            ceilings.heights_m, gain,
        )  # fmt: skip
        ceilings.add(gain)

    def _add_priors(
        self,
        cost: np.ndarray,
        estimate: MetricEstimate | None,
        surfaces: CandidateSurfaces,
        warped: WarpedDepth | None,
    ) -> None:
        c = self.config
        on_floor = surfaces.on_floor
        near = np.exp(-np.nan_to_num(surfaces.wall_offset_m) / c.wall_reach_m)
        self._add_prior(
            cost,
            np.where(on_floor, np.nan, surfaces.wall),
            c.wall_near * near,
        )
        if self._planar:
            self._add_prior(cost, np.where(on_floor, np.nan, surfaces.background_wall), c.wall_far)
        self._add_prior(cost, np.where(on_floor, surfaces.floor, np.nan), c.floor)
        for layer in surfaces.occluded_walls:
            self._add_prior(cost, layer, c.occluded_walls)
        for ceiling in surfaces.ceilings:
            self._add_prior(cost, ceiling, c.ceiling)
        if warped is not None:
            self._add_prior(cost, warped.depth_m, c.keyframe_depth * np.minimum(warped.votes, 3) / 3.0)
        if estimate is not None:
            h, w = self.working_camera.shape
            self._add_prior(cost, estimate.at_size(w, h), c.estimate * self._trust(estimate), width=4.0)
        unlikely = c.near * np.maximum(np.log(c.near_m) - self._log_z, 0.0)
        cost += unlikely.astype(np.float32)

    def _trust(self, estimate: MetricEstimate | None) -> float:
        """Return the weight of the depth source's estimate in [0, 1], by its agreement with the beams."""
        if estimate is None:
            return 0.0
        return float(np.exp(-((estimate.spread / self.config.estimate_spread) ** 2)))

    def metric_estimate_of(self, frame: FusionInput) -> MetricEstimate | None:
        """Return the depth estimate scaled to metres by the beams; None without estimate or beams."""
        if frame.estimate is None or frame.estimate_kind == "none":
            return None
        uv, z, _ = project_beams(frame.beams, self.camera, self.T_body_camera)
        return metric_estimate(frame.estimate, frame.estimate_kind, uv, z)

    def _add_prior(
        self, cost: np.ndarray, z: np.ndarray, weight: np.ndarray | float, width: float = 1.0
    ) -> None:
        step = self._log_z[1] - self._log_z[0]
        weights = np.broadcast_to(np.asarray(weight, np.float32), z.shape)
        z32 = np.asarray(z, dtype=np.float32)
        kernels.add_prior(cost, z32, np.ascontiguousarray(weights), self._log_z[0], step, width)

    def _solve(self, evidence: SweepEvidence) -> SweepResult:
        depth, spread = self.aggregation.solve(evidence, self.config)
        wall_reach_m = np.inf if self._planar else _TILTED_WALL_M
        tolerance = 1.2 * (self._log_z[1] - self._log_z[0])
        snapped = snap(depth, evidence.surfaces, tolerance, wall_reach_m)
        return SweepResult(depth, spread, snapped, evidence.views)
