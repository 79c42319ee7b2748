"""Options of the node that publishes to ROS 2."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.config.ros import ROUTER, Domain, domain_field


class Ros2OutConfig(NodeConfig):
    """Options of the node that publishes to ROS 2. An empty topic name disables the topic."""

    domain: Domain = domain_field()
    router: str = ROUTER
    pose_topic: str = "/beamsplat/pose"
    # PoseWithCovarianceStamped; the covariance is that of the motion over the last second
    pose_covariance_topic: str = "/beamsplat/pose_with_covariance"
    cloud_topic: str = "/beamsplat/cloud"
    # nav_msgs/OccupancyGrid, when its size has changed, and at intervals. Between them, the changed parts are
    # published as map_msgs/OccupancyGridUpdate on this topic with "_updates" appended.
    map_topic: str = "/map"
    map_every_s: Annotated[float, Field(gt=0.0)] = 5.0  # large maps: longer, see `grid_publisher`
    tf: bool = True  # map -> odom, and odom -> body if the robot has no odometry
    map_frame: str = "map"
    odom_frame: str = "odom"
    body_frame: str = "base_link"
