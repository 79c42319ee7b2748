"""The stage as the robot runs it: image, pose, beams, estimate in; metric depth with sigma, status out."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from beamsplat.common.geometry.beams import NO_BEAMS, project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.fusion import upsample
from beamsplat.services.fusion.input_checks import ImageCheck, check_beams
from beamsplat.services.fusion.inputs import FusionInput, PlaneSweepConfig, SweepResult
from beamsplat.services.fusion.keyframe_depth import WarpedDepth
from beamsplat.services.fusion.pairs import largest_cluster
from beamsplat.services.fusion.plane_sweep import PlaneSweep
from beamsplat.services.fusion.result import FusionResult, rejected
from beamsplat.services.fusion.scaling import ScaleFit, as_depth, fit_scale
from beamsplat.services.fusion.surfaces import CandidateSurfaces

# Standard deviations of log depth, measured on both recordings by what a pixel's depth rests on.
_BEAM, _FLOOR, _SURFACE = 0.002, 0.004, 0.010
_BETWEEN_BEAMS_M = 0.007  # the mean of two beams of 1 cm each
_CARRIED = (0.10, 0.06, 0.045)  # depth remembered from one, two, three and more keyframes
_UPRIGHT, _TILTING = 0.125, 0.13  # extruded walls that nothing confirms: body on a floor, body in the hand
_BEAM_HEIGHT_M = 0.06
_SAME_SURFACE = 0.08
_EDGE = 0.4  # of the jump next to a pixel: which side it lies on is a estimate
_EDGE_REACH = (3, 5)  # rows, columns of the working size
_TELL_ABOUT_PX = 3.0  # of the working size: a pixel amid doubtful ones is as doubtful
_CONTRADICTION = 0.25  # log: a beam that far from remembered depth contradicts it
_LEAST_KNOWN = 20
_LEAST_INLIERS = 0.3


class Fusion:
    """Depth of every image by `field`; keyframes are swept, others get the keyframes' depth."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, *, floor_known: bool, planar: bool,
        config: PlaneSweepConfig | None = None,
    ) -> None:  # fmt: skip
        """`floor_known`: the height of `T_body_camera` holds; `planar`: the body stays level on a floor."""
        self._sweep = PlaneSweep(camera, T_body_camera, floor_known=floor_known, planar=planar, config=config)
        self._planar = planar
        self._health = ImageCheck()

    def add_scan(self, points_map_m: np.ndarray) -> None:
        """Returns [N, 3] of every scan, in the map frame."""
        self._sweep.add_scan(points_map_m)

    def fuse(self, frame: FusionInput, *, keyframe: bool) -> FusionResult:
        """Depth of one image. A keyframe costs several times more, and later images live on it."""
        shape = self._sweep.camera.shape
        status = self._health.judge(frame.image_rgb, frame.T_map_body)
        if status != "ok":
            return rejected(shape, status)
        uv, z, _ = project_beams(frame.beams, self._sweep.camera, self._sweep.T_body_camera)
        small = self._sweep.downscale(frame)
        remembered = self._sweep.warp_into(small)
        status = check_beams(len(uv), self._contradicted(remembered.depth_m, uv, z))
        if status != "ok":
            return rejected(shape, status)
        if keyframe:
            solved = self._sweep.refine(frame, small, remembered)
            surfaces = self._sweep.surfaces(frame)
            sigma_log = self._sigma_swept(solved, surfaces)
            self._pin_to_beams(solved, sigma_log, surfaces)
        else:
            solved = self._carried(frame, remembered, self._sweep.surfaces(frame, occluded_walls=False))
            sigma_log = solved.spread
        self._sweep.keep(small)
        return self._finish(frame, solved, sigma_log, uv, z)

    def look(self, image_rgb: np.ndarray, T_map_body: np.ndarray) -> None:
        """Takes an image in for later sweeps, without making depth of it."""
        frame = FusionInput(0, image_rgb, T_map_body, NO_BEAMS)
        if self._health.judge(image_rgb, T_map_body) == "ok":
            self._sweep.keep_if_moved(frame)

    def _carried(
        self, frame: FusionInput, remembered: WarpedDepth, surfaces: CandidateSurfaces
    ) -> SweepResult:
        """Keyframe depth where there is any, else the surfaces, else the estimate; `spread` is sigma of log."""
        depth = surfaces.nearest.astype(np.float32)
        upright = _UPRIGHT if self._planar else _TILTING
        spread = np.full(depth.shape, upright, dtype=np.float32)
        spread[surfaces.on_floor] = _FLOOR * 3.0
        h, w = depth.shape
        estimate = self._sweep.metric_estimate_of(frame)
        if estimate is not None:
            estimated = estimate.at_size(w, h)
            error = 2.0 * estimate.spread + 0.02
            take = np.isfinite(estimated) & (~np.isfinite(depth) | (spread > error))
            depth[take], spread[take] = estimated[take], error
        known = remembered.votes > 0
        depth[known] = remembered.depth_m[known]
        spread[known] = np.array(_CARRIED, np.float32)[np.minimum(remembered.votes[known], 3) - 1]
        with np.errstate(invalid="ignore"):
            at_beam = (surfaces.wall_offset_m < _BEAM_HEIGHT_M) & ~surfaces.on_floor
            exact = np.abs(np.log(surfaces.floor / depth)) < 0.03
        depth[at_beam] = surfaces.wall[at_beam]
        spread[at_beam] = _BEAM + _BETWEEN_BEAMS_M / depth[at_beam]
        depth[exact], spread[exact] = surfaces.floor[exact], _FLOOR
        return SweepResult(depth, spread, at_beam | exact, 0)

    def _contradicted(self, remembered: np.ndarray, uv: np.ndarray, z: np.ndarray) -> float | None:
        """Share of beams far from what keyframes remember there; None while they remember little."""
        if len(z) == 0:
            return None
        h, w = remembered.shape
        v = np.clip(((uv[:, 1] + 0.5) * h / self._sweep.camera.height_px).astype(int), 0, h - 1)
        u = np.clip(((uv[:, 0] + 0.5) * w / self._sweep.camera.width_px).astype(int), 0, w - 1)
        then = remembered[v, u]
        known = np.isfinite(then)
        if known.sum() < _LEAST_KNOWN:
            return None
        return float(np.mean(np.abs(np.log(z[known] / then[known])) > _CONTRADICTION))

    def _sigma_swept(self, solved: SweepResult, surfaces: CandidateSurfaces) -> np.ndarray:
        """Standard deviation of log depth [h, w]: by what the depth rests on, and the matcher's own doubt."""
        with np.errstate(invalid="ignore"):
            floor = solved.snapped & (np.abs(np.log(surfaces.floor / solved.depth_m)) < 0.01)
            beam = solved.snapped & (surfaces.wall_offset_m < _BEAM_HEIGHT_M)
        config = self._sweep.config
        base = np.where(solved.snapped, _SURFACE, config.matched)
        base = np.where(floor, _FLOOR, np.where(beam, _BEAM + _BETWEEN_BEAMS_M / solved.depth_m, base))
        doubt = np.where(floor | beam, 0.0, config.per_spread * solved.spread)
        return np.hypot(base, doubt).astype(np.float32)

    def _pin_to_beams(self, solved: SweepResult, sigma_log: np.ndarray, surfaces: CandidateSurfaces) -> None:
        """On the scan line itself the beams are right, whatever matches; changes both arrays."""
        pinned = (surfaces.wall_offset_m < 0.5 * _BEAM_HEIGHT_M) & ~surfaces.on_floor
        solved.depth_m[pinned] = surfaces.wall[pinned]
        sigma_log[pinned] = _BEAM + _BETWEEN_BEAMS_M / solved.depth_m[pinned]

    def _doubt_edges(self, depth: np.ndarray, sigma_log: np.ndarray) -> np.ndarray:
        """Sigma of log depth with a share of the jumps nearby; thin gaps between beams end anywhere."""
        known = np.isfinite(depth)
        middle = float(np.median(depth[known])) if known.any() else 1.0
        log_z = np.log(np.where(known, depth, middle)).astype(np.float32)
        window = np.ones(_EDGE_REACH, np.uint8)
        jump = cv2.dilate(log_z, window) - cv2.erode(log_z, window)
        return np.hypot(sigma_log, np.where(jump > _SAME_SURFACE, _EDGE * jump, 0.0)).astype(np.float32)

    def _sure(self, depth: np.ndarray, sigma_log: np.ndarray) -> np.ndarray:
        """bool [h, w]: pixels that get an answer."""
        config = self._sweep.config
        sure = sigma_log <= config.tell_log
        if np.isfinite(config.tell_m):
            far = 3.0 * config.tell_m
            doubt = np.where(np.isfinite(depth), np.minimum(sigma_log * depth, far), far).astype(np.float32)
            sure &= cv2.GaussianBlur(doubt, (0, 0), _TELL_ABOUT_PX) <= config.tell_m
        return sure

    def _finish(
        self, frame: FusionInput, solved: SweepResult, sigma_log: np.ndarray, uv: np.ndarray, z: np.ndarray
    ) -> FusionResult:
        """Full size, and the figures that go with every result."""
        h, w = self._sweep.small_camera.shape
        depth = np.empty(self._sweep.camera.shape, np.float32)
        sigma = np.empty_like(depth)
        sigma_log = self._doubt_edges(solved.depth_m, sigma_log)
        known = np.where(self._sure(solved.depth_m, sigma_log), solved.depth_m, np.nan).astype(np.float32)
        colour = cv2.resize(frame.image_rgb, (w, h), interpolation=cv2.INTER_AREA)
        upsample.upsample_depth(known, sigma_log, colour, frame.image_rgb, _SAME_SURFACE, depth, sigma)
        H, W = depth.shape
        v = np.clip(np.rint(uv[:, 1]).astype(int), 0, H - 1)
        u = np.clip(np.rint(uv[:, 0]).astype(int), 0, W - 1)
        here = depth[v, u].astype(np.float64)
        good = np.isfinite(here)
        log_ratio = np.log(z[good] / here[good])
        inlier = largest_cluster(log_ratio, 0.02)
        result = FusionResult(
            depth, sigma, inlier_share=float(inlier.mean()) if len(inlier) else 0.0, pairs=int(good.sum()),
            residual_m=float(np.median(np.abs(z[good] - here[good]))) if good.any() else float("nan"),
        )  # fmt: skip
        if result.inlier_share < _LEAST_INLIERS:
            return result.refused(
                f"only {result.inlier_share:.0%} of the beams fit the depth found: wrong pose or calibration"
            )
        scale = None
        if frame.estimate is not None and frame.estimate_kind != "none":
            scale = fit_scale(as_depth(frame.estimate, frame.estimate_kind), uv, z)
        if not isinstance(scale, ScaleFit):
            return replace(result, scale=1.0, scale_sigma=float(np.std(log_ratio) / np.sqrt(max(len(z), 1))))
        return replace(result, scale=scale.alpha, scale_sigma=scale.sigma)
