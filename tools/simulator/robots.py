"""Presets of robots that people own: `beamsplat simulate --robot NAME` writes a bag as their drivers would.

Sources: launch files, robot descriptions and drivers of the makers (turtlebot/turtlebot4, turtlebot4_robot,
waveshareteam/ugv_ws, the vendor's workspace of the JetRover), and the measurements of a ROSMASTER X3 in
AIRclub-UdeSA/physical_rosmaster (docs/sensor_capabilities.md, September 2026). What is assumed is marked so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from beamsplat.tools.simulator.bag_layout import BagLayout, FrameLink
from beamsplat.tools.simulator.lidar_drivers import (
    LDLIDAR_STL_ROS2,
    SLLIDAR_ROS2,
    YDLIDAR_ROS2_DRIVER,
    RosLidarDriver,
    SectorFilter,
)
from beamsplat.tools.simulator.office.settings import OfficeSettings
from beamsplat.tools.simulator.settings import (
    CameraSettings,
    LidarSettings,
    SimulationSettings,
    WheelSettings,
)


@dataclass(frozen=True)
class RobotPreset:
    """Sensors of a robot and what its drivers make of them."""

    title: str
    lidar: LidarSettings
    driver: RosLidarDriver
    camera: CameraSettings
    layout: BagLayout
    wheels: WheelSettings = field(default_factory=WheelSettings)

    def applied(self, settings: SimulationSettings, rate_hz: float | None = None) -> SimulationSettings:
        """Return `settings` with the sensors and drivers of this robot.

        `rate_hz`: of the camera; None = that of the robot.
        """
        camera = self.camera if rate_hz is None else replace(self.camera, rate_hz=rate_hz)
        # A home has glazed doors; whether beams pass them is not a property of the robot.
        lidar = replace(self.lidar, glass=settings.lidar.glass)
        return replace(
            settings, lidar=lidar, driver=self.driver, camera=camera, wheels=self.wheels, layout=self.layout
        )

    def applied_to_office(self, settings: OfficeSettings) -> OfficeSettings:
        """Return `settings` of an office with the lidar, wheels and drivers of this robot."""
        lidar = replace(self.lidar, glass=settings.lidar.glass)
        return replace(settings, lidar=lidar, driver=self.driver, wheels=self.wheels, layout=self.layout)


# In the mode of 8000 samples per second, angle_compensate of rplidar_ros makes 2 beams of a degree, that of
# sllidar_ros2 3.
_TURTLEBOT4 = RobotPreset(
    title="TurtleBot 4: RPLIDAR A1 at a yaw of 90 degrees, 250 x 250 crop of the OAK-D",
    # Rate assumed: that of the same lidar on the ROSMASTER.
    lidar=LidarSettings(
        beams=720, rate_hz=7.4, clockwise=True, angle_min_rad=math.pi, range_min_m=0.15, range_max_m=12.0,
        x_m=-0.04, z_m=0.135, yaw_rad=math.pi / 2.0,
    ),
    driver=replace(SLLIDAR_ROS2, copies=2),
    # 69 degrees over 4056 px (data sheet of the OAK-D Pro): 1080p is the middle 3840 px, of which the preview
    # is the square in the middle, scaled to 250 px. The lens is assumed to be without distortion.
    camera=CameraSettings(
        width_px=250, height_px=250, rate_hz=30.0, focal_widths=1.366, x_m=-0.06, z_m=0.19, pitch_down_rad=0.0
    ),
    wheels=WheelSettings(rate_hz=20.0),
    layout=BagLayout(
        image_topic="/oakd/rgb/preview/image_raw/compressed",
        camera_info_topic="/oakd/rgb/preview/camera_info",
        jpeg_format="bgr8; jpeg compressed bgr8",
        distortion_model="rational_polynomial",
        lidar_frame="rplidar_link",
        camera_frame="oakd_rgb_camera_optical_frame",
        links=(
            FrameLink("base_link", "shell_link", (0.0, 0.0, 0.0364)),
            FrameLink("shell_link", "oakd_camera_bracket", (-0.118, 0.0, 0.0526)),
            FrameLink("oakd_camera_bracket", "oakd_link", (0.0584, 0.0, 0.0968)),
        ),
        lidar_parent="shell_link",
        camera_parent="oakd_link",
        reliable=True,
    ),
)  # fmt: skip

_X3_BEAMS = 1080
_X3_FINITE = 807 / _X3_BEAMS  # measured; a beam is empty if its own reading and the two before it are missing
_ROSMASTER_X3 = RobotPreset(
    title="Yahboom ROSMASTER X3: RPLIDAR A1 mounted backwards, with a cable in its view; Orbbec Astra",
    lidar=LidarSettings(
        beams=_X3_BEAMS, rate_hz=7.17, sweep_s=0.1343, clockwise=True, angle_min_rad=math.pi,
        range_min_m=0.05, range_max_m=12.0, dropout=(1.0 - _X3_FINITE) ** (1.0 / 3.0),
        x_m=0.0435, z_m=0.1814, yaw_rad=math.pi,
        # 15 beams with those to which a reading is copied; direction and range of the cable are assumed.
        self_returns=(0, 13, 0.10),
    ),
    driver=replace(SLLIDAR_ROS2, copies=3, range_min_m=0.05),
    camera=CameraSettings(
        width_px=320, height_px=240, rate_hz=30.0, focal_widths=271.809 / 320, centre_px=(158.719, 120.092),
        x_m=0.055, y_m=0.025, z_m=0.1088, pitch_down_rad=math.radians(0.27),
    ),
    wheels=WheelSettings(rate_hz=10.0),
    layout=BagLayout(
        scan_topic="/scan_filtered",
        raw_scan_topic="/scan",
        scan_filter=SectorFilter(math.pi - 14.5 * 2.0 * math.pi / _X3_BEAMS, math.pi + 0.01),
        image_topic="/cam_1/color/image_raw",
        camera_info_topic="/cam_1/color/camera_info",
        image_encoding="rgb8",
        image_delay_s=0.003,
        base_frame="base_footprint",
        lidar_frame="laser_link",
        camera_frame="cam_1_color_optical_frame",
        links=(
            FrameLink("base_footprint", "base_link", (0.0, 0.0, 0.0714)),
            FrameLink("base_link", "cam_1_link", (0.0571, 0.0, 0.0376)),
        ),
        lidar_parent="base_link",
        camera_parent="cam_1_link",
        reliable=True,
    ),
)  # fmt: skip

_UGV_LD19 = RobotPreset(
    title="Waveshare UGV Rover: LD19 at a yaw of 90 degrees, USB camera on a pan-tilt at rest",
    lidar=LidarSettings(
        beams=450, rate_hz=10.0, clockwise=True, angle_min_rad=2.0 * math.pi, range_min_m=0.02,
        range_max_m=12.0, x_m=0.0403, z_m=0.12, yaw_rad=math.pi / 2.0,
    ),
    # ld19.launch.py: the device's 225 to 315 degrees, which are behind the robot.
    driver=replace(LDLIDAR_STL_ROS2, crop=SectorFilter(math.pi / 4.0, 0.75 * math.pi)),
    camera=CameraSettings(
        width_px=640, height_px=480, rate_hz=30.0, focal_widths=289.11451 / 640, aspect=289.75319 / 289.11451,
        centre_px=(347.23664, 235.67429), distortion=(-0.208848, 0.028006, -0.000705, -0.000820, 0.0),
        x_m=0.0394, z_m=0.2104, pitch_down_rad=0.0,
    ),
    wheels=WheelSettings(rate_hz=20.0),  # rate assumed
    layout=BagLayout(
        image_topic="/image_raw/compressed",
        camera_info_topic="/camera_info",
        jpeg_format="rgb8; jpeg compressed bgr8",
        base_frame="base_footprint",
        lidar_frame="base_lidar_link",
        camera_frame="pt_camera_link",
        links=(
            FrameLink("base_footprint", "base_link", (0.0005, 0.0, 0.08)),
            FrameLink("base_link", "pt_base_link", (-0.0189, 0.0, 0.04)),
            FrameLink("pt_base_link", "pt_link1", (0.0102, 0.0, 0.048), joint=True),
            FrameLink("pt_link1", "pt_link2", (0.0, 0.02, 0.043), joint=True),
        ),
        lidar_parent="base_link",
        camera_parent="pt_link2",
        reliable=True,
    ),
)  # fmt: skip

_JETROVER_G4 = RobotPreset(
    title="Hiwonder JetRover: YDLIDAR G4, depth camera on the arm at rest",
    # 9000 samples per second at 12 Hz.
    lidar=LidarSettings(
        beams=750, rate_hz=12.0, clockwise=True, angle_min_rad=math.pi, range_min_m=0.12, range_max_m=16.0,
        x_m=0.09, z_m=0.1566,
    ),
    driver=replace(YDLIDAR_ROS2_DRIVER, range_min_m=0.12, range_max_m=16.0),
    # 86 degrees of the colour camera (data sheet of the Dabai DCW); pose of the arm assumed.
    camera=CameraSettings(
        width_px=640, height_px=360, rate_hz=30.0, focal_widths=343.2 / 640, x_m=0.10, z_m=0.40,
        pitch_down_rad=math.radians(10.0),
    ),
    wheels=WheelSettings(rate_hz=50.0),
    layout=BagLayout(
        scan_topic="/scan",
        raw_scan_topic="/scan_raw",
        # The vendor's lidar_filters_config_ld19.yaml: that of the G4 is assumed to be the same.
        scan_filter=SectorFilter(1.6, 4.8, beyond=True),
        odometry_topic="/odom",
        raw_odometry_topic="/odom_raw",
        image_topic="/depth_cam/rgb/image_raw/compressed",
        camera_info_topic="/depth_cam/rgb/camera_info",
        jpeg_format="rgb8; jpeg compressed bgr8",
        base_frame="base_footprint",
        lidar_frame="lidar_frame",
        camera_frame="depth_cam_color_optical_frame",
        links=(
            FrameLink("base_footprint", "base_link", (0.0, 0.0, 0.1161)),
            FrameLink("base_link", "link1", (0.02, 0.0, 0.03), joint=True),
            FrameLink("link1", "link2", (0.0, 0.0, 0.0339), joint=True),
            FrameLink("link2", "link3", (0.0, 0.0, 0.1294), joint=True),
            FrameLink("link3", "link4", (0.0, 0.0, 0.0705), joint=True),
        ),
        lidar_parent="base_link",
        camera_parent="link4",
        reliable=True,
    ),
)  # fmt: skip

ROBOTS = {
    "turtlebot4": _TURTLEBOT4,
    "rosmaster_x3": _ROSMASTER_X3,
    "ugv_ld19": _UGV_LD19,
    "jetrover_g4": _JETROVER_G4,
}
