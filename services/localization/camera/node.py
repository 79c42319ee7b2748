"""Camera localization node: images and depth in; pose with covariance and metric flag out."""

from __future__ import annotations

import logging
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.engines.choice import EngineName, check_cuda, make_splat_engine
from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.messages import Correction, DepthEstimate, Image, Odometry, Rig
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.runtime.node import Input, Node, Outputs
from beamsplat.services.localization.camera.depth import DepthPrior
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.tracker import CameraTracker, TrackingResult
from beamsplat.services.localization.camera.warm import warm

log = logging.getLogger("beamsplat.localization")

_ENGINE_OPTION = "localization.engine"
ARBITRARY_SCALE = "scale is arbitrary: the depth has no unit, lengths are not metres"


class CameraLocalizationConfig(NodeConfig):
    """Properties of the robot and of its depth source.

    `depth = "estimate"` uses the depth maps of the depth service, in metres or in an arbitrary unit, as
    marked in its messages; "none" uses the camera alone.
    `scale_sigma` is the standard deviation of the log scale of the depth between images.
    `engine` holds and renders the map of the tracker: "cpu" needs no torch; "auto" is the GPU if there is one
    with a driver and torch, else the CPU.
    """

    depth: Literal["estimate", "none"] = "estimate"
    scale_sigma: Remote[Annotated[float, Field(ge=0.0, le=2.0)]] = 0.15
    planar: Remote[bool] = True  # the body stays level on a floor
    width_px: Annotated[int, Field(ge=64, le=1280)] = 320
    engine: EngineName = "cpu"


class CameraLocalization(Node):
    """Localization service that tracks the camera against a Gaussian map by rendering and comparison."""

    name = "localization"
    Config = CameraLocalizationConfig
    config: CameraLocalizationConfig
    # The depth service may itself use the poses of this node: do not wait for its end of stream.
    inputs = (Input("rig", "every"), Input("camera/image", "latest"), Input("depth/estimate", feedback=True))
    outputs = ("localization/odometry", "localization/correction")

    def check_resources(self) -> None:
        """Check that the engine can run here."""
        if self.config.engine == "cuda":
            check_cuda(_ENGINE_OPTION)

    def configure(self) -> None:
        cv2.setNumThreads(1)
        warm()
        self._tracker: CameraTracker | None = None

    def on_rig(self, rig: Rig) -> Outputs:
        """Create the tracker from the first calibration; ignore later ones, which would distort the map."""
        if rig.camera is None:
            log.error("the calibration has no camera: images cannot be used")
        elif self._tracker is None:
            c = rig.camera
            lens = Pinhole.of(c)
            self._undistort = Undistorter(lens)
            settings = CameraTrackerSettings(planar=self.config.planar, width_px=self.config.width_px)
            engine = make_splat_engine(self.config.engine, _ENGINE_OPTION)
            self._tracker = CameraTracker(self._undistort.pinhole, c.T_body_camera, settings, engine)
            # The map and odom frames are identical, because the estimate is never corrected.
            yield "localization/correction", Correction(stamp_ns=rig.stamp_ns, T_map_odom=np.eye(4))
        else:
            log.warning("a new calibration is ignored: restart the node to use it")

    def on_camera_image(self, image: Image) -> Outputs:
        """Publish the pose of the body for an image; without a pose, the status is the reason."""
        if self._tracker is None:
            yield "localization/odometry", _rejected(image.stamp_ns, "no calibration yet")
            return
        try:
            rgb = self._undistort(
                decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)
            )
        except (UserError, ValueError) as error:
            yield "localization/odometry", _rejected(image.stamp_ns, str(error))
            return
        result = self._tracker.track(image.stamp_ns, rgb)
        if self.config.depth == "none" and result.status in ("ok", "relocalizing"):
            self._tracker.add_without_depth(image.stamp_ns)
        self._set_detail(self._tracker, result)
        yield "localization/odometry", _odometry(self._tracker, result)

    def on_depth_estimate(self, estimate: DepthEstimate) -> Outputs:
        """Add the image of this depth estimate as a keyframe, if the tracker needs a new one."""
        if self._tracker is None or self.config.depth == "none":
            return iter(())
        if estimate.kind == "none" and estimate.status == "ok":
            self._tracker.add_without_depth(estimate.stamp_ns)
        elif estimate.status == "ok":
            z = estimate.values
            if estimate.kind == "disparity":
                with np.errstate(divide="ignore", invalid="ignore"):
                    z = np.where(z > 1e-6, 1.0 / z, np.nan).astype(np.float32)
            prior = DepthPrior(z, self.config.scale_sigma, estimate.kind == "metric")
            self._tracker.add_depth(estimate.stamp_ns, prior)
        return iter(())

    def close(self) -> None:
        tracker: CameraTracker | None = getattr(self, "_tracker", None)
        if tracker is not None:
            tracker.close()

    def _set_detail(self, t: CameraTracker, result: TrackingResult) -> None:
        """Set the text of the health message of this node."""
        parts = [f"{len(t.splats.keyframes)} keyframes, {t.splats.count} Gaussians", result.detail]
        if t.metric is False:
            parts.append(ARBITRARY_SCALE)
        if np.isfinite(t.scale_disagreement) and abs(t.scale_disagreement) > 0.05:
            parts.append(f"new depth is {np.exp(t.scale_disagreement):.2f} times the map's")
        parts.append(t.splats.engine.description)
        self.detail = "; ".join(text for text in parts if text)


def _odometry(tracker: CameraTracker, result: TrackingResult) -> Odometry:
    metric = bool(tracker.metric)
    scale = "" if metric or tracker.metric is None else ARBITRARY_SCALE
    return Odometry(
        stamp_ns=result.stamp_ns, T_odom_body=result.T_map_body, covariance=result.covariance,
        status=result.status, detail="; ".join(t for t in (result.detail, scale) if t), metric=metric,
    )  # fmt: skip


def _rejected(stamp_ns: int, why: str) -> Odometry:
    return Odometry(
        stamp_ns=stamp_ns, T_odom_body=np.eye(4), covariance=np.full((3, 3), np.nan), status="rejected",
        detail=why, metric=False,
    )  # fmt: skip
