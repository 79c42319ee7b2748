"""The process list: all services, by the name that they have in a deployment file.

Essential are the sources and what turns their data into poses and a map. The mapper is essential too: an
error at the start is better than a drive of hours without a map. Not essential is what shows, records or
forwards results. After the start no node ends the run.
"""

from __future__ import annotations

from beamsplat.common.runtime.registry import Service

_ROWS = (
    Service(
        "replay",
        "replays a bag, a recording or a folder with the timing of the drive",
        {"default": "beamsplat.services.replay.node:ReplayNode"},
        finite=True,
    ),
    Service(
        "camera",
        "reads a camera, a stream or a video",
        {
            "opencv": "beamsplat.services.camera.node:CameraNode",
            "none": "beamsplat.services.camera.node:NoCamera",
        },
    ),
    Service(
        "lidar",
        "reads a planar lidar",
        {
            "rplidar": "beamsplat.services.lidar.node:RplidarNode",
            "ldrobot": "beamsplat.services.lidar.node:LdrobotNode",
            "hokuyo": "beamsplat.services.lidar.node:HokuyoNode",
        },
    ),
    Service(
        "ros2",
        "receives the sensor data of a ROS 2 robot, without a ROS installation",
        {"default": "beamsplat.services.ros2.node:Ros2Node"},
    ),
    Service(
        "ros2_out",
        "publishes pose, transforms, map and point cloud to ROS 2",
        {"default": "beamsplat.services.ros2_out.node:Ros2OutNode"},
        essential=False,
    ),
    Service(
        "clock",
        "publishes a tick once a second, on systems without a replay",
        {"default": "beamsplat.services.clock.node:ClockNode"},
    ),
    Service(
        "localization",
        "estimates the pose of the robot: odometry and map corrections",
        {
            "lidar": "beamsplat.services.localization.lidar2d.node:LidarLocalization",
            "camera": "beamsplat.services.localization.camera.node:CameraLocalization",
            "external": "beamsplat.services.localization.external.node:ExternalLocalization",
        },
    ),
    Service(
        "depth",
        "estimates a dense depth map for each image",
        {"default": "beamsplat.services.depth.node:DepthNode"},
    ),
    Service(
        "fusion",
        "fuses lidar beams, floor, past images and the depth estimate into metric depth with a sigma",
        {"default": "beamsplat.services.fusion.node:FusionNode"},
    ),
    Service(
        "keyframes",
        "selects the keyframes for the map",
        {"default": "beamsplat.services.keyframes.node:KeyframesNode"},
    ),
    Service(
        "mapping",
        "optimises the Gaussian map to match the keyframes",
        {"default": "beamsplat.services.mapping.node:MappingNode"},
    ),
    Service(
        "uplink",
        "on a robot: bridge to the edge server, for the topics that the topic table marks",
        {"default": "beamsplat.services.uplink.node:UplinkNode"},
        essential=False,
    ),
    Service(
        "recorder",
        "records all topics to an MCAP file",
        {"default": "beamsplat.services.recorder.node:RecorderNode"},
        essential=False,
    ),
    Service(
        "monitor",
        "shows the running system in rerun",
        {"rerun": "beamsplat.services.monitor.node:MonitorNode"},
        essential=False,
    ),
    Service(
        "page",
        "shows the running system in a web browser, and accepts commands with its token",
        {"default": "beamsplat.services.page.node:PageNode"},
        essential=False,
    ),
)

NODES: dict[str, Service] = {row.name: row for row in _ROWS}
