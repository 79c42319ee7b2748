"""Keys, attachments and tokens byte for byte as rmw_zenoh's documents and Zenoh's serializer have them."""

import numpy as np
import pytest
import xxhash
import zenoh.ext as ze
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from beamsplat.common import messages as m
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.recording import ros_types as ros
from beamsplat.common.recording.sensors import SENSORS, build_message, ros_fields
from beamsplat.common.recording.to_ros import records_of
from beamsplat.common.zenoh.rmw import NO_TYPE_HASH, RmwAttachment, RmwEntity, RmwKey, RmwQos, data_key
from beamsplat.services.ros2_out.conversions import TfTree, occupancy_grid, point_cloud

# ros2/rmw_zenoh, docs/design.md, "Graph Cache": the tokens of a listener and of a talker on /chatter.
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
NODE = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
SUBSCRIPTION = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
    + HASH + "/::,10:,:,:,,"
)  # fmt: skip
PUBLISHER = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    + HASH + "/::,7:,:,:,,"
)  # fmt: skip


@pytest.mark.parametrize("token", [NODE, SUBSCRIPTION, PUBLISHER])
def test_tokens_of_the_design_document(token):
    entity = RmwEntity.parse(token)
    assert entity.domain == 2
    assert entity.token() == token
    assert entity.gid() == xxhash.xxh3_128(token.encode()).intdigest().to_bytes(16, "little")


def test_parts_of_a_publishers_token():
    talker = RmwEntity.parse(PUBLISHER)
    assert (talker.kind, talker.node_name, talker.topic, talker.type_name) == (
        "MP", "talker", "/chatter", "std_msgs/msg/String",
    )  # fmt: skip
    assert talker.qos == RmwQos(depth=7)
    assert ros.typestore().hash_rihs01("std_msgs/msg/String") == talker.type_hash == HASH
    assert (
        data_key(2, "/chatter", "std_msgs/msg/String", HASH)
        == f"2/chatter/std_msgs::msg::dds_::String_/{HASH}"
    )


# Published by other projects: rosbag2's metadata.yaml, `ros2 topic info -v` of RViz and nav2, generated headers.
KNOWN_HASHES = {
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/PoseWithCovarianceStamped":
        "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "map_msgs/msg/OccupancyGridUpdate": "c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8",
    "nav_msgs/msg/OccupancyGrid": "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    "sensor_msgs/msg/CameraInfo": "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}  # fmt: skip


@pytest.mark.parametrize(("type_name", "digits"), KNOWN_HASHES.items())
def test_type_hashes_of_what_is_published_are_those_of_ros(type_name, digits):
    assert ros.typestore().hash_rihs01(type_name) == f"RIHS01_{digits}"
    for distribution in (Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL):
        store = get_typestore(distribution)
        if type_name in store.types:  # map_msgs is not
            assert store.hash_rihs01(type_name) == f"RIHS01_{digits}"


def test_longer_tokens_and_tokens_without_hashes_are_parsed():
    humble = SUBSCRIPTION.replace(HASH, NO_TYPE_HASH)
    longer = SUBSCRIPTION + "/cpu:,cuda:8"  # Lyrical lists buffer backends
    for token, type_hash in ((humble, NO_TYPE_HASH), (longer, HASH)):
        entity = RmwEntity.parse(token)
        assert (entity.topic, entity.type_hash, entity.qos.depth) == ("/chatter", type_hash, 10)
        assert entity.token() == token
        assert entity.gid() == xxhash.xxh3_128(token.encode()).intdigest().to_bytes(16, "little")
    assert RmwEntity.parse(PUBLISHER.replace(HASH, "RIHS01_*")) is None  # cannot be a part of a key
    assert RmwEntity.parse(PUBLISHER + "/a" * 9) is None


def test_unsupported_tokens_are_ignored():
    service = "@ros2_lv/2/f9/0/10/SS/%/%/add_server/%add/example_interfaces::srv::dds_::AddTwoInts_/RIHS01_e1/::,10:,:,:,,"
    for text in (service, "@ros2_lv/2/x", "chatter", NODE + "/more", PUBLISHER.replace("::,7", "7")):
        assert RmwEntity.parse(text) is None


@given(st.text(max_size=200))
def test_any_text_is_parsed_without_an_error(text):
    RmwEntity.parse(text)
    RmwKey.parse(text)
    RmwQos.parse(text)


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_attachments_match_zenohs_serializer(sequence, source_ns, gid):
    ours = RmwAttachment(sequence, source_ns, gid)
    theirs = ze.z_serialize((ze.Int64(sequence), ze.Int64(source_ns), gid)).to_bytes()
    assert ours.pack() == theirs
    assert RmwAttachment.unpack(theirs) == ours
    named = ze.z_serialize(
        ("sequence_number", ze.Int64(sequence), "source_timestamp", ze.Int64(source_ns), "source_gid", gid)
    )  # late 2024
    assert RmwAttachment.unpack(named.to_bytes()) == ours


@given(st.binary(max_size=90))
def test_other_attachments_are_ignored(data):
    found = RmwAttachment.unpack(data)
    assert found is None or len(data) in (33, 77)


def test_addresses():
    key = f"7/robot1/front/scan/sensor_msgs::msg::dds_::LaserScan_/{HASH}"
    assert RmwKey.parse(key) == ("7", "/robot1/front/scan", "sensor_msgs/msg/LaserScan", HASH)
    assert RmwKey.parse("beamsplat/robot1/lidar/scan") is None


def _independent(message):
    """Bytes and back by a type store that our code has not touched."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    data = ros.serialize(message)
    again = store.deserialize_cdr(data, message.__msgtype__)
    assert bytes(store.serialize_cdr(again, message.__msgtype__)) == data
    return again


@pytest.mark.parametrize("word", SENSORS)
def test_sensor_messages_are_converted_without_loss(word):
    """ROS bytes -> our message -> ROS bytes: the same, but for what our frames are called."""
    sensor = SENSORS[word]
    rng = np.random.default_rng(0)
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 0.0
    made = {
        "image": m.Image(stamp_ns=5, width_px=4, height_px=2, encoding="rgb8", step_bytes=12,
                         data=rng.integers(0, 255, 24).astype(np.uint8)),
        "scan": m.Scan(stamp_ns=1_700_000_000_123_456_789, angle_min_rad=-3.0, angle_increment_rad=0.25,
                       time_increment_s=0.5, scan_time_s=0.125, range_min_m=0.125, range_max_m=12.0,
                       ranges_m=rng.uniform(0, 12, 25).astype(np.float32),
                       intensities=rng.uniform(0, 99, 25).astype(np.float32)),
        "odometry": m.WheelOdometry(stamp_ns=9, T_odom_body=T, velocity_m_s=np.array([0.5, 0.0, 0.0]),
                                    angular_velocity_rad_s=np.array([0.0, 0.0, 0.25])),
        "pose": m.ExternalPose(stamp_ns=10**18, T_map_body=T),
    }[word]  # fmt: skip
    first = records_of(sensor.topic, made)[0].message
    data = ros.serialize(first)
    back = build_message(sensor.topic, ros_fields(sensor.topic, _independent(first)))
    assert ros.serialize(records_of(sensor.topic, back)[0].message) == data


def test_published_messages_are_valid_ros_messages():
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (7, 3)).astype(np.float32)
    colours = rng.integers(0, 255, (7, 3)).astype(np.uint8)
    T_map_odom = np.eye(4)
    T_map_odom[:3, 3] = 1.0, 2.0, 3.0
    cloud = _independent(point_cloud(3, "map", points, colours, T_map_odom))
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("rgb", 12, 7),
    ]
    words = np.asarray(cloud.data).view("<f4").reshape(7, 4)
    assert words[:, :3] == pytest.approx(points + np.array([1.0, 2.0, 3.0]), abs=1e-6)
    packed = np.ascontiguousarray(words[:, 3]).view("<u4")
    assert np.array_equal(np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1), colours)
    assert (cloud.width, cloud.height, cloud.row_step) == (7, 1, 112)
    cells = np.arange(6, dtype=np.int8).reshape(2, 3)
    grid = _independent(occupancy_grid(3, "map", 0.05, np.array([-1.0, 2.0]), cells))
    assert (grid.info.width, grid.info.height, np.asarray(grid.data).tolist()) == (3, 2, list(range(6)))
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-1.0, 2.0)


def test_the_robots_odometry_publishes_odom_to_body():
    from beamsplat.common.geometry.transforms import se2_to_se3

    tree = TfTree("map", "odom", "base_link")
    tree.T_map_odom = se2_to_se3(np.array([1.0, 0.0, 0.0]))
    ours = se2_to_se3(np.array([2.0, 1.0, 0.5]))
    both = tree.tf(10**9, ours).transforms
    assert [(t.header.frame_id, t.child_frame_id) for t in both] == [("map", "odom"), ("odom", "base_link")]
    wheels = se2_to_se3(np.array([5.0, 5.0, -0.5]))
    tree.add_wheel_odometry(10**9, wheels)
    (only,) = _independent(tree.tf(10**9 + 1000, ours)).transforms
    assert (only.header.frame_id, only.child_frame_id) == ("map", "odom")
    T_map_odom = ros.transform_of(only.transform.translation, only.transform.rotation)
    assert T_map_odom @ wheels == pytest.approx(tree.T_map_odom @ ours, abs=1e-12)
    assert tree.tf(2 * 10**9, ours) is None  # where the wheels were then is not known


def test_the_pose_with_covariance_has_the_axes_of_the_map():
    transforms = TfTree("map", "odom", "base_link")
    transforms.T_map_odom = se2_to_se3(np.array([1.0, 2.0, np.pi / 2]))
    covariance = np.array(
        [[4e-4, 1e-4, 2e-5], [1e-4, 1e-4, 0.0], [2e-5, 0.0, 1e-6]]
    )  # larger along x of odom
    message = transforms.pose_with_covariance(5, se2_to_se3(np.array([3.0, 0.0, 0.0])), covariance)
    assert ros.serialize(message)
    assert message.header.frame_id == "map"
    position = message.pose.pose.position
    assert (position.x, position.y) == pytest.approx((1.0, 5.0))
    full = message.pose.covariance.reshape(6, 6)
    assert full[1, 1] == pytest.approx(4e-4)  # x of odom is y of the map
    assert full[0, 0] == pytest.approx(1e-4)
    assert full[0, 1] == full[1, 0] == pytest.approx(-1e-4)
    assert full[1, 5] == pytest.approx(2e-5)
    assert full[5, 5] == pytest.approx(1e-6)
    assert not full[2:5].any()
