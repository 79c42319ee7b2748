"""Keyframes as they go out: poses, anchors, depth, beams; sent again while nobody answers."""

from itertools import pairwise

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.common.messages import (
    FusedDepth,
    Image,
    Keyframe,
    KeyframeAck,
    KeyframeCandidate,
    LidarModel,
    MovingBeams,
    Odometry,
    Rig,
    Scan,
)
from beamsplat.common.messages.depth_codec import unpack_depth, unpack_mask, unpack_sigma
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.node import Node
from beamsplat.services.keyframes.node import KeyframesConfig, KeyframesNode
from tests.services.mapping import room_drive as r


def keyframes_of(config=None, drive=None, localizer=None, **others):
    node, frames = KeyframesNode(config or KeyframesConfig()), []
    nodes = [
        r.RoomDrive(drive or r.DriveConfig(pictures=12)),
        r.Localizer(localizer or r.LocalizerConfig()),
        r.Fusion(r.Fusion.Config()),
        node,
        *others.values(),
    ]
    Lockstep(
        nodes, lambda letter: frames.append(letter.message) if letter.topic == "keyframes/frame" else None
    ).run()
    return node, frames


class Acknowledges(Node):
    name = "mapping"
    inputs = ("keyframes/frame",)
    outputs = ("keyframes/ack",)

    def on_keyframes_frame(self, frame):
        yield "keyframes/ack", KeyframeAck(stamp_ns=frame.stamp_ns, id=frame.id)


@pytest.fixture(scope="module")
def frames():
    return keyframes_of()[1]


def number_of(frame):
    return (frame.stamp_ns - r.T0) // r.STEP


def test_keyframes_are_apart_by_motion(frames):
    numbers = [number_of(f) for f in frames]
    assert numbers[0] == 0
    assert all(b - a == 4 for a, b in pairwise(numbers))  # 8 cm and 1.7 degrees an image, 30 cm
    assert frames[1].why == "moved"


def test_anchor_and_relative_pose_give_the_pose_in_the_map(frames):
    for frame in frames:
        truth = r.T_map_body(number_of(frame))
        np.testing.assert_allclose(frame.T_map_anchor @ frame.T_anchor_body, truth, atol=1e-9)


def test_keyframes_hang_on_the_newest_submap_known(frames):
    by_number = {number_of(f): f for f in frames}
    assert {f.anchor_id for n, f in by_number.items() if n > 7} == {1}
    np.testing.assert_allclose(frames[-1].T_map_anchor, r.T_map_body(4), atol=1e-12)


def test_picture_and_depth_arrive_as_they_were(frames):
    for frame in frames[:2]:
        rgb, depth = r.shot(number_of(frame))
        got = decode_rgb(frame.picture, frame.encoding, r.WIDTH, r.HEIGHT)
        assert np.array_equal(got, rgb)
        back = unpack_depth(frame.depth, depth.shape)
        assert np.array_equal(np.isfinite(back), np.isfinite(depth))
        assert np.nanmax(np.abs(back - depth)) < 0.001
        assert np.nanmax(np.abs(unpack_sigma(frame.sigma, depth.shape) - 0.01)) < 3e-4
        assert len(frame.mask) == 0


def test_raw_pictures_are_compressed():
    frames = keyframes_of(drive=r.DriveConfig(pictures=5, raw=True))[1]
    assert frames[0].encoding == "jpeg"
    rgb = decode_rgb(frames[0].picture, "jpeg", r.WIDTH, r.HEIGHT).astype(float)
    assert np.abs(rgb - r.shot(0)[0]).mean() < 8.0  # the room is grainy


def test_without_an_answer_the_oldest_is_sent_again():
    node, frames = keyframes_of(KeyframesConfig(retry_s=1.0), drive=r.DriveConfig(pictures=16))
    ids = [f.id for f in frames]
    assert ids.count(ids[0]) == 4  # again after one, two and three seconds
    assert len(set(ids)) == 4
    assert "4 not acknowledged" in node.detail
    figures = {figure.name: figure.value for figure in node.figures.report()}
    assert (figures["outbox_keyframes"], figures["outbox_dropped_total"]) == (4, 0)
    assert figures["outbox_bytes"] > 4000


def test_an_answer_ends_it():
    node, frames = keyframes_of(KeyframesConfig(retry_s=1.0), mapper=Acknowledges(Acknowledges.Config()))
    ids = [f.id for f in frames]
    assert len(ids) == len(set(ids)) == 3
    assert (
        " 0 not acknowledged" in node.detail or "1 not acknowledged" in node.detail
    )  # the last one's comes late


def test_a_selected_image_whose_depth_is_not_that_of_a_keyframe_is_replaced_by_the_next():
    """Fusion was busy with earlier keyframes: the selection is cancelled, so that the map gets no hole."""
    node = KeyframesNode(KeyframesConfig())
    node.configure()
    list(
        node.handle(
            "rig", Rig(stamp_ns=r.T0, camera=r.CAMERA_MODEL, lidar=LidarModel(T_body_lidar=np.eye(4)))
        )
    )

    def decide(number):
        candidate = KeyframeCandidate(stamp_ns=r.T0 + number, T_odom_body=r.T_map_body(number), sharpness=1.0)
        ((_, decision),) = node.handle("keyframes/candidate", candidate)
        return decision.keyframe

    def answer(number, keyframe):
        depth = np.ones((r.HEIGHT, r.WIDTH), np.float32)
        fused = FusedDepth.of(depth, depth, stamp_ns=r.T0 + number, keyframe=keyframe)
        assert list(node.handle("fusion/depth", fused)) == []

    assert decide(0)
    answer(0, True)
    assert not decide(1)
    answer(1, False)
    assert decide(5)
    answer(5, False)
    assert decide(6)
    assert decide(11)
    answer(6, False)  # selected before the last one: nothing is to be replaced
    assert not decide(12)


# --- beams and movers: handlers driven by hand ---

LIDAR_Z = 0.18


def scan_of_a_wall(stamp_ns, moving_from, moving_to):
    """A wall 3 m ahead; beams moving_from..moving_to end 1.5 m ahead, on somebody's ankles."""
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    with np.errstate(divide="ignore"):
        ranges = np.where(np.abs(angles) < 1.2, 3.0 / np.cos(angles), np.inf).astype(np.float32)
    ranges[moving_from:moving_to] = 1.5 / np.cos(angles[moving_from:moving_to])
    return Scan(stamp_ns=stamp_ns, angle_min_rad=-np.pi, angle_increment_rad=2 * np.pi / 720, time_increment_s=0.0,
                scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0, ranges_m=ranges)  # fmt: skip


def drive_by_hand(moving):
    node = KeyframesNode(KeyframesConfig())
    node.configure()
    T_body_lidar = np.eye(4)
    T_body_lidar[2, 3] = LIDAR_Z
    stamp_ns = r.T0
    depth = np.full((r.HEIGHT, r.WIDTH), 2.9, np.float32)
    out = []
    for topic, message in (
        ("rig", Rig(stamp_ns=stamp_ns, camera=r.CAMERA_MODEL, lidar=LidarModel(T_body_lidar=T_body_lidar))),
        ("lidar/scan", scan_of_a_wall(stamp_ns, 350, 370)),
        ("camera/image", Image(stamp_ns=stamp_ns, width_px=r.WIDTH, height_px=r.HEIGHT, encoding="png",
                               data=r.jpeg(r.shot(0)[0]))),
        ("localization/movers", MovingBeams(stamp_ns=stamp_ns, moving=moving)),
        ("localization/odometry", Odometry(stamp_ns=stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3))),
        ("fusion/depth", FusedDepth.of(stamp_ns=stamp_ns, depth_m=depth, sigma_m=depth * 0.01, keyframe=True)),
        ("localization/odometry", Odometry(stamp_ns=stamp_ns + 10**9, T_odom_body=np.eye(4), covariance=np.eye(3))),
    ):  # fmt: skip
        out += list(node.handle(topic, message))
    assert [topic for topic, _ in out] == ["keyframes/frame"]
    frame = out[0][1]
    assert isinstance(frame, Keyframe)
    return frame


def test_beams_lie_where_the_camera_sees_them():
    frame = drive_by_hand(np.zeros(720, bool))
    assert frame.anchor_id == -1  # no submap is published yet: the origin of the odom frame
    points = np.column_stack([
        (frame.beams[:, 0] - 79.5) / r.FOCAL * frame.beams[:, 2],
        (frame.beams[:, 1] - 59.5) / r.FOCAL * frame.beams[:, 2],
        frame.beams[:, 2],
    ])  # fmt: skip
    body = transform_points(r.T_BODY_CAMERA, points)
    assert len(body) > 60
    np.testing.assert_allclose(body[:, 2], LIDAR_Z, atol=1e-4)
    assert np.all(np.minimum(np.abs(body[:, 0] - 3.0), np.abs(body[:, 0] - 1.5)) < 1e-4)
    assert len(frame.mask) == 0


def test_movers_are_masked_and_their_beams_left_out():
    moving = np.zeros(720, bool)
    moving[350:370] = True
    frame = drive_by_hand(moving)
    assert np.all(frame.beams[:, 2] > 2.0)
    mask = unpack_mask(frame.mask, (r.HEIGHT, r.WIDTH))
    assert not mask[60, 79]  # the walker
    assert mask[:, :20].all()
    assert 0.02 < (~mask).mean() < 0.5
    np.testing.assert_allclose(inverse(frame.T_map_anchor) @ frame.T_map_anchor, np.eye(4), atol=1e-12)
