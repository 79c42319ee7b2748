"""The depth service: a dense depth estimate for the newest image, computed by the configured depth source."""

from __future__ import annotations

import logging
from collections import deque
from typing import Any

import numpy as np
from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.geometry.sensor_history import SensorHistory, TimedScan
from beamsplat.common.messages import DepthEstimate, Image, Odometry, Rig, Scan
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.runtime.node import Input, Node, Outputs
from beamsplat.services.depth.source import (
    IGNORES_IMAGE,
    DepthInput,
    DepthSource,
    Kind,
    check_source,
    make_source,
    uses_beams,
)

log = logging.getLogger("beamsplat.depth")

_IMAGES = 8  # that may wait for their pose


class DepthConfig(NodeConfig):
    """Options of the depth service. `options` are passed to the depth source `source`, which checks them."""

    source: Remote[str] = "stixel"
    options: dict[str, Any] = Field(default_factory=dict)
    floor_known: Remote[bool] = True  # the camera height in the calibration is reliable


class DepthNode(Node):
    """Publishes a depth estimate per image; sources that use beams wait for the pose at the image time."""

    name = "depth"
    Config = DepthConfig
    config: DepthConfig
    replaceable = True
    inputs = (Input("rig", "every"), "camera/image", "lidar/scan", "localization/odometry")
    outputs = ("depth/estimate",)

    def configure(self) -> None:
        self._source: DepthSource = make_source(self.config.source, self.config.options)
        self._needs_beams = uses_beams(self.config.source, self._source)
        self._undistort: Undistorter | None = None
        self._history: SensorHistory | None = None
        self._waiting: deque[Image] = deque(maxlen=_IMAGES)
        self.overtaken = 0

    def check_resources(self) -> None:
        """Check the source's name, options and files."""
        check_source(self.config.source, self.config.options)

    def on_rig(self, rig: Rig) -> Outputs:
        """Set up the camera and the lidar of this robot; without a camera the node publishes nothing."""
        if rig.camera is None:
            log.error("the calibration has no camera: depth is not estimated; add [camera] to the rig file")
        else:
            camera = rig.camera
            self._undistort = Undistorter(Pinhole.of(camera))
            self._T_body_camera = camera.T_body_camera
            T_body_lidar = rig.lidar.T_body_lidar if rig.lidar is not None else np.eye(4)
            self._history = SensorHistory(T_body_lidar, complete_only=False)
        return iter(())

    def on_lidar_scan(self, scan: Scan) -> Outputs:
        if self._history is not None:
            self._history.add_scan(TimedScan.of(scan))
        return iter(())

    def on_localization_odometry(self, odometry: Odometry) -> Outputs:
        """Store a pose, then process the newest image for which a pose was missing until now."""
        if self._history is not None and odometry.status == "ok":
            self._history.add_pose(odometry.stamp_ns, odometry.T_odom_body)
            yield from self._estimate_waiting()

    def on_camera_image(self, image: Image) -> Outputs:
        """Queue an image until the pose at its time is known, which is about one scan later."""
        if self._undistort is not None:
            if len(self._waiting) == _IMAGES:  # poses are late: the oldest image is dropped and counted
                self._count_overtaken()
            self._waiting.append(image)
            yield from self._estimate_waiting()

    def _count_overtaken(self) -> None:
        self.overtaken += 1
        self.rejections.set("images overtaken by newer ones", self.overtaken)
        self.detail = f"{self.overtaken} images overtaken"

    def _estimate_waiting(self) -> Outputs:
        """Process the newest image whose pose is known; older images are dropped and counted as overtaken.

        A source that does not look at the image takes milliseconds: it processes the older images too.
        """
        image = None
        assert self._history is not None  # images are queued after the calibration only
        while self._waiting:
            if self._needs_beams and self._waiting[0].stamp_ns > self._history.newest_pose_ns:
                break
            if image is not None and self.config.source in IGNORES_IMAGE:
                yield from self._estimate(image)
            elif image is not None:
                self._count_overtaken()
            image = self._waiting.popleft()
        if image is not None:
            yield from self._estimate(image)

    def _estimate(self, image: Image) -> Outputs:
        assert self._history is not None  # images are queued after the calibration only
        assert self._undistort is not None
        try:
            rgb = self._decode_image(image, self._undistort)
        except (UserError, ValueError) as error:
            yield self._rejection(image.stamp_ns, str(error))
            return
        beams, _ = self._history.beams(image.stamp_ns)
        view = DepthInput(
            image.stamp_ns, rgb, self._undistort.pinhole, self._T_body_camera, beams, self.config.floor_known
        )
        estimate = self._source.estimate(view)
        if not estimate.ok or estimate.kind == "none":
            yield self._rejection(image.stamp_ns, estimate.status, estimate.kind)
            return
        yield (
            "depth/estimate",
            DepthEstimate(
                stamp_ns=image.stamp_ns, source=self.config.source, kind=estimate.kind, values=estimate.values
            ),
        )

    def _decode_image(self, image: Image, undistort: Undistorter) -> np.ndarray:
        """Return the undistorted image uint8 [H, W, 3]; a black image if the depth source ignores images.

        Raises:
            UserError, ValueError: the image cannot be decoded, or its size differs from the calibration.
        """
        shape = undistort.pinhole.shape
        if self.config.source in IGNORES_IMAGE and (image.height_px, image.width_px) == shape:
            return np.broadcast_to(np.uint8(0), (*shape, 3))
        return undistort(
            decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)
        )

    def _rejection(self, stamp_ns: int, status: str, kind: Kind = "none") -> tuple[str, DepthEstimate]:
        empty = np.zeros((0, 0), np.float32)
        message = DepthEstimate(
            stamp_ns=stamp_ns, source=self.config.source, kind=kind, values=empty, status=status
        )
        return "depth/estimate", message
