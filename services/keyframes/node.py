"""The keyframes service: selects keyframes on the robot and publishes each with all data for mapping."""

from __future__ import annotations

import logging
from collections import deque
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.geometry.beams import project_beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.keyframe_selection import KeyframeSelector, SelectionSettings, field_of_view
from beamsplat.common.geometry.sensor_history import SensorHistory, TimedScan
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.messages import (
    Anchors,
    Correction,
    FusedDepth,
    Image,
    Keyframe,
    KeyframeAck,
    KeyframeCandidate,
    KeyframeDecision,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
)  # fmt: skip
from beamsplat.common.messages.codec import decode, encode, schema_of
from beamsplat.common.messages.depth_codec import pack_mask, packed_shape, unpack_depth
from beamsplat.common.messages.header import DecodeError, Header
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.messages.map import ODOM_ORIGIN
from beamsplat.common.runtime.node import Input, Node, Outputs
from beamsplat.services.keyframes.dynamic_mask import dynamic_object_mask
from beamsplat.services.keyframes.outbox import Outbox

log = logging.getLogger("beamsplat.keyframes")

_IMAGES = 64  # kept until their depth arrives: 6 s at 10 Hz
_CLOCK_STEP_NS = 600_000_000_000  # a larger step between the stamps of two images is not a duration
_BEAMS_NS = 120_000_000  # poses up to this long after an image place the scan around it (10 Hz lidars)
_BEAMS_PATIENCE_NS = 400_000_000  # the scan of a 5 Hz lidar is complete by then


class KeyframesConfig(NodeConfig):
    """Options of the keyframes service: selection, and outbox of keyframes not yet acknowledged."""

    distance_m: Remote[Annotated[float, Field(gt=0.0)]] = 0.3
    angle_rad: Remote[Annotated[float, Field(gt=0.0)]] = 0.26
    least_overlap: Remote[Annotated[float, Field(ge=0.0, lt=1.0)]] = 0.6
    patience: Remote[Annotated[int, Field(ge=1)]] = 2  # this image is taken even if it is blurred
    durable: bool = False  # live: unacknowledged keyframes are kept on disk, in the state folder
    queue_mb: Annotated[float, Field(gt=0.0)] = (
        64.0  # largest size of the outbox: about four keyframes per megabyte
    )
    retry_s: Remote[Annotated[float, Field(gt=0.0)]] = (
        10.0  # without acknowledgement, after which the oldest is sent again
    )
    window: Remote[Annotated[int, Field(ge=1)]] = 4  # most keyframes sent again that are in flight
    jpeg_quality: Remote[Annotated[int, Field(ge=50, le=100)]] = 95  # of images that arrive uncompressed


class KeyframesNode(Node):
    """Decides which images become keyframes, and publishes them with depth, beams and pose.

    All data of a keyframe are those of the image time; its pose is relative to the newest anchor. Fusion asks
    for the decision before it computes the depth of an image (`keyframes/candidate`). A selected image whose
    depth is rejected does not become a keyframe; a later image takes its place.
    """

    name = "keyframes"
    Config = KeyframesConfig
    config: KeyframesConfig
    inputs = (
        Input("rig", "every"),
        "lidar/scan",
        Input("camera/image", "every"),
        "localization/odometry",
        Input("localization/correction", "every"),
        Input("localization/anchors", "every"),
        "localization/movers",
        Input("keyframes/candidate", feedback=True),
        Input("fusion/depth", "every"),
        Input("keyframes/ack", feedback=True),
    )
    outputs = ("keyframes/decision", "keyframes/frame")

    def configure(self) -> None:
        self._history: SensorHistory | None = None
        self._rig: Rig | None = None
        self._images: deque[Image] = deque(maxlen=_IMAGES)
        self._depths: deque[FusedDepth] = deque(maxlen=_IMAGES)
        self._selector: KeyframeSelector | None = None
        self._undecided: deque[KeyframeCandidate] = deque(maxlen=_IMAGES)  # until the calibration is known
        # Stamp of a selected image -> its T_odom_camera and why it was selected; until its depth arrives.
        self._selected: dict[int, tuple[np.ndarray, str]] = {}
        self._T_map_odom = np.eye(4)
        self._localizer, self._map_uuid = "", ""  # the localization process, and its map
        self._reset_frame()
        c = self.config
        folder = (
            self.live_settings.run_dir / "keyframes" if c.durable and self.live_settings is not None else None
        )
        self._outbox = Outbox(round(c.queue_mb * 1e6), round(c.retry_s * 1e9), c.window, folder)
        self._now_ns = 0  # time that has passed in image stamps, without steps of the clock
        self._newest_ns = 0  # stamp of the newest image
        self._sent = self._sent_again = 0
        self._rejected = 0
        self._rejected_ids: deque[int] = deque(maxlen=_IMAGES)  # the mapper may reject a keyframe twice
        if self._outbox.of_earlier_drives:
            log.info(
                "%d unacknowledged keyframes of earlier drives are in %s",
                self._outbox.of_earlier_drives,
                folder,
            )
        if self._outbox.disk_fault:
            self._update_detail()

    def on_header(self, header: Header) -> None:
        """Reset if the header is from another localization process, which has another odom frame.

        The drive is named after its map, or after the localization process while the map is unknown.
        """
        if header.producer == "localization" and header.instance != self._localizer:
            if self._localizer:
                self._reset_frame()
                if self._rig is not None:
                    self._set_up(self._rig)
            self._localizer = self._outbox.drive = header.instance

    def _reset_frame(self) -> None:
        self._anchor_id, self._T_map_anchor, self._optimisation = ODOM_ORIGIN, np.eye(4), 0
        self._depths.clear()
        self._selected.clear()

    def on_rig(self, rig: Rig) -> Outputs:
        """Set up camera and lidar; a second calibration restarts the selection."""
        self._set_up(rig)
        yield from self._decide()

    def _set_up(self, rig: Rig) -> None:
        """Set up camera and lidar; a calibration without camera is an error."""
        if rig.camera is None:
            log.error("the calibration has no camera: there are no keyframes; add [camera] to the rig file")
            return
        c = rig.camera
        self._camera, self._rig = c, rig
        lens = Pinhole.of(c)
        self._pinhole = lens.undistorted()
        self._history = SensorHistory(np.eye(4) if rig.lidar is None else rig.lidar.T_body_lidar)
        s = self.config
        self._selector = KeyframeSelector(
            field_of_view(lens),
            SelectionSettings(
                distance_m=s.distance_m, angle_rad=s.angle_rad, least_overlap=s.least_overlap,
                patience=s.patience,
            ),
        )  # fmt: skip

    def on_lidar_scan(self, scan: Scan) -> Outputs:
        if self._history is not None:
            self._history.add_scan(TimedScan.of(scan))
        return iter(())

    def on_localization_movers(self, movers: MovingBeams) -> Outputs:
        if self._history is not None:
            self._history.add_mask(movers.stamp_ns, movers.moving)
        return iter(())

    def on_localization_correction(self, correction: Correction) -> Outputs:
        self._T_map_odom = correction.T_map_odom
        return iter(())

    def on_localization_anchors(self, anchors: Anchors) -> Outputs:
        """Attach new keyframes to the newest submap, relative to which the pose has the least drift."""
        self._map_uuid = anchors.map_uuid
        if anchors.map_uuid:
            self._outbox.rename_drive(self._localizer, anchors.map_uuid)
        if len(anchors.anchor_ids):
            newest = int(np.argmax(anchors.anchor_ids))
            self._anchor_id = int(anchors.anchor_ids[newest])
            self._T_map_anchor = anchors.T_map_anchor[newest].copy()
            self._optimisation = anchors.optimisation
        return iter(())

    def on_camera_image(self, image: Image) -> Outputs:
        """Store the image until its depth is received; publish unacknowledged keyframes again when due."""
        self._images.append(image)
        step_ns, self._newest_ns = image.stamp_ns - self._newest_ns, image.stamp_ns
        if 0 <= step_ns < _CLOCK_STEP_NS:
            self._now_ns += step_ns
        yield from self._resend_due()

    def _resend_due(self) -> Outputs:
        for key, schema, payload in list(self._outbox.due(self._now_ns)):
            try:
                frame = decode(schema, payload)
                if not isinstance(frame, Keyframe):
                    raise DecodeError(f"{schema} is no keyframe")
            except DecodeError as error:  # written by a newer version
                log.warning("keyframe %d in the outbox cannot be decoded and is dropped: %s", key, error)
                self._outbox.discard(key)
                continue
            self._sent_again += 1
            yield "keyframes/frame", frame

    def on_keyframes_candidate(self, candidate: KeyframeCandidate) -> Outputs:
        """Decide whether an image becomes a keyframe; without calibration, candidates are queued."""
        if len(self._undecided) == _IMAGES:
            self.rejections.add("candidates dropped: no calibration yet")
        self._undecided.append(candidate)
        yield from self._decide()

    def _decide(self) -> Outputs:
        while self._selector is not None and self._undecided:
            candidate = self._undecided.popleft()
            T_odom_camera = candidate.T_odom_body @ self._camera.T_body_camera
            selection = self._selector.decide(T_odom_camera, candidate.sharpness)
            if selection.selected:
                self._selected[candidate.stamp_ns] = (T_odom_camera, selection.reason)
                if len(self._selected) > _IMAGES:  # depth that never arrived
                    del self._selected[next(iter(self._selected))]
            decision = KeyframeDecision(
                stamp_ns=candidate.stamp_ns, keyframe=selection.selected, reason=selection.reason
            )
            yield "keyframes/decision", decision

    def on_fusion_depth(self, depth: FusedDepth) -> Outputs:
        """Store the depth of a selected image, and publish its keyframe if its beams are known.

        If the depth was rejected, or is not that of a keyframe because fusion was busy, the selection is
        cancelled.
        """
        if depth.keyframe and depth.status == "ok":
            if len(self._depths) == _IMAGES:
                self.rejections.add("keyframes lost: no pose came for them")
            self._depths.append(depth)
            yield from self._publish_ready()
        elif depth.stamp_ns in self._selected and self._selector is not None:
            self._selector.withdraw(self._selected.pop(depth.stamp_ns)[0])

    def on_localization_odometry(self, odometry: Odometry) -> Outputs:
        """Store a pose, and publish the keyframes whose beams can be deskewed now."""
        if self._history is None or odometry.status != "ok":
            return
        self._history.add_pose(odometry.stamp_ns, odometry.T_odom_body)
        yield from self._publish_ready()

    def _publish_ready(self) -> Outputs:
        """Publish the keyframes whose beams are known."""
        while self._depths and self._beams_are_known(self._depths[0].stamp_ns):
            yield from self._publish(self._depths.popleft())

    def _beams_are_known(self, image_ns: int) -> bool:
        """Return whether the scan around the image time is complete, or the time limit for it is over."""
        if self._history is None:
            return False
        pose_ns = self._history.newest_pose_ns
        if pose_ns < image_ns + _BEAMS_NS:
            return False
        return self._history.decided_scan_near(image_ns) or pose_ns >= image_ns + _BEAMS_PATIENCE_NS

    def on_keyframes_ack(self, ack: KeyframeAck) -> Outputs:
        """Remove an acknowledged keyframe from the outbox, whether the mapper accepted or rejected it."""
        self._outbox.acknowledge(ack.id, self._now_ns)
        if ack.status != "ok" and ack.id not in self._rejected_ids:
            self._rejected += 1
            self._rejected_ids.append(ack.id)
        yield from self._resend_due()
        self._update_detail()

    def backlog(self, topic: str) -> int:
        """Return the number of keyframes without acknowledgement, by which the mapper plans its steps."""
        return len(self._outbox) if topic == "keyframes/frame" else 0

    def awaits_feedback(self) -> bool:
        """Return whether acknowledgements are missing; recorded data may end before they are received."""
        return len(self._outbox) > 0

    def on_feedback_timeout(self, seconds: float) -> Outputs:
        """Advance the time by `seconds` although no images arrive, and publish due keyframes again."""
        self._now_ns += round(seconds * 1e9)
        yield from self._resend_due()
        self._update_detail()

    def drain(self) -> Outputs:
        """Publish the remaining keyframes without waiting for further poses."""
        while self._history is not None and self._depths:
            yield from self._publish(self._depths.popleft())

    def _publish(self, depth: FusedDepth) -> Outputs:
        """Publish the keyframe of a selected image with depth, and store it until it is acknowledged."""
        image = next((p for p in self._images if p.stamp_ns == depth.stamp_ns), None)
        if image is None:
            log.warning("a keyframe is lost: its image arrived more than %d images ago", _IMAGES)
            self.rejections.add("keyframes lost: their image was too old")
            return
        try:
            frame = self._keyframe(image, depth, self._selected.pop(depth.stamp_ns, (None, ""))[1])
        except ValueError as error:  # the image is damaged, or the depth has another size
            log.warning("a keyframe is lost: %s", error)
            self.rejections.add("keyframes cannot be made of their image or depth")
            return
        T_map_camera = frame.T_map_anchor @ frame.T_anchor_body @ frame.camera.T_body_camera
        units = (self.config.distance_m, self.config.angle_rad)
        view = np.concatenate([T_map_camera[:3, 3] / units[0], T_map_camera[:3, 2] / units[1]])
        # The payload is kept with the message: it is queued and sent, and encoded once.
        self._outbox.put(frame.id, view, schema_of(frame), encode(frame, keep=True), self._now_ns)
        self._sent += 1
        self._update_detail()
        yield "keyframes/frame", frame

    def _keyframe(self, image: Image, depth: FusedDepth, why: str) -> Keyframe:
        """Return the keyframe message with the poses of the newest optimisation; `why`: selection reason."""
        stamp_ns, T_body_camera = image.stamp_ns, self._camera.T_body_camera
        assert self._history is not None  # depths are queued after the calibration only
        encoding, picture = self._compress(image)
        beams, _ = self._history.beams(stamp_ns)
        uv, z, index = project_beams(beams, self._pinhole, T_body_camera)
        shape = self._pinhole.shape
        if not packed_shape(depth.depth) == packed_shape(depth.sigma) == shape:
            raise ValueError(f"depth of {packed_shape(depth.depth)} pixels, the image has {shape}")
        moving = self._history.moving_returns(stamp_ns)
        packed_mask = np.zeros(0, np.uint8)
        if len(moving):  # depth is decoded only for a mask
            depth_m = unpack_depth(depth.depth, shape)
            mask = dynamic_object_mask(moving, depth_m, self._pinhole, T_body_camera)
            packed_mask = pack_mask(~mask) if mask.any() else packed_mask
        return Keyframe(
            stamp_ns=stamp_ns, id=stamp_ns, encoding=encoding, picture=picture, camera=self._camera,
            anchor_id=self._anchor_id, T_map_anchor=self._T_map_anchor, optimisation=self._optimisation,
            T_anchor_body=inverse(self._T_map_anchor) @ self._T_map_odom @ depth.T_odom_body,
            depth=depth.depth, sigma=depth.sigma, mask=packed_mask,
            beams=np.column_stack([uv, z, beams.sigma_m[index]]).astype(np.float32).reshape(-1, 4), why=why,
            map_uuid=self._map_uuid,
        )  # fmt: skip

    def _compress(self, image: Image) -> tuple[Literal["jpeg", "png"], np.ndarray]:
        if image.encoding == "jpeg" or image.encoding == "png":
            return image.encoding, image.data
        rgb = decode_rgb(image.data, image.encoding, image.width_px, image.height_px, image.step_bytes)
        quality = (cv2.IMWRITE_JPEG_QUALITY, self.config.jpeg_quality)
        return "jpeg", cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), quality)[1].ravel()

    def _update_detail(self) -> None:
        o = self._outbox
        counts = {
            "sent again": self._sent_again, "refused": self._rejected, "dropped": o.dropped,
            "not on disk": o.not_on_disk, "corrupt": o.corrupt, "of earlier drives": o.of_earlier_drives,
        }  # fmt: skip
        self.rejections.set("keyframes dropped: the outbox was full", o.dropped)
        self.rejections.set("keyframes in the outbox are corrupt", o.corrupt)
        self.figures.set("outbox_keyframes", len(o))
        self.figures.set("outbox_bytes", o.bytes)
        self.figures.set("outbox_dropped_total", o.dropped)
        text = "".join(f", {count} {what}" for what, count in counts.items() if count)
        text += f", NOT DURABLE: {o.disk_fault}" if o.disk_fault else ""
        self.detail = f"{self._sent} keyframes, {len(o)} not acknowledged{text}"
