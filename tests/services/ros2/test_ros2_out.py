"""What nodes of a ROS 2 robot receive: keys of their distribution, metres of known truth, honest counts.

Sessions and router are real; keys, tokens and decoding of the robot are in robot_nodes.py.
"""

from contextlib import contextmanager

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import se2_to_se3, transform_points
from beamsplat.common.messages import (
    CameraModel,
    Correction,
    FusedDepth,
    MapChunk,
    MapPreview,
    Odometry,
    Rig,
    Tick,
)
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.zenoh.bus import open_session
from beamsplat.services.ros2_out.config import Ros2OutConfig
from beamsplat.services.ros2_out.node import Ros2OutNode
from tests.services.mapping import room_drive
from tests.services.mapping.session import maps
from tests.services.ros2.robot_nodes import RobotNode, image_of, matrix, points_of, wait

DOMAIN = 11
POSE_TOPIC = "/beamsplat/map_view/pose"
S = 10**9
IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
CLOUD, TF, POSE = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped"
WALL_M = 4.0  # x of a wall in the map frame
CAMERA = CameraModel(
    width_px=64, height_px=48, fx_px=55.0, fy_px=56.0, cx_px=30.5, cy_px=22.0, distortion_model="plumb_bob",
    distortion=(-0.2, 0.05, 0.001, 0.0, 0.0), T_body_camera=camera_mount(0.1, 0.02, 0.45),
)  # fmt: skip
T_MAP_ODOM, T_ODOM_BODY = se2_to_se3(np.array([0.4, -0.2, 0.2])), se2_to_se3(np.array([1.0, 0.5, -0.1]))


@contextmanager
def running(endpoint, **options):
    """A node that is driven by hand, and a session of the robot on the same router."""
    node = Ros2OutNode(Ros2OutConfig(domain=DOMAIN, router=endpoint, **options))
    with open_session((endpoint,)) as robot:
        try:
            yield node, robot
        finally:
            node.close()


def send(node, *messages):
    topics = {Rig: "rig", Correction: "localization/correction", Odometry: "localization/odometry",
              FusedDepth: "fusion/depth", MapChunk: "mapping/chunk", MapPreview: "mapping/preview",
              Tick: "tick"}  # fmt: skip
    for message in messages:
        topic = topics[type(message)]
        node.on_header(Header(message.stamp_ns, 0, 0, 0, 0, topic.partition("/")[0], "ab" * 8))
        assert list(node.handle(topic, message)) == []


def wait_for_match(node, *names):
    """A Zenoh publisher sends to a subscriber once it has heard of it."""
    publishers = [node._ros._publishers[name] for name in names]
    wait(lambda: all(e.matched for p in publishers for e in p.endpoints.values()), say=node._ros.status)


def pose(stamp_ns):
    return Odometry(stamp_ns=stamp_ns, T_odom_body=T_ODOM_BODY, covariance=np.eye(3))


def wall_depth():
    """Optical z (m) of the wall in each pixel of the undistorted image; NaN where a block is unknown."""
    T_map_camera = T_MAP_ODOM @ T_ODOM_BODY @ CAMERA.T_body_camera
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    rays = np.stack(
        [(u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px, np.ones(u.shape)], -1
    )
    depth = (WALL_M - T_map_camera[0, 3]) / (rays @ T_map_camera[0, :3])
    depth[5:9, 7:20] = np.nan
    return depth.astype(np.float32)


def chunk(stamp_ns, anchor, points_m, colours, T=None, revision=1, opacity_logit=4.0):
    params = np.zeros((14, len(points_m)), np.float32)
    params[:3], params[3:6], params[6] = np.transpose(points_m), -4.0, 1.0
    params[10], params[11:] = opacity_logit, np.transpose(colours) / 255.0
    return MapChunk(stamp_ns=stamp_ns, anchor_id=anchor, revision=revision, count=len(points_m),
                    T_map_anchor=np.eye(4) if T is None else T, packed=pack(params))  # fmt: skip


@pytest.mark.parametrize("distribution", ["humble", "jazzy", "kilted", "lyrical"])
def test_depth_and_transforms_give_the_robot_points_on_the_true_wall(router_endpoint, distribution):
    with running(router_endpoint) as (node, session):
        robot = RobotNode(session, DOMAIN, distribution)
        images = robot.subscribe("/beamsplat/depth/image_rect", IMAGE)
        infos = robot.subscribe("/beamsplat/depth/camera_info", INFO)
        mounts = robot.subscribe("/tf_static", TF, latched=True)
        moves = robot.subscribe("/tf", TF)
        node.configure()
        wait_for_match(node, "depth", "depth_info", "tf")
        send(node, Rig(stamp_ns=1, camera=CAMERA), Correction(stamp_ns=2, T_map_odom=T_MAP_ODOM), pose(3 * S))
        depth = wall_depth()
        wait(lambda: moves and mounts, say=node._ros.status)
        send(node, FusedDepth.of(stamp_ns=3 * S, depth_m=depth, sigma_m=depth * 0.1),
             FusedDepth.of(stamp_ns=4 * S, depth_m=depth[:0, :0], sigma_m=depth[:0, :0], status="no pose"))  # fmt: skip
        wait(lambda: images and infos, say=node._ros.status)
        assert "depth 1 to 1, depth_info 1 to 1" in node.detail
    (image, sequence), (info, _) = images[0], infos[0]
    assert len(images) == len(infos) == sequence == 1
    assert image.encoding == "32FC1"
    assert image.header == info.header
    assert (image.header.stamp.sec, image.header.frame_id) == (3, "beamsplat_camera")
    assert not np.any(info.d)
    received = image_of(image)
    np.testing.assert_allclose(received, depth, rtol=0.0, atol=0.00051)  # mm; NaN included
    edges = {t.child_frame_id: (t.header.frame_id, matrix(t.transform))
             for message, _ in [*mounts, *moves] for t in message.transforms}  # fmt: skip
    T_map_camera, frame = np.eye(4), image.header.frame_id
    while frame != "map":
        frame, T = edges[frame]
        T_map_camera = T @ T_map_camera
    v, u = np.nonzero(np.isfinite(received))
    K, z = np.reshape(info.k, (3, 3)), received[v, u].astype(float)
    seen = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=1)
    assert len(seen) == 64 * 48 - 4 * 13
    assert np.abs(transform_points(T_map_camera, seen)[:, 0] - WALL_M).max() < 0.00052  # depth is in whole mm


def test_a_depth_of_another_size_than_the_calibration_is_refused_and_counted(router_endpoint):
    with running(router_endpoint) as (node, session):
        robot = RobotNode(session, DOMAIN, "jazzy")
        images = robot.subscribe("/beamsplat/depth/image_rect", IMAGE)
        node.configure()
        wait_for_match(node, "depth")
        small = np.ones((24, 32), np.float32)
        send(node, Rig(stamp_ns=1, camera=CAMERA), FusedDepth.of(stamp_ns=S, depth_m=small, sigma_m=small),
             FusedDepth.of(stamp_ns=2 * S, depth_m=wall_depth(), sigma_m=wall_depth()))  # fmt: skip
        wait(lambda: images)
        assert [m.header.stamp.sec for m, _ in images] == [2]
        (entry,) = node.rejections.report()
        assert "do not belong to the calibration" in entry.reason


def test_hash_kinds_follow_the_robots_nodes_and_latched_messages_follow_them(router_endpoint):
    def publishers(session):
        tokens = [str(r.ok.key_expr) for r in session.liveliness().get(f"@ros2_lv/{DOMAIN}/**/MP/**")]
        return {"humble" if "TypeHashNotSupported" in t else "newer" for t in tokens if "/beamsplat/" in t}

    points, colours = np.array([[1.0, 2.0, 0.5]]), np.array([[10, 20, 30]])
    with running(router_endpoint) as (node, session):
        node.configure()
        assert publishers(session) == {"newer"}  # nothing is known yet
        send(node, chunk(S, 0, points, colours))
        laptop = RobotNode(session, DOMAIN, "humble", "rviz2")
        late = laptop.subscribe("/beamsplat/map_cloud", CLOUD, latched=True)
        wait(lambda: late)  # published before this node existed, and with another key
        wait(lambda: publishers(session) == {"humble"}, say=lambda: str(publishers(session)))
        newer = RobotNode(session, DOMAIN, "jazzy", "nav2", number=2)
        both = newer.subscribe("/beamsplat/map_cloud", CLOUD, latched=True)
        wait(lambda: both and publishers(session) == {"humble", "newer"})
        assert points_of(both[0][0])[0] == pytest.approx(points, abs=1e-4)
        laptop.end()
        wait(lambda: publishers(session) == {"newer"})
        newer.end()  # the robot restarts: its kind is kept
        wait(lambda: "map_cloud 1 to 0" in node._ros.status(), say=node._ros.status)
        assert publishers(session) == {"newer"}


def test_only_what_a_subscriber_can_take_is_counted_and_the_others_are_named(router_endpoint):
    with running(router_endpoint) as (node, session):
        robot = RobotNode(session, DOMAIN, "jazzy", "nav2")
        robot.endpoint("MS", "/beamsplat/pose", "nav_msgs/msg/Odometry")
        robot.endpoint("MS", "/beamsplat/pose_with_covariance",
                       "geometry_msgs/msg/PoseWithCovarianceStamped", type_hash="RIHS01_" + "12" * 32)  # fmt: skip
        node.configure()
        for number in range(3):
            send(node, pose(number * S))
        assert "no subscriber: pose, pose_covariance, tf" in node.detail
        for text in ("/nav2 expects nav_msgs/msg/Odometry on /beamsplat/pose, whose type is geometry_msgs/msg/PoseStamped",
                     "/nav2 has another definition of geometry_msgs/msg/PoseWithCovarianceStamped"):  # fmt: skip
            assert text in node.detail
            assert [e.count for e in node.rejections.report() if e.reason.startswith(text)] == [3]
        taken = robot.subscribe("/beamsplat/pose", POSE)
        wait(lambda: "pose 0 to 1" in node._ros.status())
        wait_for_match(node, "pose")
        for number in range(4):
            send(node, pose(number * S))
        wait(lambda: len(taken) == 4)
        assert "pose 4 to 1" in node.detail
        other = RobotNode(session, DOMAIN, "jazzy", "rviz2", number=2)
        other.subscribe("/beamsplat/pose", POSE)
        wait(
            lambda: "pose 4 to 2" in node._ros.status()
        )  # a second subscriber takes what comes, not what was
        other.end()
        robot.end()
        wait(lambda: "pose 4 to 0" in node._ros.status())
        send(node, pose(9 * S))
        assert "pose 4 to 0" in node.detail


def test_the_map_cloud_has_the_true_points_and_is_published_when_the_map_has_changed(router_endpoint):
    rng = np.random.default_rng(0)
    points = rng.uniform(-3.0, 3.0, (200, 3))
    colours = rng.integers(0, 255, (200, 3))
    T = se2_to_se3(np.array([2.0, -1.0, 0.7]))
    with running(router_endpoint, map_cloud_cell_m=0.01) as (node, session):
        robot = RobotNode(session, DOMAIN, "jazzy")
        clouds = robot.subscribe("/beamsplat/map_cloud", CLOUD, latched=True)
        node.configure()
        send(node, chunk(S, 7, points, colours, T))
        wait(lambda: len(clouds) == 1)
        send(node, *(Tick(stamp_ns=t * S, count=t) for t in range(2, 20)))  # nothing new
        send(node, chunk(20 * S, 8, points[:50] + 10.0, colours[:50]), chunk(21 * S, 8, points[:60] + 10.0, colours[:60],
             revision=2), chunk(22 * S, 8, points[:10], colours[:10], revision=1))  # fmt: skip
        send(node, *(Tick(stamp_ns=t * S, count=t) for t in range(22, 40)))
        wait(lambda: len(clouds) == 3, say=lambda: str(len(clouds)))
        late = RobotNode(session, DOMAIN, "jazzy", "late", number=2)
        again = late.subscribe("/beamsplat/map_cloud", CLOUD, latched=True)
        wait(lambda: again)
        assert len(clouds) == 3
    first, last = clouds[0][0], clouds[2][0]
    assert (first.header.frame_id, first.header.stamp.sec, last.header.stamp.sec) == ("map", 1, 22)
    at, seen = points_of(first)
    order, true = np.lexsort(at.T), transform_points(T, points)
    truth = np.lexsort(true.T)
    assert np.abs(at[order] - true[truth]).max() < 2e-4  # the chunk's quantisation: 6 m / 65535
    assert np.abs(seen[order].astype(int) - colours[truth]).max() <= 1
    assert last.width == 200 + 60
    np.testing.assert_array_equal(again[0][0].data, last.data)


def test_the_map_as_a_camera_has_pose_and_intrinsics_of_the_render(router_endpoint):
    rgb = np.zeros((24, 32, 3), np.uint8)
    rgb[:, 16:] = (200, 40, 90)
    jpeg = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, 95))[
        1
    ].ravel()
    T_map_camera = T_MAP_ODOM @ T_ODOM_BODY @ CAMERA.T_body_camera
    model = CameraModel(width_px=32, height_px=24, fx_px=27.5, fy_px=28.0, cx_px=15.0, cy_px=10.75,
                        T_body_camera=CAMERA.T_body_camera)  # fmt: skip
    with running(router_endpoint, tf=False) as (node, session):
        robot = RobotNode(session, DOMAIN, "jazzy")
        images = robot.subscribe("/beamsplat/map_camera/image", IMAGE)
        infos = robot.subscribe("/beamsplat/map_camera/camera_info", INFO)
        moves = robot.subscribe("/tf", TF)
        node.configure()
        wait_for_match(node, "render", "render_info", "tf")
        view = {"keyframe_id": 1, "T_map_camera": T_map_camera}
        send(node, MapPreview(stamp_ns=S, render=jpeg, **view), MapPreview(stamp_ns=2 * S, render=jpeg[:50], camera=model, **view),
             MapPreview(stamp_ns=3 * S, render=jpeg, camera=model, **view))  # fmt: skip
        wait(lambda: images and infos and moves)
        reasons = " ".join(entry.reason for entry in node.rejections.report())
        assert "does not say with which camera" in reasons
        assert "do not decode as jpeg" in reasons
    ((image, _),), ((info, _),), ((move, _),) = images, infos, moves
    assert image.header == info.header == move.transforms[0].header.__class__(
        image.header.stamp, move.transforms[0].child_frame_id)  # fmt: skip
    assert image.header.stamp.sec == 3
    assert move.transforms[0].header.frame_id == "map"
    assert matrix(move.transforms[0].transform) == pytest.approx(T_map_camera, abs=1e-12)
    assert np.reshape(info.k, (3, 3)) == pytest.approx(model.K)
    assert np.reshape(info.p, (3, 4))[:, :3] == pytest.approx(model.K)
    assert (info.width, info.height) == (32, 24)
    off = np.abs(image_of(image).astype(int) - rgb)
    assert off[:, :12].max() <= 8
    assert off[:, 20:].max() <= 8


@pytest.mark.parametrize("distribution", ["humble", "jazzy"])
def test_the_map_is_rendered_from_the_pose_that_a_node_asks_for(router_endpoint, distribution):
    mapper = maps.make_node(half_steps=40, full_steps=20)
    maps.feed(mapper, range(4))
    node = Ros2OutNode(Ros2OutConfig(domain=DOMAIN, router=router_endpoint))
    node.set_query_function(lambda name, query, given, _: getattr(mapper, f"on_query_{query}")(given))
    camera = room_drive.CAMERA_MODEL
    T_body_view = np.eye(4)  # x forward, z up, at the camera
    T_body_view[:3, 3] = camera.T_body_camera[:3, 3]
    with open_session((router_endpoint,)) as session:
        robot = RobotNode(session, DOMAIN, distribution)
        images = robot.subscribe("/beamsplat/map_view/image", IMAGE)
        infos = robot.subscribe("/beamsplat/map_view/camera_info", INFO)
        moves = robot.subscribe("/tf", TF)
        try:
            node.configure()
            wait_for_match(node, "view", "view_info", "tf")
            robot.publish(POSE_TOPIC, ros_pose("odom", room_drive.T_map_body(2) @ T_body_view, 5))
            wait(lambda: node.rejections.report())
            robot.publish(POSE_TOPIC, ros_pose("map", room_drive.T_map_body(2) @ T_body_view, 6))
            wait(lambda: images and infos and moves, say=lambda: str(node.rejections.report()))
        finally:
            node.close()
    ((image, _),), ((info, _),), ((move, _),) = images, infos, moves
    (entry,) = node.rejections.report()
    assert (
        entry.reason
        == f"view of the map not published: {POSE_TOPIC}: header.frame_id = 'odom': expected 'map'"
    )
    assert image.header == info.header
    assert (image.header.stamp.sec, image.header.frame_id) == (6, "beamsplat_map_view")
    assert move.transforms[0].header.frame_id == "map"
    seen_from = room_drive.T_map_body(2) @ camera.T_body_camera
    assert matrix(move.transforms[0].transform) == pytest.approx(seen_from, abs=1e-9)
    assert (image.width, image.height) == (80, 60)
    assert np.reshape(info.k, (3, 3))[0, 0] == pytest.approx(camera.fx_px / 2)
    truth = cv2.resize(room_drive.shot(2)[0], (80, 60), interpolation=cv2.INTER_AREA)
    error = np.mean((image_of(image) / 255.0 - truth / 255.0) ** 2)
    assert -10.0 * np.log10(error) > 20.0  # the map was optimised for a moment only


def ros_pose(frame, T, sec):
    return ros.new(POSE, header=ros.header(sec * S, frame), pose=ros.pose(T))
