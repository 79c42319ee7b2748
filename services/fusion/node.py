"""The fusion service: metric depth with its standard deviation, from beams, floor, images and estimate."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import scan_points
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.keyframe_selection import KeyframeSelector, field_of_view, sharpness
from beamsplat.common.geometry.sensor_history import SensorHistory, TimedScan
from beamsplat.common.geometry.transforms import transform_points
from beamsplat.common.messages import (
    Cloud,
    DepthEstimate,
    FusedDepth,
    Image,
    KeyframeCandidate,
    KeyframeDecision,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)  # fmt: skip
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.runtime.node import Input, Job, Node, Outputs
from beamsplat.services.fusion.aggregation_choice import (
    AggregationName,
    check_aggregation,
    make_aggregation,
)
from beamsplat.services.fusion.calibration.startup_check import CalibrationHealth, StartupCheck
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.result import FusionResult
from beamsplat.services.fusion.single_image import SingleImageFusion

log = logging.getLogger("beamsplat.fusion")

_IMAGES = 8  # kept until their depth estimate arrives
_DECISION_PATIENCE_NS = 1_000_000_000  # a candidate without a decision is dropped after this data time
_CHECK_AFTER_SCANS = 100  # result of the calibration check after 10 s at 10 Hz; it takes 1 to 2 s


class FusionConfig(NodeConfig):
    """Options of fusion: method and properties of the robot."""

    # field: plane sweep with all priors; ratio: the paper's one factor per image; affine: scale and shift of
    # inverse depth; given: the estimate unchanged (robots without a lidar).
    method: Remote[Literal["field", "ratio", "affine", "given"]] = "field"
    floor_known: Remote[bool] = True  # the camera height in the calibration is reliable
    planar: Remote[bool] = True  # the body stays level on a floor
    cloud_every_px: Remote[int] = 4  # pixels per point of the cloud, in each direction
    # Of the plane sweep (method `field`). sgm: semi-global matching; learned: a network.
    aggregation: Remote[AggregationName] = "sgm"
    aggregation_weights: Path | None = None  # for "learned": a file of `beamsplat train aggregator`
    check_pairs: Remote[int] = Field(60, ge=0)  # image pairs for the check of the calibration; 0 = none


@dataclass(frozen=True)
class _Candidate:
    """An image that is ready for fusion, with the age of its beams."""

    frame: FusionInput
    age_ns: int


class FusionNode(Node):
    """Publishes metric depth per image and a point cloud per keyframe, in the continuous odom frame.

    A plane sweep needs several times more computation than depth between keyframes. Therefore each image is
    first a candidate, and the keyframes service decides whether the image becomes a keyframe (plane sweep) or
    not. In a deployment without that service, the fusion service decides by the same rule.
    """

    name = "fusion"
    Config = FusionConfig
    config: FusionConfig
    inputs = (
        Input("rig", "every"),
        Input("camera/image", "every"),  # every image, so that each estimate finds its image
        "depth/estimate",
        "lidar/scan",
        "localization/odometry",
        "localization/movers",
        Input("wheel/odometry", "latest"),  # for the check of the calibration only
        Input("keyframes/decision", feedback=True),
    )
    outputs = ("keyframes/candidate", "fusion/depth", "fusion/cloud")

    def configure(self) -> None:
        self._fusion: Fusion | SingleImageFusion | None = None
        self._check: StartupCheck | None = None  # of the calibration; only `field` has one
        self._images: deque[Image] = deque(maxlen=_IMAGES)
        self._estimates: deque[DepthEstimate] = deque(maxlen=_IMAGES)
        self._candidate: _Candidate | None = None  # waits for the decision of the keyframes service
        self._rig: Rig | None = None
        self._localizer = ""  # instance of the localization process
        self.calibration: CalibrationHealth | None = None
        self.overtaken = 0
        c = self.config
        self._aggregation = make_aggregation(c.aggregation, c.aggregation_weights, c.method)

    def check_resources(self) -> None:
        """Check the options of the aggregation, and that its weights file exists."""
        c = self.config
        check_aggregation(c.aggregation, c.aggregation_weights, c.method)

    def on_header(self, header: Header) -> None:
        """Reset if the header is from another localization process, which has another odom frame."""
        if header.producer != "localization" or header.instance == self._localizer:
            return
        if self._localizer and self._rig is not None:
            log.info("localization was restarted: fusion is reset")
            checked = self._check is not None and self._check.done
            self.on_rig(self._rig)
            if self._check is not None and checked:
                self._check.done = True
        self._localizer = header.instance

    def on_rig(self, rig: Rig) -> Outputs:
        """Set up camera and lidar; both are required, except for the method `given`."""
        method = self.config.method
        if rig.camera is None or (rig.lidar is None and method != "given"):
            log.error("the calibration has no camera or no lidar: depth is not fused; complete the rig file")
            return iter(())
        self._rig, camera, self._candidate = rig, rig.camera, None
        self._selector = KeyframeSelector(field_of_view(Pinhole.of(camera)))
        self._undistort = Undistorter(Pinhole.of(camera))
        self._T_body_camera = camera.T_body_camera
        self._history = SensorHistory(np.eye(4) if rig.lidar is None else rig.lidar.T_body_lidar)
        if method != "field":
            self._fusion = SingleImageFusion(self._undistort.pinhole, camera.T_body_camera, method)
            return iter(())
        self._fusion = Fusion(
            self._undistort.pinhole, camera.T_body_camera, floor_known=self.config.floor_known,
            planar=self.config.planar, aggregation=self._aggregation,
        )  # fmt: skip
        assert rig.lidar is not None  # checked above
        self._check = StartupCheck(
            self._undistort.pinhole, camera.T_body_camera, rig.lidar.T_body_lidar, self.config.check_pairs
        )
        self._check.done = self.config.check_pairs == 0
        return iter(())

    def on_lidar_scan(self, scan: Scan) -> Outputs:
        if self._fusion is not None:
            expired = self._history.expired
            self._history.add_scan(TimedScan.of(scan))
            if self._history.expired != expired:
                self._update_detail()
        return iter(())

    def on_wheel_odometry(self, odometry: WheelOdometry) -> Outputs:
        """Store a pose of the wheels, which tell whether the lidar is mirrored or turned on its mount."""
        if self._check is not None:
            self._check.add_wheels(odometry.stamp_ns, odometry.T_odom_body)
        return iter(())

    def on_localization_movers(self, movers: MovingBeams) -> Outputs:
        """Mark the beams on dynamic objects, so that they are not used as walls."""
        if self._fusion is not None:
            self._history.add_mask(movers.stamp_ns, movers.moving)
        return iter(())

    def on_localization_odometry(self, odometry: Odometry) -> Outputs:
        """Store a pose; then process the scans and the image for which poses were missing until now."""
        if self._fusion is None or odometry.status != "ok":
            return
        for scan in self._history.add_pose(odometry.stamp_ns, odometry.T_odom_body):
            self._fusion.add_scan(self._history.scan_points_a(scan))
            self._add_to_check(scan)
        if self._check is not None and not self._check.done:
            self._check.add_pose(odometry.stamp_ns, odometry.T_odom_body)
            job = self._check.job()
            if job is not None:
                yield Job("check_calibration", job, after=_CHECK_AFTER_SCANS, of="lidar/scan")
            self._update_detail()
        yield from self._fuse_if_ready()

    def _add_to_check(self, scan: TimedScan) -> None:
        T_odom_body = self._history.pose(scan.middle_ns)
        if self._check is not None and not self._check.done and T_odom_body is not None:
            points, _ = scan_points(
                scan.ranges_m,
                scan.angle_min_rad,
                scan.angle_increment_rad,
                scan.range_min_m,
                scan.range_max_m,
            )
            self._check.add_scan(points, T_odom_body)

    def on_job_check_calibration(self, health: CalibrationHealth) -> Outputs:
        """Log the result of the calibration check, and show the result in the health detail of this node."""
        self.calibration = health
        if health.cause != "unchecked":
            self.figures.set("calibration_doubts", health.status != "ok")
        (log.info if health.status == "ok" else log.error)("%s", health.line)
        self._update_detail()
        return iter(())

    def _update_detail(self) -> None:
        """Update the health detail: dropped (overtaken) estimates, scans without a pose, the calibration."""
        self.rejections.set("estimates overtaken by newer ones", self.overtaken)
        overtaken = f"{self.overtaken} estimates overtaken" if self.overtaken else ""
        expired = self._history.expired if self._fusion is not None else 0
        without_pose = f"{expired} scans without a pose" if expired else ""
        if self.calibration is not None:
            calibration = self.calibration.line
        else:
            check = self._check
            calibration = check.progress if check is not None and not check.done else ""
        self.detail = "; ".join(text for text in (overtaken, without_pose, calibration) if text)

    def on_camera_image(self, image: Image) -> Outputs:
        self._images.append(image)
        yield from self._fuse_if_ready()

    def on_depth_estimate(self, estimate: DepthEstimate) -> Outputs:
        """Queue an estimate until the pose at its time is known."""
        self._estimates.append(estimate)
        yield from self._fuse_if_ready()

    def _fuse_if_ready(self) -> Outputs:
        """Process the newest image that has an estimate and a pose; older images are dropped and counted."""
        if self._candidate is not None:
            asked_ns = self._candidate.frame.stamp_ns
            newest_ns = self._estimates[-1].stamp_ns if self._estimates else asked_ns
            if abs(newest_ns - asked_ns) < _DECISION_PATIENCE_NS:  # also if the clock was set back
                return
            self._candidate = None  # the keyframes service does not answer
            self.overtaken += 1
        ready = None
        while self._fusion is not None and self._estimates:
            if self._estimates[0].stamp_ns > self._history.newest_pose_ns:
                break
            self.overtaken += ready is not None
            ready = self._estimates.popleft()
        if ready is None:
            return
        self._update_detail()
        image = next((p for p in self._images if p.stamp_ns == ready.stamp_ns), None)
        if image is None:  # its image was lost, or is no longer kept
            self.overtaken += 1
            return
        yield from self._propose(image, ready)

    def _propose(self, image: Image, estimate: DepthEstimate) -> Outputs:
        """Publish the image as a keyframe candidate; the image is processed when the decision arrives."""
        T_odom_body = self._history.pose(image.stamp_ns)
        try:
            rgb = self._undistort(
                decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)
            )
        except (UserError, ValueError) as error:
            yield "fusion/depth", _rejected(image.stamp_ns, str(error))
            return
        if T_odom_body is None:
            yield "fusion/depth", _rejected(image.stamp_ns, "no pose at the time of the image")
            return
        if self._check is not None:
            self._check.add_image(image.stamp_ns, rgb, T_odom_body)
        beams, age_ns = self._history.beams(image.stamp_ns)
        usable = estimate.status == "ok" and estimate.kind != "none"
        frame = FusionInput(
            image.stamp_ns, rgb, T_odom_body, beams, estimate.values if usable else None,
            estimate.kind if usable else "none",
        )  # fmt: skip
        candidate, sharp = _Candidate(frame, age_ns), sharpness(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        if "keyframes/decision" in self.without_producer:
            selection = self._selector.decide(T_odom_body @ self._T_body_camera, sharp)
            yield from self._fuse(candidate, selection.selected)
            return
        self._candidate = candidate
        yield (
            "keyframes/candidate",
            KeyframeCandidate(stamp_ns=image.stamp_ns, T_odom_body=T_odom_body, sharpness=sharp),
        )

    def on_keyframes_decision(self, decision: KeyframeDecision) -> Outputs:
        """Process the candidate to which the decision belongs, then continue with the newest image."""
        candidate = self._candidate
        if candidate is None or candidate.frame.stamp_ns != decision.stamp_ns:
            return
        self._candidate = None
        yield from self._fuse(candidate, decision.keyframe)
        yield from self._fuse_if_ready()

    def awaits_feedback(self) -> bool:
        """Return whether a candidate waits for the decision of the keyframes service."""
        return self._candidate is not None

    def on_feedback_timeout(self, seconds: float) -> Outputs:
        """Drop the waiting candidate, because the keyframes service no longer answers."""
        if self._candidate is not None:
            self._candidate = None
            self.overtaken += 1
        return iter(())

    def _fuse(self, candidate: _Candidate, keyframe: bool) -> Outputs:
        """Publish the depth of one image, and the point cloud if the image is a keyframe."""
        frame = candidate.frame
        assert self._fusion is not None  # candidates exist after the calibration only
        fused = self._fusion.fuse(frame, keyframe=keyframe)
        if not fused.ok:
            if keyframe:
                self._selector.withdraw()
            yield "fusion/depth", _rejected(frame.stamp_ns, fused.status, keyframe)
            return
        T_odom_body = frame.T_map_body
        yield "fusion/depth", _message(frame.stamp_ns, fused, keyframe, candidate.age_ns, T_odom_body)
        if keyframe:
            yield "fusion/cloud", self._cloud(frame.stamp_ns, fused, frame.image_rgb, T_odom_body)

    def _cloud(self, stamp_ns: int, fused: FusionResult, rgb: np.ndarray, T_odom_body: np.ndarray) -> Cloud:
        every = self.config.cloud_every_px
        depth = fused.depth_m[::every, ::every]
        known = np.isfinite(depth)
        points = (self._undistort.pinhole.ray_grid()[::every, ::every] * depth[..., None])[known]
        return Cloud(
            stamp_ns=stamp_ns,
            points_odom_m=transform_points(T_odom_body @ self._T_body_camera, points).astype(np.float32),
            colours=rgb[::every, ::every][known],
        )


def _message(
    stamp_ns: int, fused: FusionResult, keyframe: bool, age_ns: int, T_odom_body: np.ndarray
) -> FusedDepth:
    return FusedDepth.of(
        fused.depth_m,
        fused.sigma_m,
        stamp_ns=stamp_ns,
        keyframe=keyframe,
        scale=float(fused.scale),
        scale_sigma=float(fused.scale_sigma),
        inlier_share=float(fused.inlier_share),
        residual_m=float(fused.residual_m),
        pairs=fused.pairs,
        beams_age_ns=age_ns,
        T_odom_body=T_odom_body,
    )


def _rejected(stamp_ns: int, status: str, keyframe: bool = False) -> FusedDepth:
    empty = np.zeros(0, np.uint8)
    return FusedDepth(stamp_ns=stamp_ns, depth=empty, sigma=empty, status=status, keyframe=keyframe)
