"""The map as a camera: views that the robot's nodes ask for, as parameters of the query `render`."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.frames import R_body_camera_level
from beamsplat.common.geometry.transforms import make_transform, quat_xyzw_from_matrix
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.recording.static_frames import normalize_frame

POSE = "geometry_msgs/msg/PoseStamped"


def requested_view(cdr: bytes, topic: str, map_frame: str) -> tuple[int, np.ndarray]:
    """Return stamp (ns) and T_map_camera [4, 4] (optical frame) of a request.

    Args:
        cdr: geometry_msgs/PoseStamped in the map frame; its x axis is the viewing direction, z is up.
        topic: of the request, for error texts.
        map_frame: name of the map frame.

    Raises:
        UserError: it is no pose in the map frame; the text names the field.
    """
    try:
        message = ros.deserialize(cdr, POSE)
        frame = normalize_frame(message.header.frame_id)
        T_map_view = ros.transform_of(message.pose.position, message.pose.orientation)
    except ValueError as error:
        raise UserError(f"{topic}: not a valid {POSE}: {error}") from error
    if frame != normalize_frame(map_frame):
        raise UserError(f"{topic}: header.frame_id = {frame!r}: expected {map_frame!r}")
    if not np.isfinite(T_map_view).all():
        raise UserError(f"{topic}: pose.position is not finite")
    T_map_camera = T_map_view @ make_transform(R_body_camera_level, np.zeros(3))
    return ros.stamp_ns_of(message.header.stamp), T_map_camera


def render_parameters(
    T_map_camera: np.ndarray, size_px: tuple[int, int] | None, fov_deg: float
) -> dict[str, str]:
    """Return the parameters of the query `render`.

    Args:
        T_map_camera: float64 [4, 4], optical frame.
        size_px: width and height of the image; None = the camera of the keyframes at half size.
        fov_deg: horizontal field of view, with `size_px`.
    """
    parameters = {
        "position": ",".join(repr(float(v)) for v in T_map_camera[:3, 3]),
        "quaternion": ",".join(repr(float(v)) for v in quat_xyzw_from_matrix(T_map_camera[:3, :3])),
    }
    if size_px is not None:
        focal_px = 0.5 * size_px[0] / math.tan(0.5 * math.radians(fov_deg))
        parameters |= {"width_px": str(size_px[0]), "height_px": str(size_px[1]), "focal_px": repr(focal_px)}
    return parameters
