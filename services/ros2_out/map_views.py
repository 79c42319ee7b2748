"""The map as a camera: renders of the map from the poses that the robot's nodes ask for."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import R_body_camera_level
from beamsplat.common.geometry.transforms import make_transform, quat_xyzw_from_matrix
from beamsplat.common.messages import MapRender
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.recording.static_frames import normalize_frame
from beamsplat.common.runtime.node import QueryFunction
from beamsplat.services.ros2_out.config import Ros2OutConfig

POSE = "geometry_msgs/msg/PoseStamped"
_RENDER_S = 30.0  # longest wait for the mapper, which may be busy with a keyframe


class MapViewImage(NamedTuple):
    """The map rendered from a requested pose."""

    stamp_ns: int  # of the request
    rgb: np.ndarray  # uint8 [H, W, 3]
    camera: Pinhole
    T_map_camera: np.ndarray  # float64 [4, 4], optical frame
    left_out: int  # Gaussians that may be in view but are not drawn


def render_request(cdr: bytes, config: Ros2OutConfig, ask: QueryFunction) -> MapViewImage:
    """Ask the mapper for the view from a geometry_msgs/PoseStamped whose x axis is the viewing direction.

    Raises:
        UserError: the request is no pose in the map frame (the text names the field), or the mapper has no
            answer.
    """
    stamp_ns, T_map_view = _pose_of(cdr, config)
    T_map_camera = T_map_view @ make_transform(R_body_camera_level, np.zeros(3))
    parameters = {
        "position": ",".join(repr(float(v)) for v in T_map_camera[:3, 3]),
        "quaternion": ",".join(repr(float(v)) for v in quat_xyzw_from_matrix(T_map_camera[:3, :3])),
    }
    if config.view_size_px is not None:
        width_px, height_px = config.view_size_px
        focal_px = 0.5 * width_px / math.tan(0.5 * math.radians(config.view_fov_deg))
        parameters |= {
            "width_px": str(width_px),
            "height_px": str(height_px),
            "focal_px": repr(focal_px),
        }
    answer = next(ask("mapping", "render", parameters, _RENDER_S), None)
    if not isinstance(answer, MapRender):
        raise UserError("the mapper has not answered")
    size_px = answer.camera.width_px, answer.camera.height_px
    rgb = decode_rgb(answer.render, "jpeg", *size_px)
    return MapViewImage(stamp_ns, rgb, Pinhole.of(answer.camera), answer.T_map_camera, answer.left_out)


def _pose_of(cdr: bytes, config: Ros2OutConfig) -> tuple[int, np.ndarray]:
    """Return the stamp (ns) and the pose [4, 4] in the map frame of a PoseStamped."""
    topic = config.view_pose_topic
    try:
        message = ros.deserialize(cdr, POSE)
        frame = normalize_frame(message.header.frame_id)
        T_map_view = ros.transform_of(message.pose.position, message.pose.orientation)
    except ValueError as error:
        raise UserError(f"{topic}: not a valid {POSE}: {error}") from error
    if frame != normalize_frame(config.map_frame):
        raise UserError(f"{topic}: header.frame_id = {frame!r}: expected {config.map_frame!r}")
    if not np.isfinite(T_map_view).all():
        raise UserError(f"{topic}: pose.position is not finite")
    return ros.stamp_ns_of(message.header.stamp), T_map_view
