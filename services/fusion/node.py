"""The fusion service: metric depth with its standard deviation, from beams, floor, images and estimate."""

from __future__ import annotations

import logging
from collections import deque
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
from beamsplat.common.messages import (
    DepthEstimate,
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
from beamsplat.services.fusion.fuse import Fusion, SweptKeyframe
from beamsplat.services.fusion.image_work import CandidateImage, FusedImage, ImageWork
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.messages import cloud_message, depth_message, rejected_message
from beamsplat.services.fusion.single_image import SingleImageFusion
from beamsplat.services.fusion.warm import warm

log = logging.getLogger("beamsplat.fusion")

_IMAGES = 16  # kept until their depth estimate arrives
_ESTIMATES = 8  # that wait for their pose, or for this node
_UNDECIDED = 8  # candidates without a decision
_DECISION_PATIENCE_NS = 1_000_000_000  # a candidate without a decision is dropped after this data time
_CHECK_AFTER_SCANS = 100  # result of the calibration check after 10 s at 10 Hz; it takes 1 to 2 s


class FusionConfig(NodeConfig):
    """Options of fusion: method and properties of the robot."""

    # field: plane sweep with all priors; poisson: its keyframes completed with the gradients of the estimate
    # (of a network); ratio: the paper's one factor per image; affine: scale and shift of inverse depth;
    # given: the estimate unchanged (robots without a lidar).
    method: Remote[Literal["field", "poisson", "ratio", "affine", "given"]] = "field"
    floor_known: Remote[bool] = True  # the camera height in the calibration is reliable
    planar: Remote[bool] = True  # the body stays level on a floor
    cloud_every_px: Remote[int] = 4  # pixels per point of the cloud, in each direction
    # Of the plane sweep (`field`, `poisson`). sgm: semi-global matching; learned: a network.
    aggregation: Remote[AggregationName] = "sgm"
    aggregation_weights: Path | None = None  # for "learned": a file of `beamsplat train aggregator`
    check_pairs: Remote[int] = Field(60, ge=0)  # image pairs for the check of the calibration; 0 = none


class FusionNode(Node):
    """Publishes metric depth per image and a point cloud per keyframe, in the continuous odom frame.

    A plane sweep needs several times more computation than depth between keyframes. Therefore each image is
    first a candidate, and the keyframes service decides whether the image becomes a keyframe (plane sweep) or
    not. In a deployment without that service, the fusion service decides by the same rule.

    The plane sweep is a background job, one at a time, so that it delays no other image. Images between
    keyframes use the newest depth that is finished. Results are published in the order of the images.
    """

    name = "fusion"
    Config = FusionConfig
    config: FusionConfig
    inputs = (
        Input("rig", "every"),
        Input("camera/image", "every"),  # every image, so that each estimate finds its image
        Input("depth/estimate", "latest", keep=3),
        "lidar/scan",
        "localization/odometry",
        "localization/movers",
        Input("wheel/odometry", "latest"),  # for the check of the calibration only
        Input("keyframes/decision", feedback=True),
    )
    outputs = ("keyframes/candidate", "fusion/depth", "fusion/cloud")

    def configure(self) -> None:
        if self.config.method == "field" and self.live_settings is not None:
            warm()  # else the first images of a drive wait for the kernels, and get no depth
        self._fusion: Fusion | SingleImageFusion | None = None
        self._check: StartupCheck | None = None  # of the calibration; only `field` has one
        self._images: deque[Image] = deque(maxlen=_IMAGES)
        self._estimates: deque[DepthEstimate] = deque()
        self._undecided: dict[int, CandidateImage] = {}  # by stamp: wait for the keyframes service's decision
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
        self._rig, camera = rig, rig.camera
        self._undecided.clear()
        self._selector = KeyframeSelector(field_of_view(Pinhole.of(camera)))
        self._undistort = Undistorter(Pinhole.of(camera))
        self._T_body_camera = camera.T_body_camera
        self._history = SensorHistory(np.eye(4) if rig.lidar is None else rig.lidar.T_body_lidar)
        if method != "field" and method != "poisson":
            self._fusion = SingleImageFusion(self._undistort.pinhole, camera.T_body_camera, method)
            self._work = ImageWork(self._fusion)
            return iter(())
        self._fusion = Fusion(
            self._undistort.pinhole, camera.T_body_camera, floor_known=self.config.floor_known,
            planar=self.config.planar, aggregation=self._aggregation, completes=method == "poisson",
        )  # fmt: skip
        self._work = ImageWork(self._fusion)  # unfinished work of another odom frame or rig is dropped
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
        yield from self._propose_ready()

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
        yield from self._propose_ready()

    def on_depth_estimate(self, estimate: DepthEstimate) -> Outputs:
        """Queue an estimate until the pose at its time is known."""
        if len(self._estimates) == _ESTIMATES:  # poses are late: the oldest is dropped and counted
            self._estimates.popleft()
            self._count_overtaken(1)
        self._estimates.append(estimate)
        yield from self._propose_ready()

    def _propose_ready(self) -> Outputs:
        """Propose all images that have an estimate and a pose, oldest first."""
        while self._fusion is not None and self._estimates:
            if self._estimates[0].stamp_ns > self._history.newest_pose_ns:
                break
            estimate = self._estimates.popleft()
            image = next((p for p in self._images if p.stamp_ns == estimate.stamp_ns), None)
            if image is None:  # its image was lost, or is no longer kept
                self._count_overtaken(1)
            else:
                yield from self._propose(image, estimate)

    def _count_overtaken(self, number: int) -> None:
        self.overtaken += number
        self._update_detail()

    def _propose(self, image: Image, estimate: DepthEstimate) -> Outputs:
        """Publish the image as a keyframe candidate; the image is processed when the decision arrives."""
        T_odom_body = self._history.pose(image.stamp_ns)
        try:
            rgb = self._undistort(
                decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)
            )
        except (UserError, ValueError) as error:
            yield from self._publish(self._work.refuse(image.stamp_ns, str(error)))
            return
        if T_odom_body is None:
            status = "no pose at the time of the image"
            yield from self._publish(self._work.refuse(image.stamp_ns, status))
            return
        if self._check is not None:
            self._check.add_image(image.stamp_ns, rgb, T_odom_body)
        beams, age_ns = self._history.beams(image.stamp_ns)
        usable = estimate.status == "ok" and estimate.kind != "none"
        frame = FusionInput(
            image.stamp_ns, rgb, T_odom_body, beams, estimate.values if usable else None,
            estimate.kind if usable else "none",
        )  # fmt: skip
        candidate, sharp = CandidateImage(frame, age_ns), sharpness(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        if "keyframes/decision" in self.without_producer:
            selection = self._selector.decide(T_odom_body @ self._T_body_camera, sharp)
            yield from self._take(candidate, selection.selected)
            return
        self._forget_undecided(image.stamp_ns)
        self._undecided[image.stamp_ns] = candidate
        yield (
            "keyframes/candidate",
            KeyframeCandidate(stamp_ns=image.stamp_ns, T_odom_body=T_odom_body, sharpness=sharp),
        )

    def _forget_undecided(self, now_ns: int) -> None:
        """Drop candidates that wait too long: the keyframes service does not answer."""
        for stamp_ns in list(self._undecided):
            late = abs(now_ns - stamp_ns) >= _DECISION_PATIENCE_NS  # also if the clock was set back
            if late or len(self._undecided) >= _UNDECIDED:
                del self._undecided[stamp_ns]
                self._count_overtaken(1)

    def on_keyframes_decision(self, decision: KeyframeDecision) -> Outputs:
        """Process the candidate to which the decision belongs."""
        candidate = self._undecided.pop(decision.stamp_ns, None)
        if candidate is not None:
            yield from self._take(candidate, decision.keyframe)

    def _take(self, candidate: CandidateImage, keyframe: bool) -> Outputs:
        postponed = self._work.postponed
        fused_images = self._work.take(candidate, keyframe)
        if self._work.postponed > postponed:  # the keyframes service does the same
            self._selector.withdraw(candidate.frame.T_map_body @ self._T_body_camera)
            self.rejections.add("keyframes postponed: earlier ones are still being computed")
        yield from self._publish(fused_images)

    def awaits_feedback(self) -> bool:
        """Return whether a candidate waits for the decision of the keyframes service."""
        return bool(self._undecided)

    def on_feedback_timeout(self, seconds: float) -> Outputs:
        """Drop the waiting candidates, because the keyframes service no longer answers."""
        if self._undecided:
            self._count_overtaken(len(self._undecided))
            self._undecided.clear()
        return iter(())

    def _publish(self, fused_images: list[FusedImage]) -> Outputs:
        """Publish results, those of keyframes with a point cloud; start the next plane sweep."""
        work = self._work
        if (sweep := work.next_sweep()) is not None:
            yield Job("sweep", lambda: (work, sweep()))
        for fused in fused_images:
            candidate, result = fused.candidate, fused.result
            if candidate is None or not result.ok:
                if candidate is not None and fused.keyframe:  # the keyframes service does the same
                    self._selector.withdraw(candidate.frame.T_map_body @ self._T_body_camera)
                yield "fusion/depth", rejected_message(fused.stamp_ns, result.status, fused.keyframe)
                continue
            yield "fusion/depth", depth_message(candidate, result, fused.keyframe)
            if fused.keyframe:
                camera, every_px = self._undistort.pinhole, self.config.cloud_every_px
                cloud = cloud_message(candidate.frame, result, camera, self._T_body_camera, every_px)
                yield "fusion/cloud", cloud

    def on_job_sweep(self, result: tuple[ImageWork, SweptKeyframe]) -> Outputs:
        """Publish the depth of a keyframe and of the images that have waited for it."""
        work, swept = result
        if work is self._work:  # else fusion was reset meanwhile: this depth is in an earlier odom frame
            yield from self._publish(work.finish_sweep(swept))
