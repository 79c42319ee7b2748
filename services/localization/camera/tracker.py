"""Camera tracking against a splat map of its own (after Matsuki et al., Gaussian Splatting SLAM, CVPR 2024).

    tracker = CameraTracker(pinhole, T_body_camera)
    result = tracker.track(stamp_ns, rgb)         # every image: pose of the body
    tracker.add_depth(stamp_ns, DepthPrior(...))  # images with depth: they may become keyframes

The first image with depth initialises the map, with the body at the map's origin. Lengths have the unit of
the depth: metres if it is metric, else arbitrary. The tracker is deterministic.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from beamsplat.common.engines.protocol import SplatEngine
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse, se3_exp, se3_log, yaw_of
from beamsplat.common.status import TrackingStatus
from beamsplat.services.localization.camera.align import Aligner, Alignment
from beamsplat.services.localization.camera.depth import DepthPrior, align_scale_to_map, resize_depth
from beamsplat.services.localization.camera.image_pyramid import (
    ImagePyramid,
    make_image_pyramid,
    tracking_camera,
)
from beamsplat.services.localization.camera.monocular import (
    INIT_BASELINES,
    INIT_ROUNDS,
    INITIAL_DEPTH,
    PosedImage,
    dense,
    depth_from_parallax,
)
from beamsplat.services.localization.camera.relocalize import similar_keyframes, thumbnail
from beamsplat.services.localization.camera.result import TrackedImage, TrackingResult, covisibility
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.splat_map import MapKeyframe, SplatMap

_RECENT_IMAGES = 24  # images that are stored until their depth is received
_RESIDUAL_CORRELATION = 8.0  # factor on the covariance, because errors of neighbouring pixels are correlated


class CameraTracker:
    """Camera pose tracker with its own splat map; the docstring of the module shows its use."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, settings: CameraTrackerSettings | None = None,
        engine: SplatEngine | None = None,
    ) -> None:  # fmt: skip
        """Create a tracker for undistorted images of `camera`.

        Args:
            T_body_camera: float64 [4, 4].
            engine: holds and renders the map; None = the CPU. It is closed with the tracker.
        """
        self.settings = settings or CameraTrackerSettings()
        self.shape = (camera.height_px, camera.width_px)
        self.camera = tracking_camera(camera, self.settings.width_px)
        self.splats = SplatMap(self.camera, self.settings, engine)
        self.metric: bool | None = None  # None before the first depth
        self.scale_disagreement = float("nan")  # mean log ratio of new depth to the map's depth
        self._T_body_camera = np.asarray(T_body_camera, dtype=np.float64)
        self._aligner = Aligner(self.camera, self._T_body_camera, self.settings)
        self._recent: deque[TrackedImage] = deque(maxlen=_RECENT_IMAGES)
        self._last_poses: deque[tuple[int, np.ndarray]] = deque(maxlen=2)  # T_map_body of tracked images
        self._exposure = (1.0, 0.0)  # gain, offset of the last tracked image
        self._keyframe_covariance = np.zeros((3, 3))  # of the newest keyframe; it accumulates from the first
        self._failures = 0  # consecutive images without an accepted alignment
        self._steps = 0
        self._log_ratios: list[float] = []
        self._init_rounds = 0  # refinements of the first image's depth, used without a depth source

    # --- tracking ----------------------------------------------------------------------------------

    def track(self, stamp_ns: int, rgb: np.ndarray) -> TrackingResult:
        """Estimate the pose of the body for an undistorted RGB image uint8 [H, W, 3]."""
        error = self._input_error(stamp_ns, rgb)
        if error is not None:
            return self._result(stamp_ns, "rejected", error)
        # 1. Image pyramid
        view = make_image_pyramid(rgb, self.camera, 1 + len(self.settings.coarse_steps))
        if view.contrast < self.settings.min_contrast:
            return self._result(stamp_ns, "rejected", f"the image is blank (contrast {view.contrast:.3f})")
        if not self.splats.keyframes:
            T_camera_map = inverse(self._T_body_camera)
            self._recent.append(TrackedImage(stamp_ns, view, Alignment(T_camera_map), np.zeros((3, 3))))
            return self._result(stamp_ns, "relocalizing", "no map yet: waiting for the first depth")
        # 2. Align the rendered map to the image
        found, why = self._locate(stamp_ns, view)
        if found is None:
            self._failures += 1
            if self._failures > self.settings.restart_after:
                self._continue_from_last_pose(stamp_ns, view)
            return self._result(stamp_ns, "lost" if self._failures == 1 else "relocalizing", why)
        self._failures = 0
        covariance = self._keyframe_covariance + self._covariance(found)
        self._recent.append(TrackedImage(stamp_ns, view, found, covariance))
        self._last_poses.append((stamp_ns, self._T_map_body(found)))
        self._exposure = (found.gain, found.offset)
        # 3. A fixed number of optimisation steps on the map
        self._optimise_map(self.settings.steps_per_image)
        wanted = self._keyframe_is_due(found)
        return TrackingResult(stamp_ns, self._last_poses[-1][1], "ok", why, covariance, wanted)

    def _input_error(self, stamp_ns: int, rgb: np.ndarray) -> str | None:
        if rgb.shape[:2] != self.shape or rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            return (
                f"the image is {rgb.dtype} {list(rgb.shape)}, but the calibration needs uint8 "
                f"{[*self.shape, 3]}: K belongs to another image size"
            )
        if self._recent and stamp_ns <= self._recent[-1].stamp_ns:
            return f"the image stamp {stamp_ns} ns is not after the last one, {self._recent[-1].stamp_ns} ns"
        return None

    def _locate(self, stamp_ns: int, view: ImagePyramid) -> tuple[Alignment | None, str]:
        """Align the image from start poses; return the first accepted, or None and the reason."""
        why = ""
        for T_map_body in self._initial_poses(stamp_ns, view):
            start = Alignment(inverse(T_map_body @ self._T_body_camera))
            start.gain, start.offset = self._exposure if self._failures == 0 else (1.0, 0.0)
            found = self._aligner.align(self.splats, view, start)
            why = self._reason_to_reject(found, T_map_body)
            if not why:
                return found, ""
        return None, why

    def _continue_from_last_pose(self, stamp_ns: int, view: ImagePyramid) -> None:
        """Store the image with the last known pose: as a keyframe, it starts a new part of the map.

        The covariance is increased, because the motion since that pose is unknown.
        """
        if not self._last_poses:
            return
        self._keyframe_covariance = self._keyframe_covariance + np.diag([0.25, 0.25, 0.25])
        alignment = Alignment(inverse(self._last_poses[-1][1] @ self._T_body_camera))
        self._recent.append(TrackedImage(stamp_ns, view, alignment, self._keyframe_covariance))

    def _initial_poses(self, stamp_ns: int, view: ImagePyramid) -> list[np.ndarray]:
        """Return start values of T_map_body: predicted and last pose, or if lost also similar keyframes."""
        starts = [self._predicted(stamp_ns)]
        if self._failures == 0:
            if len(self._last_poses) == 2:
                starts.append(self._last_poses[-1][1])
            return starts
        similar = similar_keyframes(self.splats.keyframes, thumbnail(view.levels[-1].grey), most=2)
        return [self._last_poses[-1][1]] * bool(self._last_poses) + [
            frame.T_map_camera @ inverse(self._T_body_camera) for frame in similar
        ]

    def _predicted(self, stamp_ns: int) -> np.ndarray:
        """Return T_map_body extrapolated with constant velocity."""
        if not self._last_poses:
            return np.eye(4)
        if len(self._last_poses) < 2:
            return self._last_poses[-1][1]
        (t0, T0), (t1, T1) = self._last_poses
        factor = min((stamp_ns - t1) / (t1 - t0), 5.0)
        return T1 @ se3_exp(se3_log(inverse(T0) @ T1) * factor)

    def _reason_to_reject(self, found: Alignment, T_start: np.ndarray) -> str:
        """Return why an alignment is rejected, "" if it is accepted; `T_start`: start value of T_map_body."""
        s = self.settings
        if found.points < s.min_points:
            return f"lost: only {found.points} map points are in the image; {s.min_points} are needed"
        # A stricter limit while relocalizing at keyframes, because a wrong keyframe may look similar.
        searching = 0 < self._failures <= s.restart_after
        least = 0.5 * (1.0 + s.min_inlier_ratio) if searching else s.min_inlier_ratio
        if found.inlier_ratio < least:
            return f"lost: only {found.inlier_ratio:.0%} of the map points match the image"
        if found.correlation < s.min_correlation:
            return f"lost: the correlation of map and image is only {found.correlation:.2f}"
        move = se3_log(inverse(T_start) @ self._T_map_body(found))
        far, turn = float(np.linalg.norm(move[:3])), float(np.linalg.norm(move[3:]))
        if far > s.max_step_m or turn > s.max_step_rad:
            return f"lost: the pose is {far:.2f} and {np.degrees(turn):.0f} degrees away from the prediction"
        return ""

    def _T_map_body(self, found: Alignment) -> np.ndarray:
        return inverse(found.T_camera_map) @ inverse(self._T_body_camera)

    def _covariance(self, found: Alignment) -> np.ndarray:
        """Return the covariance float64 [3, 3] of (x, y, yaw) in the map frame, without errors of the map."""
        assert found.hessian is not None  # of a finished alignment
        free = np.linalg.pinv(found.hessian) * _RESIDUAL_CORRELATION
        full = self._aligner.to_body(free)
        yaw = float(yaw_of(self._T_map_body(found)))
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
        return turn @ full @ turn.T

    def _result(self, stamp_ns: int, status: TrackingStatus, detail: str) -> TrackingResult:
        T_map_body = self._last_poses[-1][1] if self._last_poses else np.eye(4)
        return TrackingResult(stamp_ns, T_map_body, status, detail, np.full((3, 3), np.nan))

    # --- keyframes ---------------------------------------------------------------------------------

    def add_depth(self, stamp_ns: int, prior: DepthPrior) -> str:
        """Add the tracked image with this stamp as a keyframe if one is due.

        Returns:
            "ok", or the reason why the image was not added.
        """
        tracked = next((t for t in self._recent if t.stamp_ns == stamp_ns), None)
        if tracked is None:
            return "its image was not tracked, or is too old"
        first = not self.splats.keyframes
        if not first and not self._keyframe_is_due(tracked.alignment):
            return "no keyframe is due"
        z = resize_depth(prior.z, self.camera.width_px, self.camera.height_px)
        if (z > 0.0).mean() < 0.02:
            return "no pixel of the image has a depth"
        if first:
            self.metric = prior.metric
        elif prior.metric != self.metric:
            return "its unit differs from the map's unit"
        else:
            z = self._align_scale(z, tracked.alignment, prior.scale_sigma)
        self._add_keyframe(tracked, z, prior)
        return "ok"

    def _add_keyframe(self, tracked: TrackedImage, z: np.ndarray, prior: DepthPrior) -> None:
        rgb = np.ascontiguousarray(tracked.view.rgb.transpose(2, 0, 1)).astype(np.float32) / np.float32(255)
        # Undo the exposure difference to the map.
        rgb = (rgb - np.float32(tracked.alignment.offset)) / np.float32(tracked.alignment.gain)
        weight = np.full(z.shape, 1.0 / (1.0 + (prior.scale_sigma / 0.05) ** 2), np.float32)
        first = not self.splats.keyframes
        frame = MapKeyframe(
            tracked.stamp_ns, inverse(tracked.alignment.T_camera_map), rgb, z, weight,
            np.zeros(0, np.int32), thumbnail(tracked.view.levels[-1].grey),
        )  # fmt: skip
        self.splats.add(frame)
        if first:
            self._first_grey = tracked.view.levels[1].grey
            self._last_poses.append((tracked.stamp_ns, self._T_map_body(tracked.alignment)))
            self._optimise_map(self.settings.first_steps)
        else:
            self._keyframe_covariance = tracked.covariance

    def add_without_depth(self, stamp_ns: int) -> str:
        """Add a keyframe like `add_depth`, with depth from the parallax of the images.

        The unit of the map is then arbitrary. Returns "ok", or the reason why no keyframe was added.
        """
        tracked = next((t for t in self._recent if t.stamp_ns == stamp_ns), None)
        if tracked is None:
            return "its image was not tracked, or is too old"
        prior = DepthPrior(np.zeros((0, 0), np.float32), 0.15, metric=False)
        if not self.splats.keyframes:
            self.metric = False
            plane = np.full(tracked.view.rgb.shape[:2], INITIAL_DEPTH, np.float32)
            self._add_keyframe(tracked, plane, prior)
            return "ok"
        if self.metric:
            return "its unit differs from the map's unit"
        if self._init_rounds < INIT_ROUNDS and self._failures <= self.settings.restart_after:
            return self._refine_first_depth(tracked)
        if self._init_rounds < INIT_ROUNDS:  # lost before the initialisation was complete: start again
            self.splats.clear()
            self._init_rounds = 0
            return self.add_without_depth(stamp_ns)
        if not self._keyframe_is_due(tracked.alignment):
            return "no keyframe is due"
        shown = self._rendered_depth(tracked.alignment)
        usual = float(np.median(shown[shown > 0.0])) if (shown > 0.0).any() else INITIAL_DEPTH
        before = [self._posed_image(t) for t in self._recent if t.stamp_ns < stamp_ns]
        z = depth_from_parallax(self._posed_image(tracked), before, self._aligner.cameras[1], usual)
        z = dense(z, shown, shown.shape)
        self._add_keyframe(tracked, self._align_scale(z, tracked.alignment, prior.scale_sigma), prior)
        return "ok"

    def _refine_first_depth(self, tracked: TrackedImage) -> str:
        """Recompute the depth of the first keyframe by plane sweep, rebuild the map, realign the image.

        Returns "ok", or the reason why this is not possible yet.
        """
        first = self.splats.keyframes[0]
        here = (self._first_grey, first.T_map_camera)
        T_first_now = inverse(first.T_map_camera) @ inverse(tracked.alignment.T_camera_map)
        if np.linalg.norm(T_first_now[:3, 3]) < INIT_BASELINES[self._init_rounds] * INITIAL_DEPTH:
            return "the camera has not moved far enough"
        self._init_rounds += 1
        others = [self._posed_image(t) for t in self._recent if t.stamp_ns > first.stamp_ns]
        z = depth_from_parallax(here, others, self._aligner.cameras[1], INITIAL_DEPTH)
        if (z > 0.0).mean() < 0.05:
            return "there is not enough parallax yet"
        z = dense(z, np.zeros_like(z), first.z_m.shape)
        self.splats.clear()
        first.z_m = (z * (INITIAL_DEPTH / float(np.median(z)))).astype(np.float32)
        self.splats.add(first)
        self._optimise_map(self.settings.first_steps)
        start = Alignment(tracked.alignment.T_camera_map, gain=self._exposure[0], offset=self._exposure[1])
        tracked.alignment = self._aligner.align(self.splats, tracked.view, start)
        self._last_poses.clear()  # the unit has changed, so the old velocity is wrong
        self._last_poses.append((tracked.stamp_ns, self._T_map_body(tracked.alignment)))
        return "ok"

    def _posed_image(self, tracked: TrackedImage) -> PosedImage:
        return tracked.view.levels[1].grey, inverse(tracked.alignment.T_camera_map)

    def _rendered_depth(self, alignment: Alignment) -> np.ndarray:
        """Return the map's depth float32 [H, W] at the aligned pose, 0 where the map is not opaque."""
        image, _ = self.splats.view(self.camera, alignment.T_camera_map)
        alpha = image[4]
        known = alpha > self.settings.min_alpha
        return np.where(known, image[3] / np.maximum(alpha, 0.1), 0.0).astype(np.float32)

    def _align_scale(self, z: np.ndarray, alignment: Alignment, scale_sigma: float) -> np.ndarray:
        """Return the depth `z` float32 [H, W] scaled towards the map's depth; update `scale_disagreement`."""
        z, ratio = align_scale_to_map(z, self._rendered_depth(alignment), scale_sigma)
        if np.isfinite(ratio):
            self._log_ratios = [*self._log_ratios, ratio][-20:]
            self.scale_disagreement = float(np.mean(self._log_ratios))
        return z

    def _keyframe_is_due(self, found: Alignment) -> bool:
        """Return whether the map covers too little of the image, or covisibility is too low."""
        if found.in_view is None:  # not aligned: the first image, or one after a long loss of tracking
            return not self.splats.keyframes or self._failures > self.settings.restart_after
        if found.coverage < self.settings.min_coverage:
            return True
        return covisibility(found.in_view, self.splats.keyframes[-1].in_view) < self.settings.min_covisibility

    def _optimise_map(self, steps: int) -> None:
        """Optimise the map by `steps` steps, alternately on one of the newest keyframes and on one of all."""
        frames = self.splats.keyframes
        for _ in range(steps):
            newest = frames[-self.settings.window :]
            pool = newest if self._steps % 2 == 0 else frames
            # Multiples of the golden ratio: a deterministic, evenly spread order.
            pick = int((self._steps * 0.6180339887498949) % 1.0 * len(pool))
            self.splats.step(pool[pick])
            self._steps += 1

    def close(self) -> None:
        """Release the resources of the splat map."""
        self.splats.close()
