"""Options of the node that publishes to ROS 2."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.config.ros import ROUTER, Domain, domain_field

ViewSize = Annotated[int, Field(ge=16, le=2048)]
Seconds = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Ros2OutConfig(NodeConfig):
    """Options of the node that publishes to ROS 2. An empty topic name disables the topic.

    The CameraInfo of an image is on the topic `camera_info` beside it.
    """

    domain: Domain = domain_field()
    router: str = ROUTER
    pose_topic: str = "/beamsplat/pose"
    # PoseWithCovarianceStamped; the covariance is that of the motion over the last second
    pose_covariance_topic: str = "/beamsplat/pose_with_covariance"
    cloud_topic: str = "/beamsplat/cloud"
    # nav_msgs/OccupancyGrid, when its size has changed, and at intervals. Between them, the changed parts are
    # published as map_msgs/OccupancyGridUpdate on this topic with "_updates" appended.
    map_topic: str = "/map"
    map_every_s: Seconds = 5.0  # large maps: longer, see `grid_publisher`
    depth_topic: str = "/beamsplat/depth/image_rect"  # 32FC1, registered to the undistorted camera image
    # The Gaussian map as points, when it has changed, at most every so often; one Gaussian per cell.
    map_cloud_topic: str = "/beamsplat/map_cloud"
    map_cloud_every_s: Seconds = 5.0
    # 16 bytes each. rmw_zenoh loses latched messages of more than 1 MB on some links (ros2/rmw_zenoh #710).
    map_cloud_points: Annotated[int, Field(ge=1, le=2_000_000)] = 50_000
    map_cloud_cell_m: Annotated[float, Field(ge=0.005, le=100.0)] = 0.05  # doubled until the points suffice
    # The map rendered from the pose of each new keyframe, rgb8.
    render_topic: str = "/beamsplat/map_camera/image"
    # PoseStamped in the map frame, x forward and z up: the map is rendered from each pose that a node of the
    # robot publishes here, as fast as the mapper answers; poses that it has no time for are skipped.
    view_pose_topic: str = "/beamsplat/map_view/pose"
    view_topic: str = "/beamsplat/map_view/image"  # rgb8, with the stamp of the pose
    # None: the camera of the keyframes at half size
    view_size_px: tuple[ViewSize, ViewSize] | None = None  # width, height
    view_fov_deg: Annotated[float, Field(ge=5.0, le=150.0)] = 90.0  # horizontal, of `view_size_px`
    tf: bool = True  # map -> odom, and odom -> body if the robot has no odometry
    map_frame: str = "map"
    odom_frame: str = "odom"
    body_frame: str = "base_link"
    camera_frame: str = "beamsplat_camera"  # of the depth; body -> camera is published on /tf_static
    render_frame: str = "beamsplat_map_camera"  # of the rendered images; map -> camera is published on /tf
    view_frame: str = "beamsplat_map_view"  # of the images at `view_topic`, in the same way
