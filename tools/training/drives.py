"""Simulated training drives: images, beams and poses of one home, passed through the plane sweep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from beamsplat.common.geometry.beams import NO_BEAMS, Beams
from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.services.depth.source import DepthInput, DepthSource
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.keyframe_depth import WarpedDepth
from beamsplat.services.fusion.plane_sweep import PlaneSweep
from beamsplat.tools.simulator.actors import ActorLighting, ActorSet
from beamsplat.tools.simulator.frames import depth_mm
from beamsplat.tools.simulator.render import SceneRenderer
from beamsplat.tools.training.carriers import SensorSet
from beamsplat.tools.training.exposure import develop, render_exposed
from beamsplat.tools.training.homes import TrainingHome
from beamsplat.tools.training.motion import Motion, image_times
from beamsplat.tools.training.recording_aggregation import RecordingAggregation
from beamsplat.tools.training.sample_files import TrainingSample

_SCANS_PER_IMAGE = 3  # that the lidar map receives
_NEAREST_M = 0.28  # images with nearer surfaces are left out: the camera is in an object
_KEYFRAME_M, _KEYFRAME_RAD = 0.3, np.radians(15.0)
# Inputs that are missing for a stretch of images, with their probabilities.
_FAULTS = {
    "none": 0.64, "no beams": 0.05, "few beams": 0.07, "few images": 0.08, "no keyframes": 0.08,
    "restart": 0.08,
}  # fmt: skip
_STRETCH = (3, 9)  # images


@dataclass(frozen=True)
class DriveScene:
    """A home with a renderer and, if there are people, their light and shape."""

    home: TrainingHome
    renderer: SceneRenderer
    actors: ActorSet | None
    lighting: ActorLighting | None


@dataclass(frozen=True)
class DriveSettings:
    """How images follow one another, and which of them become samples."""

    step_m: float  # between images
    step_rad: float
    images: int  # at most
    sample_every: int  # images per sample


class _Exposure:
    """Exposure gain and white balance that drift and sometimes jump from image to image."""

    def __init__(self, gain: float, rng: np.random.Generator) -> None:
        self._gain, self._rng = gain, rng
        self._stops, self._tint = 0.0, rng.normal(0.0, 0.06, 3)

    def next(self) -> tuple[float, np.ndarray]:
        """Return the exposure gain, and the factors on red, green and blue [3], of the next image."""
        jump = self._rng.normal(0.0, 0.6) if self._rng.random() < 0.04 else 0.0
        self._stops = float(np.clip(0.93 * self._stops + self._rng.normal(0.0, 0.12) + jump, -1.5, 1.3))
        self._tint = 0.95 * self._tint + self._rng.normal(0.0, 0.012, 3)
        return self._gain * 2.0**self._stops, np.exp(self._tint)


class TrainingDrive:
    """One drive through a home; yields a sample for every n-th of its images."""

    def __init__(
        self, scene: DriveScene, motion: Motion, sensors: SensorSet, gain: float,
        sources: tuple[DepthSource | None, ...], rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Prepare a drive.

        Args:
            gain: exposure gain of a well exposed image.
            sources: depth sources, one of which is drawn for each stretch of images; None = no estimate.
        """
        self._scene, self._motion, self._sensors, self._rng = scene, motion, sensors, rng
        self._exposure, self._sources = _Exposure(gain, rng), sources
        self._aggregation = RecordingAggregation()
        self._restart()

    def _restart(self) -> None:
        """Forget all earlier images, as after a start of the fusion service."""
        s = self._sensors
        self._sweep = PlaneSweep(
            s.camera, s.T_body_camera_published, floor_known=s.planar, planar=s.planar,
            aggregation=self._aggregation,
        )  # fmt: skip
        self._last_keyframe: np.ndarray | None = None

    def samples(self, settings: DriveSettings) -> Iterator[TrainingSample]:
        """Yield the samples of the drive in the order of time."""
        fault, source, left = "none", self._sources[0], 0
        times = image_times(self._motion, settings.step_m, settings.step_rad, settings.images, self._rng)
        for number, time_s in enumerate(times):
            if left == 0:
                names = list(_FAULTS)
                fault = str(self._rng.choice(names, p=list(_FAULTS.values())))
                source = self._sources[int(self._rng.integers(len(self._sources)))]
                left = int(self._rng.integers(*_STRETCH))
                if fault == "restart" and number > 0:
                    self._restart()
            left -= 1
            is_sample = number > 0 and number % settings.sample_every == 0
            sample = self._image(time_s, fault, source, is_sample)
            if sample is not None:
                yield sample

    def _image(
        self, time_s: float, fault: str, source: DepthSource | None, is_sample: bool
    ) -> TrainingSample | None:
        s, rng, motion = self._sensors, self._rng, self._motion
        lighting = self._scene.lighting
        world_s = (motion.start_s + time_s) % self._scene.home.drive.lap_s
        actors = None if lighting is None else lighting.snapshot(world_s)
        radiance, depth_m = render_exposed(
            self._scene.renderer, s.table, lambda t: motion.pose_at(t) @ s.T_body_camera, time_s, s.shutter,
            actors,
        )  # fmt: skip
        known = depth_m[np.isfinite(depth_m)]
        if len(known) == 0 or np.percentile(known, 2) < _NEAREST_M:
            return None
        rgb = develop(s.sensor, radiance, *self._exposure.next(), rng)
        T_world_body = motion.pose_at(time_s)
        T_map_body = s.noisy_pose(T_world_body, rng)
        beams = s.scan(self._scene.home.caster, actors, T_world_body, rng)
        if s.planar:
            for _ in range(_SCANS_PER_IMAGE):
                scan = s.scan(self._scene.home.caster, actors, T_world_body, rng)
                self._sweep.add_scan(transform_points(T_map_body, scan.points_body_m))
        frame = self._frame(time_s, rgb, T_map_body, self._faulty(beams, fault), source)
        working = self._sweep.downscale(frame)
        sample = None
        if is_sample or self._is_keyframe(T_map_body):
            warped = self._sweep.warp_into(working)
            if fault == "no keyframes":
                unknown = np.full_like(warped.depth_m, np.nan)
                warped = WarpedDepth(unknown, np.zeros_like(warped.votes))
            views = self._sweep.choose_views(working.T_map_camera)
            task = self._sweep.prepare(frame, working, views, warped)
            self._sweep.sweep(task)
            self._sweep.commit(task)
            self._last_keyframe = T_map_body
            sample = self._sample(depth_m) if is_sample else None
        if fault != "few images" or rng.random() < 0.3:
            self._sweep.keep(working)
        return sample

    def _frame(
        self, time_s: float, rgb: np.ndarray, T_map_body: np.ndarray, beams: Beams, source: DepthSource | None
    ) -> FusionInput:
        s = self._sensors
        frame = FusionInput(round(time_s * 1e9), rgb, T_map_body, beams)
        if source is None:
            return frame
        view = DepthInput(frame.stamp_ns, rgb, s.camera, s.T_body_camera_published, beams, s.planar)
        estimate = source.estimate(view)
        if not estimate.ok or estimate.kind == "none":
            return frame
        return replace(frame, estimate=estimate.values, estimate_kind=estimate.kind)

    def _faulty(self, beams: Beams, fault: str) -> Beams:
        if fault == "no beams":
            return NO_BEAMS
        if fault == "few beams":
            return beams.take(self._rng.random(len(beams)) < self._rng.uniform(0.3, 0.7))
        return beams

    def _is_keyframe(self, T_map_body: np.ndarray) -> bool:
        if self._last_keyframe is None:
            return True
        T = inverse(self._last_keyframe) @ T_map_body
        turn = np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
        return bool(np.linalg.norm(T[:3, 3]) > _KEYFRAME_M or turn > _KEYFRAME_RAD)

    def _sample(self, depth_m: np.ndarray) -> TrainingSample:
        inputs, matched = self._aggregation.inputs, self._aggregation.depth_m
        assert inputs is not None  # `refine` has just stored them
        assert matched is not None
        return TrainingSample(
            inputs, depth_mm(depth_m), np.log(matched).astype(np.float16), self._sensors.carrier
        )
