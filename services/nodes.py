"""THE process list: every service, by the name it has in a deployment file."""

from __future__ import annotations

from common.registry import Service

_ROWS = (
    Service(
        "replay",
        "plays a bag, a recording or a folder as if the robot were driving",
        {"default": "services.replay.node:ReplayNode"},
    ),
    Service(
        "camera",
        "reads a camera, a stream or a video",
        {"opencv": "services.camera.node:CameraNode", "none": "services.camera.node:NoCamera"},
    ),
    Service(
        "lidar",
        "reads a planar lidar",
        {
            "rplidar": "services.lidar.node:RplidarNode",
            "ldrobot": "services.lidar.node:LdrobotNode",
            "hokuyo": "services.lidar.node:HokuyoNode",
        },
    ),
    Service(
        "ros2",
        "takes the sensors of a robot that speaks ROS 2, without ROS",
        {"default": "services.ros2.node:Ros2Node"},
    ),
    Service(
        "ros2_out",
        "gives pose, transforms, map and cloud back to ROS 2",
        {"default": "services.ros2.publisher.node:Ros2OutNode"},
    ),
    Service(
        "clock",
        "a tick a second, on robots that replay nothing",
        {"default": "services.clock.node:ClockNode"},
    ),
    Service(
        "localization",
        "where the robot is",
        {
            "lidar": "services.localization.lidar2d.node:LidarLocalization",
            "camera": "services.localization.camera.node:CameraLocalization",
            "external": "services.localization.external.node:ExternalLocalization",
        },
    ),
    Service(
        "depth",
        "a dense guess for each picture",
        {"default": "services.depth.node:DepthNode"},
    ),
    Service(
        "fusion",
        "metric depth with an error bar, from beams, floor, past pictures and the guess",
        {"default": "services.fusion.node:FusionNode"},
    ),
    Service(
        "keyframes",
        "picks the pictures that the map needs",
        {"default": "services.keyframes.node:KeyframesNode"},
    ),
    Service(
        "mapping",
        "Gaussians that look like the pictures",
        {"default": "services.mapping.node:MappingNode"},
    ),
    Service(
        "uplink",
        "on a robot: carries what the topic table marks to the edge server, and answers back",
        {"default": "services.uplink.node:UplinkNode"},
    ),
    Service(
        "recorder",
        "writes what goes over the bus to an MCAP file",
        {"default": "services.recorder.node:RecorderNode"},
    ),
    Service(
        "monitor",
        "shows the running system in rerun",
        {"rerun": "services.monitor.node:MonitorNode"},
    ),
    Service(
        "page",
        "shows the running system to any browser, and takes commands of who has its token",
        {"default": "services.monitor.page.node:PageNode"},
    ),
)

NODES: dict[str, Service] = {row.name: row for row in _ROWS}
