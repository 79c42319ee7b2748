"""Conversion of results to ROS messages: pose, transforms, map, point cloud."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.recording import ros_types as ros

_MAX_POSES = 500  # of the wheel odometry: several seconds
_MAX_AGE_NS = 100_000_000  # largest time between a scan and the wheel pose used with it

POSE, POSE_COVARIANCE, TF, MAP, CLOUD = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "tf2_msgs/msg/TFMessage",
    "nav_msgs/msg/OccupancyGrid",
    "sensor_msgs/msg/PointCloud2",
)


class TfTree:
    """Computes the transforms map -> odom -> body for ROS.

    If the robot itself publishes odom -> body (wheel odometry), only map -> odom is computed.
    """

    def __init__(self, map_frame: str, odom_frame: str, body_frame: str) -> None:
        self._frames = map_frame, odom_frame, body_frame
        self._wheel_odometry: deque[tuple[int, np.ndarray]] = deque(maxlen=_MAX_POSES)
        self.T_map_odom = np.eye(4)  # odom: our own smooth frame

    def add_wheel_odometry(self, stamp_ns: int, T_odom_body: np.ndarray) -> None:
        """Store a pose `T_odom_body` [4, 4] of the robot's own wheel odometry."""
        self._wheel_odometry.append((stamp_ns, T_odom_body))

    def pose(self, stamp_ns: int, T_odom_body: np.ndarray) -> Any:
        """Return the PoseStamped of the body in the map frame for our localization's `T_odom_body` [4, 4]."""
        header = ros.header(stamp_ns, self._frames[0])
        return ros.new(POSE, header=header, pose=ros.pose(self.T_map_odom @ T_odom_body))

    def pose_with_covariance(self, stamp_ns: int, T_odom_body: np.ndarray, covariance: np.ndarray) -> Any:
        """Return the PoseWithCovarianceStamped of the body in the map frame.

        Args:
            covariance: float64 [3, 3] of (x, y, yaw) in odom axes. ROS wants (x, y, z, roll, pitch, yaw); the
                others are zero, as with AMCL, because the robot moves in a plane.
        """
        rotation = np.eye(3)
        rotation[:2, :2] = self.T_map_odom[:2, :2]
        full = np.zeros((6, 6))
        full[np.ix_((0, 1, 5), (0, 1, 5))] = rotation @ covariance @ rotation.T
        pose = ros.new(
            "geometry_msgs/msg/PoseWithCovariance", pose=ros.pose(self.T_map_odom @ T_odom_body),
            covariance=full.ravel(),
        )  # fmt: skip
        return ros.new(POSE_COVARIANCE, header=ros.header(stamp_ns, self._frames[0]), pose=pose)

    def tf(self, stamp_ns: int, T_odom_body: np.ndarray) -> Any | None:
        """Return the TFMessage for our localization's `T_odom_body` [4, 4]; None if wheel poses are too old.

        If the robot publishes odom -> body, the returned map -> odom is chosen such that map -> odom -> body
        is the pose of our localization, as nav2 expects (REP 105).
        """
        map_frame, odom_frame, body_frame = self._frames
        if not self._wheel_odometry:
            return ros.tf_message(
                [
                    ros.tf(stamp_ns, map_frame, odom_frame, self.T_map_odom),
                    ros.tf(stamp_ns, odom_frame, body_frame, T_odom_body),
                ]
            )
        wheel_ns, T_wheel_odom_body = min(self._wheel_odometry, key=lambda entry: abs(entry[0] - stamp_ns))
        if abs(wheel_ns - stamp_ns) > _MAX_AGE_NS:
            return None
        T_map_wheel_odom = self.T_map_odom @ T_odom_body @ inverse(T_wheel_odom_body)
        return ros.tf_message([ros.tf(stamp_ns, map_frame, odom_frame, T_map_wheel_odom)])


def occupancy_grid(
    stamp_ns: int,
    frame: str,
    resolution_m: float,
    origin_m: np.ndarray,  # float64 [2]
    occupancy: np.ndarray,  # int8 [H, W]
) -> Any:
    """Return a nav_msgs/OccupancyGrid of cells int8 [H, W] (-1 unknown, 0 free to 100 occupied).

    `origin_m`: lower left corner (x, y) of the grid in `frame`.
    """
    rows, columns = occupancy.shape
    T = np.eye(4)
    T[:2, 3] = origin_m
    info = ros.new(
        "nav_msgs/msg/MapMetaData",
        map_load_time=ros.time_of(stamp_ns), resolution=float(resolution_m), width=columns, height=rows,
        origin=ros.pose(T),
    )  # fmt: skip
    return ros.new(MAP, header=ros.header(stamp_ns, frame), info=info, data=occupancy.ravel())


def grid_update(stamp_ns: int, frame: str, row: int, column: int, cells: np.ndarray) -> Any:
    """Return a map_msgs/OccupancyGridUpdate: cells int8 [H, W] from (row, column) of the published map on."""
    rows, columns = cells.shape
    return ros.new(
        ros.GRID_UPDATE,
        header=ros.header(stamp_ns, frame), x=column, y=row, width=columns, height=rows, data=cells.ravel(),
    )  # fmt: skip


def point_cloud(
    stamp_ns: int,
    frame: str,
    points_m: np.ndarray,  # float32 [N, 3]
    colours: np.ndarray,  # uint8 [N, 3], RGB
    T_frame_points: np.ndarray,  # float64 [4, 4]
) -> Any:
    """Return a sensor_msgs/PointCloud2 with x, y, z and rgb (packed into a float32, as in RViz and PCL).

    The points are transformed by `T_frame_points` to the frame `frame`.
    """
    packed = np.zeros(len(points_m), [("xyz", "<f4", 3), ("rgb", "<u4")])
    packed["xyz"] = transform_points(T_frame_points, points_m.astype(np.float64))
    red, green, blue = colours.astype(np.uint32).T
    packed["rgb"] = red << 16 | green << 8 | blue
    fields = [
        ros.new("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate(("x", "y", "z", "rgb"))
    ]
    return ros.new(
        CLOUD,
        header=ros.header(stamp_ns, frame), height=1, width=len(packed), fields=fields, is_bigendian=False,
        point_step=16, row_step=16 * len(packed), data=packed.view(np.uint8).reshape(-1), is_dense=True,
    )  # fmt: skip
