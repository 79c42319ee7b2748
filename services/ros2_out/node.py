"""The ros2_out node: publishes poses, transforms, maps, depth and renders to ROS 2, without ROS installed.

It uses the Zenoh keys of rmw_zenoh.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.mapfiles.grid_tiles import GridSource
from beamsplat.common.messages import (
    CameraModel,
    Cloud,
    Correction,
    FusedDepth,
    GridTile,
    MapAnchors,
    MapChunk,
    MapPreview,
    MapRender,
    Odometry,
    Rig,
    Tick,
    WheelOdometry,
)
from beamsplat.common.messages.depth_codec import packed_shape
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.runtime.node import Input, Job, Node, Outputs, QueryFunction
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.rmw import RmwQos
from beamsplat.common.zenoh.ros_publishers import RosPublishers, ros_topic
from beamsplat.common.zenoh.ros_subscription import RosSubscription
from beamsplat.services.ros2_out import conversions, images, map_views
from beamsplat.services.ros2_out.config import Ros2OutConfig
from beamsplat.services.ros2_out.grid_publisher import GridPublisher
from beamsplat.services.ros2_out.splat_cloud import SplatCloud

log = logging.getLogger("beamsplat.ros2_out")

_VOLATILE = RmwQos(depth=10)
_LATCHED = RmwQos(transient_local=True, depth=1)
_TF = RmwQos(depth=100)  # as tf2_ros publishes it
_RENDER_S = _SNAPSHOT_S = 30.0  # longest wait for an answer of the mapper, which may be busy with a keyframe


class Ros2OutNode(Node):
    """Publishes the results of BeamSplat to a robot's ROS 2 nodes."""

    name = "ros2_out"
    Config = Ros2OutConfig
    config: Ros2OutConfig
    inputs = (
        "rig",
        "wheel/odometry",
        "localization/odometry",
        "localization/correction",
        "localization/grid",
        "fusion/depth",
        "fusion/cloud",
        # In order of arrival: chunks have the stamps of keyframes, for which poses must not wait.
        Input("mapping/chunk", feedback=True, queued_bytes=64_000_000),
        "mapping/anchors",
        "mapping/preview",
        Input("tick", "latest"),
    )
    _ask: QueryFunction | None = None

    def set_query_function(self, ask: QueryFunction) -> None:
        self._ask = ask

    def configure(self) -> None:
        c = self.config
        self._transforms = conversions.TfTree(c.map_frame, c.odom_frame, c.body_frame)
        self._grid = GridPublisher(c.map_frame, c.map_every_s)
        self._splats = SplatCloud(c.map_cloud_points, c.map_cloud_cell_m)
        self._chunk_ns = 0  # stamp of the newest chunk of the map
        self._splats_ns: int | None = None  # time at which the map was last published as points
        self._mapper = ""  # instance of the process that sent the newest chunk
        self._camera: CameraModel | None = None
        self._session = open_session((c.router,))
        views = c.view_topic if c.view_pose_topic and self._ask is not None else ""
        moves = c.tf or c.render_topic or views
        topics = (
            ("pose", c.pose_topic, conversions.POSE, _VOLATILE),
            ("pose_covariance", c.pose_covariance_topic, conversions.POSE_COVARIANCE, _VOLATILE),
            ("tf", "/tf" if moves else "", conversions.TF, _TF),
            ("tf_static", "/tf_static" if c.depth_topic else "", conversions.TF, _LATCHED),
            ("map", c.map_topic, conversions.MAP, _LATCHED),
            ("map_updates", c.map_topic and f"{c.map_topic}_updates", ros.GRID_UPDATE, _TF),
            ("cloud", c.cloud_topic, conversions.CLOUD, _VOLATILE),
            ("depth", c.depth_topic, images.IMAGE, _VOLATILE),
            ("depth_info", images.info_topic(c.depth_topic), images.CAMERA_INFO, _VOLATILE),
            ("map_cloud", c.map_cloud_topic, conversions.CLOUD, _LATCHED),
            ("render", c.render_topic, images.IMAGE, _VOLATILE),
            ("render_info", images.info_topic(c.render_topic), images.CAMERA_INFO, _VOLATILE),
            ("view", views, images.IMAGE, _VOLATILE),
            ("view_info", images.info_topic(views), images.CAMERA_INFO, _VOLATILE),
        )
        self._ros = RosPublishers(
            self._session, c.domain,
            {name: ros_topic(topic, type_name, qos) for name, topic, type_name, qos in topics if topic},
        )  # fmt: skip
        if views and (ask := self._ask) is not None:

            def on_pose(cdr: bytes) -> None:
                self._publish_view(cdr, ask)

            self._view_requests = RosSubscription(
                self._session, c.domain, c.view_pose_topic, map_views.POSE, on_pose
            )

    def on_header(self, header: Header) -> None:
        if header.producer == "mapping":
            self._mapper = header.instance

    def on_rig(self, rig: Rig) -> Outputs:
        """Publish the mount of the camera, in whose frame the depth is."""
        self._camera, c = rig.camera, self.config
        if rig.camera is not None:
            mount = ros.tf(rig.stamp_ns, c.body_frame, c.camera_frame, rig.camera.T_body_camera)
            self._put_built("tf_static", ros.tf_message([mount]))
        return self._done()

    def on_wheel_odometry(self, odometry: WheelOdometry) -> Outputs:
        self._transforms.add_wheel_odometry(odometry.stamp_ns, odometry.T_odom_body)
        return iter(())

    def on_localization_correction(self, correction: Correction) -> Outputs:
        self._transforms.T_map_odom = correction.T_map_odom
        return iter(())

    def on_localization_odometry(self, odometry: Odometry) -> Outputs:
        """Publish pose and transforms, if the status of localization is ok."""
        if odometry.status == "ok":
            stamp_ns, T, tree = odometry.stamp_ns, odometry.T_odom_body, self._transforms
            self._ros.put("pose", lambda: tree.pose(stamp_ns, T))
            self._ros.put(
                "pose_covariance", lambda: tree.pose_with_covariance(stamp_ns, T, odometry.covariance)
            )
            transforms = tree.tf(stamp_ns, T) if self.config.tf else None
            if transforms is not None:
                self._put_built("tf", transforms)
        return self._done()

    def on_localization_grid(self, tile: GridTile) -> Outputs:
        """Store a tile; after the last one of an update, publish the whole map or what has changed in it."""
        source = GridSource(tile.map_uuid, tile.since_ns, tile.resolution_m, tile.size)
        try:
            self._grid.add(source, tile.row, tile.column, tile.packed.tobytes())
            for name, message in self._grid.messages(tile.stamp_ns) if tile.remaining == 0 else ():
                self._put_built(name, message)
        except ValueError as error:
            self.rejections.add(f"map not published: {error}")
        return self._done()

    def on_fusion_cloud(self, cloud: Cloud) -> Outputs:
        self._ros.put(
            "cloud",
            lambda: conversions.point_cloud(
                cloud.stamp_ns, self.config.map_frame, cloud.points_odom_m, cloud.colours,
                self._transforms.T_map_odom,
            ),
        )  # fmt: skip
        return self._done()

    def on_fusion_depth(self, depth: FusedDepth) -> Outputs:
        """Publish the depth of an undistorted image and its CameraInfo."""
        if depth.status != "ok":
            return iter(())
        stamp_ns, frame = depth.stamp_ns, self.config.camera_frame
        try:
            size_px = packed_shape(depth.depth)[::-1]
            if self._camera is None or size_px != (self._camera.width_px, self._camera.height_px):
                raise ValueError(f"{size_px} px do not belong to the calibration")
            # Decoded only if somebody subscribes.
            self._ros.put("depth", lambda: images.depth_image(stamp_ns, frame, depth.depth_m))
        except ValueError as error:
            self.rejections.add(f"depth not published: {error}")
            return iter(())
        pinhole = Pinhole.of(self._camera).undistorted()
        self._ros.put("depth_info", lambda: images.camera_info(stamp_ns, frame, pinhole))
        return self._done()

    def on_mapping_chunk(self, chunk: MapChunk) -> Outputs:
        """Store the Gaussians of a submap, and publish the map as points if that is due."""
        if "map_cloud" in self._ros:
            self._chunk_ns = chunk.stamp_ns or self._chunk_ns
            try:
                self._splats.add(self._mapper, *_chunk_arguments(chunk))
            except ValueError as error:
                self.rejections.add(f"chunk of the map not published: {error}")
            self._publish_splats(chunk.stamp_ns)
        self._done()
        yield from self._ask_snapshot()

    def on_mapping_anchors(self, anchors: MapAnchors) -> Outputs:
        """Move the submaps of the map that is published as points."""
        if "map_cloud" in self._ros:
            poses = dict(zip(anchors.anchor_ids.tolist(), anchors.T_map_anchor))
            try:
                self._splats.move(self._mapper, anchors.pose_revision, poses)
            except ValueError as error:
                self.rejections.add(f"poses of the map not used: {error}")
            self._publish_splats(anchors.stamp_ns)
        return self._done()

    def on_tick(self, tick: Tick) -> Outputs:
        self._publish_splats(tick.stamp_ns)
        self._done()
        yield from self._ask_snapshot()

    def on_job_snapshot(self, snapshot: SplatCloud) -> Outputs:
        self._splats.complete(snapshot)
        return iter(())

    def on_mapping_preview(self, preview: MapPreview) -> Outputs:
        """Publish the map as seen from its newest keyframe: image, CameraInfo and the pose of the camera."""
        camera, c, stamp_ns = preview.camera, self.config, preview.stamp_ns
        if "render" not in self._ros:
            return iter(())
        if camera is None:  # a mapper of an older version
            self.rejections.add("render of the map not published: the mapper does not say with which camera")
            return iter(())
        size_px, frame = (camera.width_px, camera.height_px), c.render_frame
        pose = ros.tf(stamp_ns, c.map_frame, frame, preview.T_map_camera)
        try:
            self._ros.put(
                "render",
                lambda: images.rgb_image(stamp_ns, frame, decode_rgb(preview.render, "jpeg", *size_px)),
            )
        except UserError as error:
            self.rejections.add(f"render of the map not published: {error}")
            return iter(())
        pinhole = Pinhole.of(camera)
        self._ros.put("render_info", lambda: images.camera_info(stamp_ns, frame, pinhole))
        self._put_built("tf", ros.tf_message([pose]))
        return self._done()

    def _publish_view(self, cdr: bytes, ask: QueryFunction) -> None:
        """Publish the map as seen from the pose in a message of the robot; called in the receiving thread."""
        c, frame = self.config, self.config.view_frame
        try:
            stamp_ns, T_map_camera = map_views.requested_view(cdr, c.view_pose_topic, c.map_frame)
            parameters = map_views.render_parameters(T_map_camera, c.view_size_px, c.view_fov_deg)
            (view,) = ask("mapping", "render", parameters, _RENDER_S)
            assert isinstance(view, MapRender)  # the message type of this query
            rgb = decode_rgb(view.render, "jpeg", view.camera.width_px, view.camera.height_px)
        except ValueError as error:
            self.rejections.add(f"view of the map not published: {error}")
            return
        if view.left_out:
            self.rejections.add(f"view of the map incomplete: {view.left_out} Gaussians are left out")
        pinhole = Pinhole.of(view.camera)
        pose = ros.tf(stamp_ns, c.map_frame, frame, view.T_map_camera)
        self._ros.put("view", lambda: images.rgb_image(stamp_ns, frame, rgb))
        self._ros.put("view_info", lambda: images.camera_info(stamp_ns, frame, pinhole))
        self._put_built("tf", ros.tf_message([pose]))

    def drain(self) -> Outputs:
        """Publish the last state of the map."""
        self._publish_splats(None)
        return self._done()

    def close(self) -> None:
        if hasattr(self, "_session"):
            self._session.close()

    def _put_built(self, name: str, message: Any) -> None:
        self._ros.put(name, lambda: message)

    def _ask_snapshot(self) -> Outputs:
        """Ask the mapper, once, for what it has published before this process was started."""
        ask, self._ask = self._ask, None
        if ask is None or "map_cloud" not in self._ros or "mapping/chunk" in self.without_producer:
            return
        snapshot = SplatCloud(self.config.map_cloud_points, self.config.map_cloud_cell_m)

        def collect() -> SplatCloud:
            try:
                for chunk in ask("mapping", "snapshot", {}, _SNAPSHOT_S):
                    assert isinstance(chunk, MapChunk)  # the message type of this query
                    snapshot.add("", *_chunk_arguments(chunk))
            except ValueError as error:  # no mapper, an empty map, or an answer that does not decode
                log.info("no snapshot of the map: %s", error)
            return snapshot

        yield Job("snapshot", collect)

    def _publish_splats(self, stamp_ns: int | None) -> None:
        """Publish the map as points if it has changed and the interval is over; None: in any case."""
        c, last_ns = self.config, self._splats_ns
        due = stamp_ns is None or last_ns is None or abs(stamp_ns - last_ns) >= c.map_cloud_every_s * 1e9
        if not (due and self._splats.changed):
            return
        self._splats_ns = stamp_ns
        points_m, colours = self._splats.points()
        self._ros.put(
            "map_cloud",
            lambda: conversions.point_cloud(self._chunk_ns, c.map_frame, points_m, colours, np.eye(4)),
        )

    def _done(self) -> Outputs:
        """Show what the robot's subscribers take and miss; return no messages."""
        self.detail = self._ros.status()
        for reason, count in self._ros.missed().items():
            self.rejections.set(reason, count)
        return iter(())


def _chunk_arguments(chunk: MapChunk) -> tuple[int, int, tuple[int, np.ndarray], np.ndarray]:
    """Return the arguments of `SplatCloud.add` after the producer."""
    return chunk.anchor_id, chunk.revision, (chunk.pose_revision, chunk.T_map_anchor), chunk.packed
