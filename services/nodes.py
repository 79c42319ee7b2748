"""THE process list: every service, by the name it has in a deployment file."""

from __future__ import annotations

from beamsplat.common.runtime.registry import Service

_ROWS = (
    Service(
        "replay",
        "plays a bag, a recording or a folder as if the robot were driving",
        {"default": "beamsplat.services.replay.node:ReplayNode"},
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
        "takes the sensors of a robot that speaks ROS 2, without ROS",
        {"default": "beamsplat.services.ros2.node:Ros2Node"},
    ),
    Service(
        "ros2_out",
        "gives pose, transforms, map and cloud back to ROS 2",
        {"default": "beamsplat.services.ros2_out.node:Ros2OutNode"},
    ),
    Service(
        "clock",
        "a tick a second, on robots that replay nothing",
        {"default": "beamsplat.services.clock.node:ClockNode"},
    ),
    Service(
        "localization",
        "where the robot is",
        {
            "lidar": "beamsplat.services.localization.lidar2d.node:LidarLocalization",
            "camera": "beamsplat.services.localization.camera.node:CameraLocalization",
            "external": "beamsplat.services.localization.external.node:ExternalLocalization",
        },
    ),
    Service(
        "depth",
        "a dense guess for each picture",
        {"default": "beamsplat.services.depth.node:DepthNode"},
    ),
    Service(
        "fusion",
        "metric depth with an error bar, from beams, floor, past pictures and the guess",
        {"default": "beamsplat.services.fusion.node:FusionNode"},
    ),
    Service(
        "keyframes",
        "picks the pictures that the map needs",
        {"default": "beamsplat.services.keyframes.node:KeyframesNode"},
    ),
    Service(
        "mapping",
        "Gaussians that look like the pictures",
        {"default": "beamsplat.services.mapping.node:MappingNode"},
    ),
    Service(
        "uplink",
        "on a robot: carries what the topic table marks to the edge server, and answers back",
        {"default": "beamsplat.services.uplink.node:UplinkNode"},
    ),
    Service(
        "recorder",
        "writes what goes over the bus to an MCAP file",
        {"default": "beamsplat.services.recorder.node:RecorderNode"},
    ),
    Service(
        "monitor",
        "shows the running system in rerun",
        {"rerun": "beamsplat.services.monitor.node:MonitorNode"},
    ),
    Service(
        "page",
        "shows the running system to any browser, and takes commands of who has its token",
        {"default": "beamsplat.services.page.node:PageNode"},
    ),
)

NODES: dict[str, Service] = {row.name: row for row in _ROWS}
