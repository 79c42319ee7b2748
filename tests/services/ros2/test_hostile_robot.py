"""Names and values of a ROS 2 robot, or of anybody on its router, neither end the node nor fill its memory."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from beamsplat.common.errors import UserError
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.zenoh.bus import open_router, open_session
from beamsplat.common.zenoh.rmw import RmwEntity, RmwQos
from beamsplat.services.ros2.config import Ros2Config
from beamsplat.services.ros2.node import Ros2Node
from beamsplat.services.ros2.robot import RosRobot, RosRobotOptions
from tests.services.reachable import reachable
from tests.services.replay.make_bags import START_NS, Drive, write_bag


@pytest.fixture(scope="module", params=["static", "repeated"])
def messages(request, tmp_path_factory):
    """(topic, type, bytes) of a robot, with odometry from its topic, or from /tf."""
    drive = Drive(seconds=1.0, tf=request.param, odometry=request.param == "static", pose=True, images="rgb8")
    folder = write_bag(tmp_path_factory.mktemp("bag"), "mcap", drive)
    with AnyReader([folder]) as reader:
        return [(c.topic, c.msgtype, bytes(data)) for c, _, data in reader.messages()]


def started(messages):
    robot = RosRobot(RosRobotOptions(settle_s=0.0))
    found = [robot.convert(*message, START_NS, 1.0) for message in messages]
    assert robot.rig is not None, robot.status
    assert any(found[-10:])
    return robot


def flood(robot, messages, numbers):
    """Send what the robot sends, from other topics and frames each time."""
    for number in numbers:
        topic, type_name, data = messages[number % len(messages)]
        name = f"/robot{number}{topic}"
        robot.add_publisher(name, type_name)
        robot.ignore_topic(f"{name}/ours")
        robot.convert(name, type_name, data, START_NS, 0.0)
        edges = [("odom", f"base_link{number}"), (f"{number}/odom", f"{number}/base_link")]
        stamped = [ros.tf(START_NS, *edge, np.eye(4)) for edge in edges]
        for tf_topic in ("/tf", "/tf_static", f"/{number}/tf"):
            robot.convert(
                tf_topic, "tf2_msgs/msg/TFMessage", ros.serialize(ros.tf_message(stamped)), START_NS, 0.0
            )


@pytest.mark.parametrize("calibrated", [False, True])
def test_names_of_topics_and_frames_do_not_fill_the_memory(messages, calibrated):
    robot = started(messages) if calibrated else RosRobot(RosRobotOptions(settle_s=1e9))
    flood(robot, messages, range(3000))
    before = reachable(robot)
    flood(robot, messages, range(3000, 4000))
    after = reachable(robot)
    assert not {path: (before[path], size) for path, size in after.items() if size > before[path]}
    if not calibrated:
        assert "transforms to more than" in robot.fault or "topics" in robot.fault
        assert robot.rejected.total() > 1000


def test_odometry_of_another_robot_with_the_same_frames_is_refused(messages):
    if not any(topic == "/tf" for topic, _, _ in messages):
        pytest.skip("its odometry is not from /tf")
    robot = started(messages)
    assert robot.selected_topics["/tf"] == "odometry"
    for topic, type_name, data in messages:
        if topic == "/tf":
            assert robot.convert("/other/tf", type_name, data, START_NS, 1.0) == []
    assert "/other/tf" not in robot.selected_topics
    assert robot.rejected["/other/tf"] > 0


@pytest.mark.parametrize("seed", range(3))
def test_altered_messages_are_refused_and_counted(messages, seed):
    """NaN, infinity, impossible stamps and sizes: what still decodes is converted or refused."""
    rng = np.random.default_rng(seed)
    robot, fresh = started(messages), RosRobot(RosRobotOptions(settle_s=0.0))
    words = [np.array([v], "<f8").tobytes() for v in (np.nan, np.inf, -1e300, 1e-300)] + [b"\xff" * 8]
    for _ in range(400):
        topic, type_name, data = messages[rng.integers(len(messages))]
        altered = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            at = 4 + 4 * int(rng.integers(0, (min(len(data), 800) - 12) // 4))
            altered[at : at + 8] = words[rng.integers(len(words))]
        robot.convert(topic, type_name, bytes(altered), START_NS, 1.0)
        try:
            fresh.convert(topic, type_name, bytes(altered), START_NS, 1.0)
        except UserError:  # the calibration contradicts itself: one sentence, and a later start may be better
            fresh = RosRobot(RosRobotOptions(settle_s=0.0))
    assert robot.rejected.total() > 20


def test_tokens_of_others_end_no_node_and_are_bounded(free_endpoint):
    def entity(number, topic, node="driver", type_name="sensor_msgs/msg/Image"):
        return RmwEntity(3, "ab12", 0, number, "MP", node, topic=topic, type_name=type_name,
                         type_hash="RIHS01_0", qos=RmwQos(depth=7)).token()  # fmt: skip

    wrong = [entity(1, topic) for topic in ("/", "/a//b", "//", "/ ")]
    wrong += [entity(2, "/a").replace("/0/2/MP", "/\u00b2/2/MP"), entity(2, "/a").replace(",7:", ",\u00b2:"),
              entity(2, "/a").replace("@ros2_lv/3", f"@ros2_lv/3/{'9' * 5000}")]  # fmt: skip
    many = [entity(n, f"/camera{n}") for n in range(200)]
    many += [entity(n, "/tf", "beamsplat", "tf2_msgs/msg/TFMessage") for n in range(500, 700)]
    node = Ros2Node(Ros2Config(domain=3, router=free_endpoint))
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as other:
        declared = [other.liveliness().declare_token(token) for token in wrong + many]
        node.configure()
        try:
            source = node.source()
            while node._samples.qsize() or not node.rejections.report():
                next(source)
            assert len(node._type_by_key) < 40
            assert len(node._own_tf_gids) <= 64
            assert any("topics of raw images" in entry.reason for entry in node.rejections.report())
        finally:
            node.close()
            del declared


def test_publishers_are_told_of_our_subscriptions_with_their_own_type_hash(free_endpoint):
    """Cameras that work only for subscribers, and those of Lyrical, publish nothing otherwise."""

    def announced():
        tokens = [RmwEntity.parse(str(r.ok.key_expr)) for r in other.liveliness().get("@ros2_lv/3/**/MS/**")]
        return {(t.topic, t.type_name.rpartition("/")[2], t.type_hash) for t in tokens}

    scan, image, laser = "/scan", "/camera/image_raw/compressed", "sensor_msgs/msg/LaserScan"
    robot = [
        RmwEntity(3, "ab12", 0, 1, "MP", "driver", topic=scan, type_name=laser, type_hash="TypeHashNotSupported"),
        RmwEntity(3, "ab12", 0, 2, "MP", "driver", topic=image, type_name="sensor_msgs/msg/CompressedImage",
                  type_hash="RIHS01_" + "7" * 64, extension="/cpu:"),
        RmwEntity(3, "ab12", 0, 3, "MP", "driver", topic="/chatter", type_name="std_msgs/msg/String",
                  type_hash="RIHS01_" + "8" * 64),
        RmwEntity(3, "ab12", 0, 4, "MP", "driver", topic="/odom", type_name="nav_msgs/msg/Odometry", type_hash="RIHS01_9"),
    ]  # fmt: skip
    node = Ros2Node(Ros2Config(domain=3, router=free_endpoint, without=("odometry",)))
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as other:
        declared = [other.liveliness().declare_token(entity.token()) for entity in robot]
        node.configure()
        try:
            source = node.source()
            while len(announced()) < 2:
                next(source)
            for _ in range(3):
                next(source)
            expected = {
                (scan, "LaserScan", robot[0].type_hash),
                (image, "CompressedImage", robot[1].type_hash),
            }
            assert announced() == expected
            node.robot._kind_by_topic = {scan: "scan"}  # topics are selected: the camera may stop
            node._unsubscribe_unused()
            assert announced() == {(scan, "LaserScan", robot[0].type_hash)}
        finally:
            node.close()
            del declared
