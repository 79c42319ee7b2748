"""Camera tracking against a splat map of its own (after Matsuki et al., Gaussian Splatting SLAM, CVPR 2024).

    tracker = CameraTracker(pinhole, T_body_camera)
    result = tracker.track(stamp_ns, rgb)         # every picture: where is the body
    tracker.add_depth(stamp_ns, DepthGuess(...))  # some pictures: becomes a keyframe if one is wanted

The first picture with depth makes the map; the body is then at the map's origin. Lengths are those of the
depth: metres if it is metric, else in a unit of nobody's knowing. The same input gives the same output.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.transforms import inverse, se3_exp, se3_log, yaw_of
from beamsplat.services.localization.camera.align import Aligner, Alignment
from beamsplat.services.localization.camera.depth import DepthGuess, fitted_to_map, shrunk
from beamsplat.services.localization.camera.monocular import (
    FIRST_BASELINES,
    ROUNDS,
    WALL,
    Look,
    dense,
    depth_by_motion,
)
from beamsplat.services.localization.camera.relocalize import similar_keyframes, thumbnail
from beamsplat.services.localization.camera.result import CameraResult, Tracked, covisibility
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.splat_map import MapKeyframe, SplatMap
from beamsplat.services.localization.camera.view import PictureView, make_view, small_camera

_KEPT = 24  # pictures whose depth may still come
_CORRELATION = 8.0  # pixels whose errors go together: variance of a pose over that of independent ones


class CameraTracker:
    """See module."""

    def __init__(
        self, camera: Pinhole, T_body_camera: np.ndarray, settings: CameraTrackerSettings | None = None
    ) -> None:
        """`camera` is that of the (undistorted) pictures."""
        self.settings = settings or CameraTrackerSettings()
        self.shape = (camera.height_px, camera.width_px)
        self.camera = small_camera(camera, self.settings.width_px)
        self.splats = SplatMap(self.camera, self.settings)
        self.metric: bool | None = None  # unknown before the first depth
        self.scale_disagreement = float("nan")  # mean log ratio of depths given to the map's
        self._T_body_camera = np.asarray(T_body_camera, dtype=np.float64)
        self._aligner = Aligner(self.camera, self._T_body_camera, self.settings)
        self._recent: deque[Tracked] = deque(maxlen=_KEPT)
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=2)  # T_map_body of good pictures
        self._exposure = (1.0, 0.0)
        self._chain = np.zeros((3, 3))  # covariance that keyframes have handed down
        self._missed = 0
        self._steps = 0
        self._ratios: list[float] = []
        self._rounds = 0  # of settling the first picture's depth, where nobody gives any

    # --- every picture -----------------------------------------------------------------------------

    def track(self, stamp_ns: int, rgb: np.ndarray) -> CameraResult:
        """Where the body was when this picture (uint8 [H, W, 3], undistorted) was taken."""
        refused = self._fault(stamp_ns, rgb)
        if refused is not None:
            return self._result(stamp_ns, "rejected", refused)
        # 1. The picture at several sizes
        view = make_view(rgb, self.camera, 1 + len(self.settings.coarse_steps))
        if view.contrast < self.settings.least_contrast:
            return self._result(stamp_ns, "rejected", f"the picture is blank (contrast {view.contrast:.3f})")
        if not self.splats.keyframes:
            T_camera_map = inverse(self._T_body_camera)
            self._recent.append(Tracked(stamp_ns, view, Alignment(T_camera_map), np.zeros((3, 3))))
            return self._result(stamp_ns, "relocalizing", "no map yet: waits for the first depth")
        # 2. The pose at which the map looks like it
        found, why = self._locate(stamp_ns, view)
        if found is None:
            self._missed += 1
            if self._missed > self.settings.restart_after:
                self._go_on_from_last_pose(stamp_ns, view)
            return self._result(stamp_ns, "lost" if self._missed == 1 else "relocalizing", why)
        self._missed = 0
        covariance = self._chain + self._covariance(found)
        self._recent.append(Tracked(stamp_ns, view, found, covariance))
        self._poses.append((stamp_ns, self._T_map_body(found)))
        self._exposure = (found.gain, found.offset)
        # 3. A little work on the map, the same for every picture
        self._improve(self.settings.steps_per_picture)
        wanted = self._keyframe_is_due(found)
        return CameraResult(stamp_ns, self._poses[-1][1], "ok", why, covariance, wanted)

    def _fault(self, stamp_ns: int, rgb: np.ndarray) -> str | None:
        if rgb.shape[:2] != self.shape or rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            return (
                f"the picture is {rgb.dtype} {list(rgb.shape)}, the camera's are uint8 {[*self.shape, 3]}: "
                "K belongs to another picture size"
            )
        if self._recent and stamp_ns <= self._recent[-1].stamp_ns:
            return f"the picture's stamp {stamp_ns} ns is not after {self._recent[-1].stamp_ns} ns"
        return None

    def _locate(self, stamp_ns: int, view: PictureView) -> tuple[Alignment | None, str]:
        """The alignment that can be believed, or why there is none."""
        why = ""
        for T_map_body in self._starts(stamp_ns, view):
            start = Alignment(inverse(T_map_body @ self._T_body_camera))
            start.gain, start.offset = self._exposure if self._missed == 0 else (1.0, 0.0)
            found = self._aligner.align(self.splats, view, start)
            why = self._doubt(found, T_map_body)
            if not why:
                return found, ""
        return None, why

    def _go_on_from_last_pose(self, stamp_ns: int, view: PictureView) -> None:
        """The place is not known any more: new surfaces are put where the last pose would have them, so that
        there is something to track; how far the body went meanwhile stays unknown, and in the covariance."""
        if not self._poses:
            return
        self._chain = self._chain + np.diag([0.25, 0.25, 0.25])
        alignment = Alignment(inverse(self._poses[-1][1] @ self._T_body_camera))
        self._recent.append(Tracked(stamp_ns, view, alignment, self._chain))

    def _starts(self, stamp_ns: int, view: PictureView) -> list[np.ndarray]:
        """T_map_body to begin at: the prediction, the last pose; when lost, keyframes that look alike."""
        starts = [self._predicted(stamp_ns)]
        if self._missed == 0:
            if len(self._poses) == 2:
                starts.append(self._poses[-1][1])
            return starts
        alike = similar_keyframes(self.splats.keyframes, thumbnail(view.levels[-1].grey), most=2)
        return [self._poses[-1][1]] * bool(self._poses) + [
            frame.T_map_camera @ inverse(self._T_body_camera) for frame in alike
        ]

    def _predicted(self, stamp_ns: int) -> np.ndarray:
        """T_map_body if the body keeps its velocity."""
        if not self._poses:
            return np.eye(4)
        if len(self._poses) < 2:
            return self._poses[-1][1]
        (t0, T0), (t1, T1) = self._poses
        share = min((stamp_ns - t1) / (t1 - t0), 5.0)
        return T1 @ se3_exp(se3_log(inverse(T0) @ T1) * share)

    def _doubt(self, found: Alignment, T_start: np.ndarray) -> str:
        """Why an alignment cannot be believed; empty if it can."""
        s = self.settings
        if found.points < s.least_points:
            return f"lost: the picture and the map share {found.points} points; {s.least_points} are needed"
        # A keyframe found again must be the right one; after a restart there is only the newest to be found.
        searching = 0 < self._missed <= s.restart_after
        least = 0.5 * (1.0 + s.least_inliers) if searching else s.least_inliers
        if found.inliers < least:
            return f"lost: only {found.inliers:.0%} of the map's points look like the picture"
        if found.correlation < s.least_correlation:
            return f"lost: the map and the picture correlate by {found.correlation:.2f} only"
        move = se3_log(inverse(T_start) @ self._T_map_body(found))
        far, turn = float(np.linalg.norm(move[:3])), float(np.linalg.norm(move[3:]))
        if far > s.max_step_m or turn > s.max_step_rad:
            return f"lost: the answer lies {far:.2f} and {np.degrees(turn):.0f} degrees off the prediction"
        return ""

    def _T_map_body(self, found: Alignment) -> np.ndarray:
        return inverse(found.T_camera_map) @ inverse(self._T_body_camera)

    def _covariance(self, found: Alignment) -> np.ndarray:
        """float64 [3, 3] of (x, y, yaw) in the map, of this alignment alone."""
        free = np.linalg.pinv(found.hessian) * _CORRELATION
        full = self._aligner.to_body(free)
        yaw = float(yaw_of(self._T_map_body(found)))
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
        return turn @ full @ turn.T

    def _result(self, stamp_ns: int, status: str, detail: str) -> CameraResult:
        T_map_body = self._poses[-1][1] if self._poses else np.eye(4)
        return CameraResult(stamp_ns, T_map_body, status, detail, np.full((3, 3), np.nan))

    # --- keyframes ---------------------------------------------------------------------------------

    def add_depth(self, stamp_ns: int, guess: DepthGuess) -> str:
        """Makes the picture with this stamp a keyframe if one is due there. "ok", or why it was not used."""
        tracked = next((t for t in self._recent if t.stamp_ns == stamp_ns), None)
        if tracked is None:
            return "its picture was not tracked, or is too old"
        first = not self.splats.keyframes
        if not first and not self._keyframe_is_due(tracked.alignment):
            return "no keyframe is due"
        z = shrunk(guess.z, self.camera.width_px, self.camera.height_px)
        if (z > 0.0).mean() < 0.02:
            return "no pixel of the picture has a depth"
        if first:
            self.metric = guess.metric
        elif guess.metric != self.metric:
            return "its unit is not that of the map"
        else:
            z = self._fitted(z, tracked.alignment, guess.scale_sigma)
        self._add_keyframe(tracked, z, guess)
        return "ok"

    def _add_keyframe(self, tracked: Tracked, z: np.ndarray, guess: DepthGuess) -> None:
        rgb = np.ascontiguousarray(tracked.view.rgb.transpose(2, 0, 1)).astype(np.float32) / np.float32(255)
        # As the map would show it: what the exposure has done since is undone.
        rgb = (rgb - np.float32(tracked.alignment.offset)) / np.float32(tracked.alignment.gain)
        weight = np.full(z.shape, 1.0 / (1.0 + (guess.scale_sigma / 0.05) ** 2), np.float32)
        first = not self.splats.keyframes
        frame = MapKeyframe(
            tracked.stamp_ns, inverse(tracked.alignment.T_camera_map), rgb, z, weight,
            np.zeros(0, np.int32), thumbnail(tracked.view.levels[-1].grey),
        )  # fmt: skip
        self.splats.add(frame)
        if first:
            self._first_grey = tracked.view.levels[1].grey
            self._poses.append((tracked.stamp_ns, self._T_map_body(tracked.alignment)))
            self._improve(self.settings.first_steps)
        else:
            self._chain = tracked.covariance

    def add_without_depth(self, stamp_ns: int) -> str:
        """As `add_depth`, with depth from the pictures' own parallax; the map's unit is then arbitrary."""
        tracked = next((t for t in self._recent if t.stamp_ns == stamp_ns), None)
        if tracked is None:
            return "its picture was not tracked, or is too old"
        guess = DepthGuess(np.zeros((0, 0), np.float32), 0.15, metric=False)
        if not self.splats.keyframes:
            self.metric = False
            wall = np.full(tracked.view.rgb.shape[:2], WALL, np.float32)
            self._add_keyframe(tracked, wall, guess)
            return "ok"
        if self.metric:
            return "its unit is not that of the map"
        if self._rounds < ROUNDS and self._missed <= self.settings.restart_after:
            return self._settle(tracked)
        if self._rounds < ROUNDS:  # lost before the unit had settled: from the beginning
            self.splats.close()
            self.splats, self._rounds = SplatMap(self.camera, self.settings), 0
            return self.add_without_depth(stamp_ns)
        if not self._keyframe_is_due(tracked.alignment):
            return "no keyframe is due"
        shown = self._shown_depth(tracked.alignment)
        usual = float(np.median(shown[shown > 0.0])) if (shown > 0.0).any() else WALL
        before = [self._look(t) for t in self._recent if t.stamp_ns < stamp_ns]
        z = depth_by_motion(self._look(tracked), before, self._aligner.cameras[1], usual)
        z = dense(z, shown, shown.shape)
        self._add_keyframe(tracked, self._fitted(z, tracked.alignment, guess.scale_sigma), guess)
        return "ok"

    def _settle(self, tracked: Tracked) -> str:
        """The first keyframe's depth again, from the poses that it gave; then the map anew, and the pose."""
        first = self.splats.keyframes[0]
        here = (self._first_grey, first.T_map_camera)
        T_first_now = inverse(first.T_map_camera) @ inverse(tracked.alignment.T_camera_map)
        if np.linalg.norm(T_first_now[:3, 3]) < FIRST_BASELINES[self._rounds] * WALL:
            return "the camera has not moved far enough"
        self._rounds += 1
        looks = [self._look(t) for t in self._recent if t.stamp_ns > first.stamp_ns]
        z = depth_by_motion(here, looks, self._aligner.cameras[1], WALL)
        if (z > 0.0).mean() < 0.05:
            return "the pictures do not tell depth yet"
        z = dense(z, np.zeros_like(z), first.z_m.shape)
        self.splats.close()
        self.splats = SplatMap(self.camera, self.settings)
        first.z_m = (z * (WALL / float(np.median(z)))).astype(np.float32)
        self.splats.add(first)
        self._improve(self.settings.first_steps)
        start = Alignment(tracked.alignment.T_camera_map, gain=self._exposure[0], offset=self._exposure[1])
        tracked.alignment = self._aligner.align(self.splats, tracked.view, start)
        self._poses.clear()  # velocities were those of another unit
        self._poses.append((tracked.stamp_ns, self._T_map_body(tracked.alignment)))
        return "ok"

    def _look(self, tracked: Tracked) -> Look:
        return tracked.view.levels[1].grey, inverse(tracked.alignment.T_camera_map)

    def _shown_depth(self, alignment: Alignment) -> np.ndarray:
        """float32 [H, W] of the map as it was seen, 0 where it does not explain the picture."""
        render = self.splats.render(self.camera, alignment.T_camera_map)
        alpha = render.image[4]
        known = alpha > self.settings.least_alpha
        shown = np.where(known, render.image[3] / np.maximum(alpha, 0.1), 0.0).astype(np.float32)
        self.splats.release(render)
        return shown

    def _fitted(self, z: np.ndarray, alignment: Alignment, scale_sigma: float) -> np.ndarray:
        """Depth at the scale of the map."""
        z, ratio = fitted_to_map(z, self._shown_depth(alignment), scale_sigma)
        if np.isfinite(ratio):
            self._ratios = [*self._ratios, ratio][-20:]
            self.scale_disagreement = float(np.mean(self._ratios))
        return z

    def _keyframe_is_due(self, found: Alignment) -> bool:
        """Whether the map explains too little here, or other Gaussians are in view than at the last one."""
        if found.in_view is None:  # not aligned: the first picture, or one after the track was lost for long
            return not self.splats.keyframes or self._missed > self.settings.restart_after
        if found.explained < self.settings.least_explained:
            return True
        return (
            covisibility(found.in_view, self.splats.keyframes[-1].in_view) < self.settings.least_covisibility
        )

    def _improve(self, steps: int) -> None:
        """Optimisation steps: in turn on one of the newest keyframes, and on one of all."""
        frames = self.splats.keyframes
        for _ in range(steps):
            newest = frames[-self.settings.window :]
            pool = newest if self._steps % 2 == 0 else frames
            # A fixed, well spread order: the golden ratio's multiples.
            pick = int((self._steps * 0.6180339887498949) % 1.0 * len(pool))
            self.splats.step(pool[pick])
            self._steps += 1

    def close(self) -> None:
        """Ends the rasterizer."""
        self.splats.close()
