"""A robot that drives through the synthetic room, as nodes: pictures with exact depth, poses, submaps."""

from functools import lru_cache

import cv2
import numpy as np

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.geometry.transforms import inverse, make_transform, se2_to_se3, so3_exp
from beamsplat.common.messages import (
    Anchors,
    CameraModel,
    Correction,
    FusedDepth,
    Image,
    KeyframeCandidate,
    LidarModel,
    Odometry,
    Rig,
    Tick,
)  # fmt: skip
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.common.runtime.node import Input, Node, SourceItem
from beamsplat.common.runtime.registry import Service
from beamsplat.tools.bench.raster import synthetic_room

WIDTH, HEIGHT, FOCAL = 160, 120, 110.0
CAMERA = RasterCamera(FOCAL, FOCAL, 79.5, 59.5, WIDTH, HEIGHT)
T0, STEP = 1_000_000_000_000, 250_000_000
TURN = 24
T_MAP_ODOM = se2_to_se3(np.array([0.3, -0.2, 0.1]))


@lru_cache(maxsize=1)
def room():
    params, T_camera_map = synthetic_room(20_000)
    params[3:5] += 0.5
    params[10] = 3.0
    return params, inverse(T_camera_map)


T_BODY_CAMERA = make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.1, 0.0, 0.4])
)


def T_map_body(number):
    """Sideways steps of 8 cm and turns of 2 degrees; there and back again, where the room has walls."""
    number = TURN - abs(TURN - number % (2 * TURN))
    T_map_camera = room()[1] @ make_transform(
        so3_exp([0.0, 0.03 * number, 0.0]), np.array([0.08 * number, 0.0, 0.0])
    )
    return T_map_camera @ inverse(T_BODY_CAMERA)


@lru_cache(maxsize=64)
def shot(number):
    """(rgb uint8 [H, W, 3], depth float32 [H, W]) of picture `number`."""
    rasterizer = Rasterizer()
    T_map_camera = T_map_body(number) @ T_BODY_CAMERA
    render = rasterizer.render(room()[0], 20_000, CAMERA, inverse(T_map_camera))
    rgb = (np.clip(render.image[:3].transpose(1, 2, 0), 0, 1) * 255 + 0.5).astype(np.uint8)
    depth = np.where(render.image[4] > 0.9, render.expected_depth(), np.nan).astype(np.float32)
    return rgb, depth


def jpeg(rgb):
    return cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].ravel()


CAMERA_MODEL = CameraModel(width_px=WIDTH, height_px=HEIGHT, fx_px=FOCAL, fy_px=FOCAL, cx_px=79.5, cy_px=59.5,
                           T_body_camera=T_BODY_CAMERA)  # fmt: skip


class DriveConfig(NodeConfig):
    pictures: int = 10
    raw: bool = False


class RoomDrive(Node):
    """Four pictures a second, a tick each second."""

    name = "replay"
    Config = DriveConfig
    outputs = ("rig", "camera/image", "tick")

    def source(self):
        rig = Rig(stamp_ns=T0, camera=CAMERA_MODEL, lidar=LidarModel(T_body_lidar=np.eye(4)))
        yield SourceItem(T0, "rig", rig)
        for i in range(self.config.pictures):
            stamp_ns = T0 + i * STEP
            rgb = shot(i)[0]
            encoding, data = ("rgb8", rgb.ravel()) if self.config.raw else ("png", jpeg(rgb))
            image = Image(stamp_ns=stamp_ns, width_px=WIDTH, height_px=HEIGHT, encoding=encoding, data=data)
            yield SourceItem(stamp_ns, "camera/image", image)
            if i % 4 == 3:
                yield SourceItem(stamp_ns + 1, "tick", Tick(stamp_ns=stamp_ns + 1, count=i // 4))


class LocalizerConfig(NodeConfig):
    first_anchors_at: int = 3  # picture at which submap 0 is named; submap 1 comes three later
    jump_at: int = 1000  # picture at which all submaps but the first move


class Localizer(Node):
    """Knows the poses; names submaps now and then."""

    name = "localization"
    Config = LocalizerConfig
    inputs = (Input("camera/image", "every"),)
    outputs = ("localization/odometry", "localization/correction", "localization/anchors")

    def on_camera_image(self, image):
        number = (image.stamp_ns - T0) // STEP
        if number == 0:
            yield "localization/correction", Correction(stamp_ns=image.stamp_ns, T_map_odom=T_MAP_ODOM)
        T_odom_body = inverse(T_MAP_ODOM) @ T_map_body(number)
        yield (
            "localization/odometry",
            Odometry(stamp_ns=image.stamp_ns, T_odom_body=T_odom_body, covariance=np.eye(3)),
        )
        first = self.config.first_anchors_at
        if number in (first, first + 3, self.config.jump_at):
            yield "localization/anchors", self._anchors(image.stamp_ns, number)

    def _anchors(self, stamp_ns, number):
        ids = [0, 1][: 1 + (number >= self.config.first_anchors_at + 3)]
        T = np.stack([T_map_body(0), T_map_body(4)])[: len(ids)]
        if number >= self.config.jump_at:
            T[1:] = JUMP @ T[1:]
        return Anchors(stamp_ns=stamp_ns, anchor_ids=np.array(ids), T_map_anchor=T, optimisation=number)


JUMP = se2_to_se3(np.array([1.0, 0.0, np.deg2rad(10.0)]))


class Fusion(Node):
    """True depth; asks for every image whether it becomes a keyframe."""

    name = "fusion"
    inputs = (Input("camera/image", "every"), Input("keyframes/decision", feedback=True))
    outputs = ("keyframes/candidate", "fusion/depth")

    def configure(self):
        shot(0)

    def on_camera_image(self, image):
        T_odom_body = inverse(T_MAP_ODOM) @ T_map_body((image.stamp_ns - T0) // STEP)
        yield (
            "keyframes/candidate",
            KeyframeCandidate(stamp_ns=image.stamp_ns, T_odom_body=T_odom_body, sharpness=1.0),
        )

    def on_keyframes_decision(self, decision):
        number = (decision.stamp_ns - T0) // STEP
        depth = shot(number)[1]
        yield (
            "fusion/depth",
            FusedDepth.of(stamp_ns=decision.stamp_ns, depth_m=depth, sigma_m=np.full_like(depth, 0.01),
                       keyframe=decision.keyframe, T_odom_body=inverse(T_MAP_ODOM) @ T_map_body(number)),
        )  # fmt: skip


_HERE = "tests.services.mapping.room_drive:"
TABLE = {
    "replay": Service("replay", "", {"room": _HERE + "RoomDrive"}),
    "localization": Service("localization", "", {"known": _HERE + "Localizer"}),
    "fusion": Service("fusion", "", {"true": _HERE + "Fusion"}),
    "keyframes": Service("keyframes", "", {"default": "beamsplat.services.keyframes.node:KeyframesNode"}),
    "mapping": Service("mapping", "", {"default": "beamsplat.services.mapping.node:MappingNode"}),
}
