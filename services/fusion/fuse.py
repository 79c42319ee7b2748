"""Fusion by methods `field` and `poisson`: metric depth and its sigma from image, pose, beams, estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from beamsplat.common.geometry.beams import NO_BEAMS, project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.depth_sigma import BETWEEN_KEYFRAMES, OF_KEYFRAMES, stated_sigma_log
from beamsplat.services.fusion import upsample
from beamsplat.services.fusion.aggregation import Aggregation
from beamsplat.services.fusion.completion import completed_sweep
from beamsplat.services.fusion.input_checks import ImageCheck, check_beams
from beamsplat.services.fusion.inputs import (
    FusionInput,
    KeyframeTask,
    PlaneSweepConfig,
    SweepResult,
    WorkingImage,
)
from beamsplat.services.fusion.keyframe_depth import KeyframeDepths, WarpedDepth
from beamsplat.services.fusion.pairs import largest_cluster
from beamsplat.services.fusion.plane_sweep import PlaneSweep
from beamsplat.services.fusion.result import FusionResult, rejected
from beamsplat.services.fusion.scaling import ScaleFit, as_depth, fit_scale, off_line_sigma
from beamsplat.services.fusion.surfaces import CandidateSurfaces

# Typical standard deviations of log depth by the evidence of a pixel, measured with `beamsplat eval depth` on
# the recordings house_a and redkitchen. They leave out gross errors, see `stated_sigma_log`.
_BEAM, _FLOOR, _SURFACE = 0.002, 0.004, 0.010
_BETWEEN_BEAMS_M = 0.007  # standard deviation of the mean of two beams with 1 cm each
_WARPED_SIGMA_LOG = (0.10, 0.06, 0.045)  # depth warped from one, two, three and more keyframes
_UPRIGHT, _TILTING = 0.125, 0.13  # extruded walls without other evidence: level body, hand-held body
_ESTIMATE_AWAY = 0.10  # estimate away from the scan line, where its error is not measured
_BEAM_HEIGHT_M = 0.06  # pixels this near to the lidar plane have the depth of the beams
_SAME_SURFACE = 0.08  # log depth: neighbours that differ by less belong to one surface
_EDGE = 0.4  # share of a depth jump nearby that is added to sigma: the side of the edge is uncertain
_EDGE_REACH = (3, 5)  # rows, columns of the working size
_SIGMA_BLUR_PX = 3.0  # of the working size: Gaussian over which sigma is averaged
_LEARNED_FLOOR, _LEARNED_BEAM = 0.05, 0.10  # spread below which the learned aggregation is on that surface
_CONTRADICTION = 0.25  # log depth: a beam that differs by more contradicts the warped depth
_LEAST_KNOWN = 20  # beams with warped depth, below which they are not compared
_LEAST_INLIERS = 0.3  # share of the beams that fit the result, below which it is rejected


@dataclass(frozen=True)
class ExaminedImage:
    """An image that passed the checks, with its beams and the depth of past keyframes in its view."""

    frame: FusionInput
    working: WorkingImage
    uv: np.ndarray  # float64 [N, 2] pixels of the beams
    z_m: np.ndarray  # float64 [N] their optical z
    warped: WarpedDepth
    depths: KeyframeDepths  # from which `warped` was computed
    views: list[WorkingImage]  # source images of its sweep; empty if it is no keyframe


@dataclass(frozen=True)
class SweptKeyframe:
    """The depth of a keyframe, and what it changes for later images."""

    task: KeyframeTask
    result: FusionResult
    swept: SweepResult  # at the working size
    sigma_log: np.ndarray  # float32 [h, w]: standard deviation of its log depth


class Fusion:
    """Dense metric depth of a sequence of images: plane sweep at keyframes, warped depth in between."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, *, floor_known: bool, planar: bool,
        config: PlaneSweepConfig | None = None, aggregation: Aggregation | None = None,
        completes: bool = False,
    ) -> None:  # fmt: skip
        """Prepare fusion for one camera; arguments as in `PlaneSweep`.

        `completes`: method `poisson`. The depth of keyframes is completed with the gradients of the estimate.
        """
        self._sweep = PlaneSweep(
            camera, T_body_camera, floor_known=floor_known, planar=planar, config=config,
            aggregation=aggregation,
        )  # fmt: skip
        self._planar = planar
        self._completes = completes
        self._image_check = ImageCheck()

    def add_scan(self, points_map_m: np.ndarray) -> None:
        """Add the returns float64 [N, 3] of a scan, in the map frame."""
        self._sweep.add_scan(points_map_m)

    def fuse(self, frame: FusionInput, *, keyframe: bool) -> FusionResult:
        """Return the metric depth of one image, or a result without depth whose status is the reason.

        A keyframe needs several times more computation than another image; its depth is warped into later
        images. A caller that must not wait for it uses `examine`, `begin_keyframe` and `finish_keyframe`.
        """
        examined = self.examine(frame, keyframe=keyframe)
        if isinstance(examined, FusionResult):
            return examined
        if keyframe:
            return self.finish_keyframe(self.begin_keyframe(examined)())
        return self.between_keyframes(examined)

    def examine(self, frame: FusionInput, *, keyframe: bool) -> ExaminedImage | FusionResult:
        """Check an image and its beams, and store it for later plane sweeps; call it in order of the stamps.

        Returns:
            The image, prepared for `begin_keyframe` or `between_keyframes`; or a result without depth, whose
            status is the reason.
        """
        shape = self._sweep.camera.shape
        status = self._image_check.check(frame.image_rgb, frame.T_map_body)
        if status != "ok":
            return rejected(shape, status)
        uv, z, _ = project_beams(frame.beams, self._sweep.camera, self._sweep.T_body_camera)
        working = self._sweep.downscale(frame)
        warped = self._sweep.warp_into(working)
        status = check_beams(len(uv), self._contradicting_share(warped.depth_m, uv, z))
        if status != "ok":
            return rejected(shape, status)
        views = self._sweep.choose_views(working.T_map_camera) if keyframe else []
        examined = ExaminedImage(frame, working, uv, z, warped, self._sweep.keyframe_depths, views)
        self._sweep.keep(working)
        return examined

    def between_keyframes(self, examined: ExaminedImage) -> FusionResult:
        """Return the depth of an image: keyframe depth, else candidate surfaces, else the estimate."""
        frame = examined.frame
        surfaces = self._sweep.surfaces_between_keyframes(frame)
        swept = self._depth_between_keyframes(frame, examined.warped, surfaces)
        return self._to_full_size(examined, swept, swept.spread, keyframe=False)

    def begin_keyframe(self, examined: ExaminedImage) -> Callable[[], SweptKeyframe]:
        """Return the plane sweep of a keyframe as a function, which may run in another thread.

        Meanwhile this object may be used for other images. Pass the result to `finish_keyframe`, before the
        next call of this method.
        """
        is_newest = examined.depths is self._sweep.keyframe_depths
        warped = examined.warped if is_newest else None
        task = self._sweep.prepare(examined.frame, examined.working, examined.views, warped)

        def run() -> SweptKeyframe:
            swept, surfaces = self._sweep.sweep(task)
            sigma_log = self._sweep_sigma_log(swept, surfaces)
            self._pin_to_beams(swept, sigma_log, surfaces)
            if self._completes:
                swept, sigma_log = completed_sweep(examined.frame, swept, sigma_log)
            result = self._to_full_size(examined, swept, sigma_log, keyframe=True)
            return SweptKeyframe(task, result, swept, sigma_log)

        return run

    def complete(self, examined: ExaminedImage, swept: SweptKeyframe) -> FusionResult:
        """Return the depth of a swept keyframe by method `poisson`, for comparison with `swept.result`.

        Without an estimate, or if the swept depth contradicts it, both are the same.
        """
        depth, sigma_log = completed_sweep(examined.frame, swept.swept, swept.sigma_log)
        return self._to_full_size(examined, depth, sigma_log, keyframe=True)

    def finish_keyframe(self, swept: SweptKeyframe) -> FusionResult:
        """Use the depth of a keyframe for later images, and return it."""
        self._sweep.commit(swept.task)
        return swept.result

    def look(self, image_rgb: np.ndarray, T_map_body: np.ndarray) -> None:
        """Store an image for later plane sweeps, without estimating its depth."""
        frame = FusionInput(0, image_rgb, T_map_body, NO_BEAMS)
        if self._image_check.check(image_rgb, T_map_body) == "ok":
            self._sweep.keep_if_moved(frame)

    def _depth_between_keyframes(
        self, frame: FusionInput, warped: WarpedDepth, surfaces: CandidateSurfaces
    ) -> SweepResult:
        """Return, per pixel, the warped keyframe depth, else a candidate surface, else the depth estimate.

        `SweepResult.spread` contains the standard deviation of log depth.
        """
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
            depth[take], spread[take] = estimated[take], np.hypot(error, _ESTIMATE_AWAY)
        known = warped.votes > 0
        depth[known] = warped.depth_m[known]
        spread[known] = np.array(_WARPED_SIGMA_LOG, np.float32)[np.minimum(warped.votes[known], 3) - 1]
        with np.errstate(invalid="ignore"):
            at_beam = (surfaces.wall_offset_m < _BEAM_HEIGHT_M) & ~surfaces.on_floor
            exact = np.abs(np.log(surfaces.floor / depth)) < 0.03
        depth[at_beam] = surfaces.wall[at_beam]
        spread[at_beam] = _BEAM + _BETWEEN_BEAMS_M / depth[at_beam]
        depth[exact], spread[exact] = surfaces.floor[exact], _FLOOR
        return SweepResult(depth, spread, at_beam | exact, 0)

    def _contradicting_share(self, warped: np.ndarray, uv: np.ndarray, z: np.ndarray) -> float | None:
        """Return the fraction of beams that contradict the warped depth; None if too few can be compared.

        `warped` [h, w] m; `uv` [N, 2] pixels of the beams; `z` [N] their optical z, m.
        """
        if len(z) == 0:
            return None
        h, w = warped.shape
        v = np.clip(((uv[:, 1] + 0.5) * h / self._sweep.camera.height_px).astype(int), 0, h - 1)
        u = np.clip(((uv[:, 0] + 0.5) * w / self._sweep.camera.width_px).astype(int), 0, w - 1)
        then = warped[v, u]
        known = np.isfinite(then)
        if known.sum() < _LEAST_KNOWN:
            return None
        return float(np.mean(np.abs(np.log(z[known] / then[known])) > _CONTRADICTION))

    def _sweep_sigma_log(self, swept: SweepResult, surfaces: CandidateSurfaces) -> np.ndarray:
        """Return the standard deviation of log depth [h, w], by kind of surface and label spread."""
        with np.errstate(invalid="ignore"):
            floor = swept.snapped & (np.abs(np.log(surfaces.floor / swept.depth_m)) < 0.01)
            beam = swept.snapped & (surfaces.wall_offset_m < _BEAM_HEIGHT_M)
        config = self._sweep.config
        learned = self._sweep.aggregation.states_whole_error
        if learned:  # near another surface by chance, its spread stays large
            floor &= swept.spread < _LEARNED_FLOOR
            beam &= swept.spread < _LEARNED_BEAM
        base = np.where(swept.snapped | learned, _SURFACE, config.matched)
        base = np.where(floor, _FLOOR, np.where(beam, _BEAM + _BETWEEN_BEAMS_M / swept.depth_m, base))
        doubt = np.where(floor | beam, 0.0, (1.0 if learned else config.per_spread) * swept.spread)
        return np.hypot(base, doubt).astype(np.float32)

    def _pin_to_beams(self, swept: SweepResult, sigma_log: np.ndarray, surfaces: CandidateSurfaces) -> None:
        """Overwrite depth and standard deviation on the scan line with those of the beams, in place."""
        pinned = (surfaces.wall_offset_m < 0.5 * _BEAM_HEIGHT_M) & ~surfaces.on_floor
        swept.depth_m[pinned] = surfaces.wall[pinned]
        sigma_log[pinned] = _BEAM + _BETWEEN_BEAMS_M / swept.depth_m[pinned]

    def _inflate_at_edges(self, depth: np.ndarray, sigma_log: np.ndarray) -> np.ndarray:
        """Return the standard deviation of log depth [h, w], increased next to depth edges."""
        known = np.isfinite(depth)
        middle = float(np.median(depth[known])) if known.any() else 1.0
        log_z = np.log(np.where(known, depth, middle)).astype(np.float32)
        window = np.ones(_EDGE_REACH, np.uint8)
        jump = cv2.dilate(log_z, window) - cv2.erode(log_z, window)
        return np.hypot(sigma_log, np.where(jump > _SAME_SURFACE, _EDGE * jump, 0.0)).astype(np.float32)

    def _known_mask(self, depth: np.ndarray, sigma_log: np.ndarray) -> np.ndarray:
        """Return bool [h, w]: True for pixels whose standard deviation is small enough for output."""
        config = self._sweep.config
        sure = sigma_log <= config.max_sigma_log
        if np.isfinite(config.max_sigma_m):
            far = 3.0 * config.max_sigma_m
            doubt = np.where(np.isfinite(depth), np.minimum(sigma_log * depth, far), far).astype(np.float32)
            sure &= cv2.GaussianBlur(doubt, (0, 0), _SIGMA_BLUR_PX) <= config.max_sigma_m
        return sure

    def _to_full_size(
        self, examined: ExaminedImage, swept: SweepResult, sigma_log: np.ndarray, *, keyframe: bool
    ) -> FusionResult:
        """Return the result at the image size, with scale, inlier share and residual (m) at the beams."""
        frame, uv, z = examined.frame, examined.uv, examined.z_m
        h, w = self._sweep.working_camera.shape
        depth = np.empty(self._sweep.camera.shape, np.float32)
        sigma = np.empty_like(depth)
        if not (keyframe and self._sweep.aggregation.states_whole_error):
            sigma_log = self._inflate_at_edges(swept.depth_m, sigma_log)
        known = np.where(self._known_mask(swept.depth_m, sigma_log), swept.depth_m, np.nan).astype(np.float32)
        sigma_log = stated_sigma_log(sigma_log, OF_KEYFRAMES if keyframe else BETWEEN_KEYFRAMES)
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
            return result.as_rejected(
                f"only {result.inlier_share:.0%} of the beams fit the depth: wrong pose or calibration"
            )
        scale = None
        if frame.estimate is not None and frame.estimate_kind != "none":
            scale = fit_scale(as_depth(frame.estimate, frame.estimate_kind), uv, z)
        if not isinstance(scale, ScaleFit):
            spread = float(np.std(log_ratio)) if len(log_ratio) else 0.0
            return replace(result, scale=1.0, scale_sigma=off_line_sigma(spread))
        return replace(result, scale=scale.alpha, scale_sigma=scale.image_sigma)
