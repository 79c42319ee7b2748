"""No message that decodes can end a node: NaN bursts, impossible stamps, sizes, poses and calibrations."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from beamsplat.common.messages import (
    CameraModel,
    FusedDepth,
    Image,
    Message,
    Odometry,
    Rig,
    Scan,
    WheelOdometry,
)
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.node import subscriptions
from beamsplat.common.topics import topic
from beamsplat.services.page.events import as_json
from beamsplat.services.page.node import PageNode
from tests.common.messages.random_messages import random_message
from tests.services.test_bounded_memory import KINDS, RIG, Player, make, step

_STAMPS = (0, 1, 10**18, 10**18 + 10**8, 2**62 - 1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("service", "kind"), KINDS)
def test_random_messages_do_not_end_a_node(service, kind, seed, tmp_path, router_endpoint):
    rng = np.random.default_rng(seed)
    node = make(service, kind, tmp_path, router_endpoint)
    player = Player(node)
    topics = [entry.topic for entry in subscriptions(type(node))]
    usual = [
        (name, make())
        for number in range(4)
        for name, make in step(number, 10**18 + number * 10**8, False).items()
        if name in topics
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            for _ in range(150):
                name = topics[rng.integers(len(topics))]
                if name == "rig":
                    message = RIG if rng.random() < 0.5 else _random_rig(rng)
                else:
                    message = _message(name, usual, rng)
                player.send(
                    name, message, Header(message.stamp_ns, 0, 0, 0, 0, name.partition("/")[0], "0" * 16)
                )
                if isinstance(node, PageNode):  # what its server does for an open page
                    for image in node._fleet.own_state.images.values():
                        image.encode_newest()
                    for data in (
                        node._fleet.own_state.status(),
                        node._fleet.own_state.robot(),
                        node._fleet.own_state.path(),
                    ):
                        as_json(data)
            player.end()
        finally:
            node.close()


def _random_rig(rng: np.random.Generator) -> Rig:
    """Return a calibration of a small image with extreme, but valid numbers, or without camera or lidar."""
    assert RIG.camera is not None
    size = tuple(int(value) for value in rng.integers(1, 100, 2))
    focal = max(size) * 10.0 ** rng.uniform(-1.6, 1.9)
    lens = rng.choice(["none", "plumb_bob", "equidistant"])
    coefficients = {"none": 0, "plumb_bob": 5, "equidistant": 4}[lens]
    camera = CameraModel(
        width_px=size[0], height_px=size[1], fx_px=focal, fy_px=focal, cx_px=size[0] / 3, cy_px=size[1] / 3,
        distortion_model=str(lens), T_body_camera=RIG.camera.T_body_camera,
        distortion=tuple(rng.normal(0.0, 10.0 ** rng.integers(-3, 9), coefficients).tolist()),
    )  # fmt: skip
    return Rig(
        stamp_ns=1,
        camera=camera if rng.random() < 0.8 else None,
        lidar=RIG.lidar if rng.random() < 0.8 else None,
    )


def _message(name: str, usual: list[tuple[str, Message]], rng: np.random.Generator) -> Message:
    """Return a usual message with random values in some fields, or an entirely random one."""
    cls = topic(name).message
    other = random_message(cls, rng)
    same = [message for known, message in usual if known == name]
    message = same[rng.integers(len(same))] if same and rng.random() < 0.8 else other
    stamp_ns = int(rng.choice(_STAMPS)) if rng.random() < 0.3 else message.stamp_ns
    fields = {field: getattr(message, field) for field in cls.model_fields} | {"stamp_ns": stamp_ns}
    for field in cls.model_fields:
        if rng.random() < 0.15 and field != "stamp_ns":
            fields[field] = getattr(other, field)
    try:
        return cls(**fields)
    except ValueError:  # refused by the message itself
        return message


@pytest.mark.parametrize("shape", [(16_384, 1), (1, 16_384), (0, 5)])
def test_the_page_shows_a_depth_map_of_any_shape(shape, tmp_path, router_endpoint):
    node = make("page", "default", tmp_path, router_endpoint)
    try:
        depth = np.ones(shape, np.float32)
        list(
            node.on_fusion_depth(
                FusedDepth.of(stamp_ns=1, depth_m=depth, sigma_m=depth, T_odom_body=np.eye(4))
            )
        )
        node._fleet.own_state.images["depth"].encode_newest()
    finally:
        node.close()


POSE = {"T_odom_body": np.eye(4), "covariance": np.eye(3)}
SCAN = {
    "angle_min_rad": 0.0, "angle_increment_rad": 0.01, "time_increment_s": 0.0, "scan_time_s": 0.1,
    "range_min_m": 0.1, "range_max_m": 9.0, "ranges_m": np.ones(4, np.float32),
}  # fmt: skip
CAMERA = {
    "width_px": 640, "height_px": 480, "fx_px": 500.0, "fy_px": 500.0, "cx_px": 320.0, "cy_px": 240.0,
    "T_body_camera": np.eye(4),
}  # fmt: skip
IMAGE = {"width_px": 4, "height_px": 3, "encoding": "jpeg", "data": np.zeros(5, np.uint8)}
WHEELS = {"T_odom_body": np.eye(4), "velocity_m_s": np.zeros(3), "angular_velocity_rad_s": np.zeros(3)}
FAR = np.eye(4)
FAR[0, 3] = 1e9


@pytest.mark.parametrize(
    ("cls", "valid", "field", "value"),
    [
        (Odometry, POSE, "stamp_ns", -1), (Odometry, POSE, "stamp_ns", 2**62),
        (Odometry, POSE, "T_odom_body", FAR), (Odometry, POSE, "T_odom_body", np.full((4, 4), np.nan)),
        (Scan, SCAN, "time_increment_s", 1e300), (Scan, SCAN, "scan_time_s", np.inf),
        (Scan, SCAN, "angle_increment_rad", 1e300), (Scan, SCAN, "angle_min_rad", np.nan),
        (Scan, SCAN, "range_max_m", 1e300), (Scan, SCAN, "ranges_m", np.ones(70_000, np.float32)),
        (Image, IMAGE, "width_px", 0), (Image, IMAGE, "height_px", 16384 * 1024),
        (WheelOdometry, WHEELS, "velocity_m_s", np.full(3, 1e300)),
        (WheelOdometry, WHEELS, "angular_velocity_rad_s", np.full(3, np.inf)),
        (CameraModel, CAMERA, "fx_px", 1e-300), (CameraModel, CAMERA, "fy_px", 1e300),
        (CameraModel, CAMERA, "cx_px", np.nan), (CameraModel, CAMERA, "width_px", 16384 * 4),
    ],
)  # fmt: skip
def test_messages_refuse_what_is_impossible(cls, valid, field, value):
    stamp = {} if cls is CameraModel else {"stamp_ns": 10**18}
    cls(**stamp, **valid)
    with pytest.raises(ValueError, match=cls.__name__):
        cls(**(stamp | valid | {field: value}))
