"""Real bags of all three kinds through the replay service."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.frames import R_body_camera_level, camera_mount
from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.recording.input_report import InputReport
from beamsplat.common.recording.sensors import SENSORS, build_message, ros_fields
from beamsplat.common.recording.transform_reading import TF_TYPES, TransformReading
from beamsplat.common.scans.laser import laser_of_ros
from beamsplat.common.scans.reader import ScanReader
from beamsplat.services.replay.bags import Bag
from beamsplat.services.replay.config import ReplayConfig
from beamsplat.services.replay.decode import deserialize, header_stamp_ns
from beamsplat.services.replay.node import ReplayNode
from tests.services.replay.make_bags import (
    KINDS,
    LAG_NS,
    START_NS,
    T_BASE_CAMERA,
    T_BASE_LIDAR,
    Drive,
    picture,
    write_bag,
)

RIG = """
[camera]
width_px = 64
height_px = 48
fx_px = 70.0
fy_px = 70.0
cx_px = 31.5
cy_px = 23.5
[camera.mount]
xyz_m = [0.0, 0.0, 1.0]
rpy_deg = [0.0, 0.0, 0.0]
[lidar.mount]
xyz_m = [0.0, 0.0, 0.5]
rpy_deg = [0.0, 0.0, 0.0]
"""


def play(path, **options):
    """All that a replay node says, and its problems."""
    node = ReplayNode(ReplayConfig(data=path, **options))
    try:
        sourced = list(node.source())
        for item in sourced:
            node.check_output(item.topic, item.message)
        return sourced, node._source.problems
    finally:
        node.close()


def refusal(path, **options):
    """The one sentence with which a bag is refused."""
    node = ReplayNode(ReplayConfig(data=path, **options))
    with pytest.raises(UserError) as caught:
        list(node.source())
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text or str(options.get("rig")) in text
    return text


def of(sourced, topic):
    return [item for item in sourced if item.topic == topic]


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_comes_back_as_it_was_recorded(tmp_path, kind):
    sourced, problems = play(write_bag(tmp_path, kind, Drive(pose=True)))
    assert problems == []
    arrivals = [item.at_ns for item in sourced]
    assert arrivals == sorted(arrivals)
    assert sourced[0].topic == "rig"
    images, scans, odometry = (of(sourced, t) for t in ("camera/image", "lidar/scan", "wheel/odometry"))
    assert len(images) == len(scans) == len(odometry) == len(of(sourced, "external/pose")) == 20
    # Arrival and measurement are two times.
    assert {item.at_ns - item.message.stamp_ns for item in scans} == {LAG_NS}
    assert [item.message.stamp_ns for item in scans] == [START_NS + i * 10**8 for i in range(20)]
    scan = scans[7].message
    assert scan.ranges_m[5] == np.float32(2.07)
    assert np.isposinf(scan.ranges_m[0])
    assert np.isnan(scan.ranges_m[1])
    assert scan.intensities[35] == 35.0
    assert scan.angle_increment_rad == pytest.approx(0.17)
    # The bytes of a picture are the camera's own.
    image = images[3].message
    assert (image.encoding, image.width_px, image.height_px) == ("jpeg", 64, 48)
    assert image.data.tobytes() == cv2.imencode(".jpg", picture(3))[1].tobytes()
    assert odometry[4].message.T_odom_body[0, 3] == pytest.approx(0.4)
    assert odometry[4].message.velocity_m_s.tolist() == [1.0, 0.0, 0.0]
    assert odometry[4].message.angular_velocity_rad_s.tolist() == [0.0, 0.0, 0.5]
    assert of(sourced, "external/pose")[9].message.T_map_body[:2, 3] == pytest.approx([0.9, 1.0])


@pytest.mark.parametrize("kind", KINDS)
def test_ticks_come_once_a_second_of_recorded_time(tmp_path, kind):
    sourced, _ = play(write_bag(tmp_path, kind, Drive(seconds=3.5)))
    ticks = of(sourced, "tick")
    assert [tick.at_ns - START_NS for tick in ticks] == [i * 10**9 for i in range(4)]
    assert [tick.message.count for tick in ticks] == list(range(4))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tf", ["static", "repeated"])
@pytest.mark.parametrize("chain", [False, True])
def test_calibration_from_fixed_transforms(tmp_path, kind, tf, chain):
    sourced, _ = play(write_bag(tmp_path, kind, Drive(tf=tf, chain=chain)))
    rig = sourced[0].message
    assert np.allclose(rig.camera.T_body_camera, T_BASE_CAMERA, atol=1e-9)
    assert np.allclose(rig.lidar.T_body_lidar, T_BASE_LIDAR, atol=1e-9)
    assert rig.camera.fx_px == 50.0
    assert (rig.camera.distortion_model, rig.camera.distortion) == ("plumb_bob", (0.1, 0.0, 0.0, 0.0, 0.0))
    assert rig.assumed == ()


def test_the_body_lies_on_the_floor_where_there_is_a_footprint(tmp_path):
    sourced, _ = play(write_bag(tmp_path, "mcap", Drive(footprint=True)))
    rig = sourced[0].message
    assert rig.lidar.T_body_lidar[2, 3] == pytest.approx(0.28)
    # Odometry of base_link, 0.1 m up, is moved to the body below it.
    odometry = of(sourced, "wheel/odometry")[4].message
    assert odometry.T_odom_body[:3, 3] == pytest.approx([0.4, 0.0, -0.1])
    assert odometry.velocity_m_s == pytest.approx([1.0, 0.0, 0.0])


def test_pictures_stamped_with_the_housing_get_optical_axes(tmp_path):
    housing = camera_mount(0.1, 0.02, 0.45) @ make_transform(R_body_camera_level.T, np.zeros(3))
    drive = Drive(camera_frame="camera_link", T_base_camera=housing)
    sourced, _ = play(write_bag(tmp_path, "mcap", drive))
    rig = sourced[0].message
    assert np.allclose(rig.camera.T_body_camera, camera_mount(0.1, 0.02, 0.45), atol=1e-9)
    assert "camera_link" in rig.assumed[0]


@pytest.mark.parametrize("kind", KINDS)
def test_raw_pictures(tmp_path, kind):
    sourced, _ = play(write_bag(tmp_path, kind, Drive(images="rgb8")))
    image = of(sourced, "camera/image")[2].message
    assert (image.encoding, image.step_bytes) == ("rgb8", 192)
    assert image.data.tobytes() == picture(2).tobytes()


def test_a_rig_file_wins(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    sourced, _ = play(write_bag(tmp_path, "mcap", Drive(info_px=None, tf="")), rig=rig)
    message = sourced[0].message
    assert message.camera.fx_px == 70.0
    assert message.lidar.T_body_lidar[2, 3] == 0.5
    assert message.source == str(rig)


def test_a_rig_file_of_another_size_or_without_a_sensor_is_refused(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive())
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.replace("64", "128").replace("31.5", "63.5"))
    assert "K is for 128x48 px but the images" in refusal(path, rig=rig)
    rig.write_text(RIG[RIG.index("[lidar") :])
    assert "has no [camera]" in refusal(path, rig=rig)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_missing_is_said_in_one_sentence(tmp_path, kind):
    for number, (drive, words) in enumerate(
        [
            (Drive(scan=False), ["has no scan", "LaserScan", "/odom"]),
            (Drive(info_px=None), ["calibration is missing", "CameraInfo", "beamsplat rig"]),
            (Drive(info_px=(32, 24)), ["K is for 32x24 px", "64x48 px"]),
            (Drive(fx_px=0.0), ["calibration is missing", "all zero"]),
            (Drive(tf=""), ["position of the camera", "position of the lidar"]),
            (Drive(distortion=("strange", [0.1])), ["distortion model 'strange'"]),
            (Drive(extra_scan="/rear/scan"), ["several topics for scan", "/rear/scan", "scan_topic"]),
        ]
    ):
        (tmp_path / str(number)).mkdir()
        text = refusal(write_bag(tmp_path / str(number), kind, drive))
        for word in words:
            assert word in text


def test_choices_by_option(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive(extra_scan="/rear/scan", pose=True))
    sourced, _ = play(path, scan_topic="/rear/scan", without=("odometry", "pose", "image"))
    assert {item.topic for item in sourced} == {"rig", "tick", "lidar/scan"}
    assert sourced[0].message.camera is None
    assert (
        "scan_topic = '/front' is not there or has no messages; possible topics: /rear/scan, /scan"
        in refusal(path, scan_topic="/front")
    )
    assert "is a nav_msgs/msg/Odometry" in refusal(path, scan_topic="/odom")


def test_mounts_may_be_assumed_and_a_lidar_alone_needs_none(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive(tf=""))
    sourced, _ = play(path, assume_mounts=True)
    assert len(sourced[0].message.assumed) == 2
    sourced, _ = play(path, without=("image",))
    assert np.array_equal(sourced[0].message.lidar.T_body_lidar, np.eye(4))
    assert "the lidar is at the body's origin" in sourced[0].message.assumed[0]


@pytest.mark.parametrize("kind", KINDS)
def test_broken_messages_are_counted_not_fatal(tmp_path, kind):
    sourced, problems = play(write_bag(tmp_path, kind, Drive(corrupt_scans=3)))
    assert len(of(sourced, "lidar/scan")) == 17
    assert len(problems) == 1
    assert "/scan: 3 messages refused: not a sensor_msgs/msg/LaserScan" in problems[0]


def test_without_stamps_the_receive_time_stands_in(tmp_path):
    sourced, problems = play(write_bag(tmp_path, "mcap", Drive(stamped=False)))
    # A scan is received after its last beam, 35 ms after the first.
    ages = [(item.at_ns - item.message.stamp_ns) / 1e9 for item in of(sourced, "lidar/scan")]
    assert ages == pytest.approx([0.035] * 20)
    assert any("no stamp" in problem for problem in problems)


@pytest.mark.parametrize("kind", KINDS)
def test_seek_and_duration(tmp_path, kind):
    path = write_bag(tmp_path, kind, Drive(seconds=3.0))
    sourced, _ = play(path, start_s=1.0, duration_s=0.5)
    odometry = of(sourced, "wheel/odometry")
    assert [(item.at_ns - START_NS) // 10**8 for item in odometry] == [10, 11, 12, 13, 14]
    assert sourced[0].topic == "rig"
    assert sourced[0].at_ns == START_NS + 10**9
    node = ReplayNode(ReplayConfig(data=path, start_s=100.0))
    with pytest.raises(UserError, match="beyond the end"):
        list(node.source())


def test_a_loop_never_runs_backwards(tmp_path):
    node = ReplayNode(ReplayConfig(data=write_bag(tmp_path, "mcap", Drive(seconds=1.0)), loop=True))
    assert node.expected_messages() is None
    source = node.source()
    sourced = [next(source) for _ in range(150)]
    node.close()
    arrivals = [item.at_ns for item in sourced]
    assert arrivals == sorted(arrivals)
    for topic in ("lidar/scan", "camera/image", "wheel/odometry", "tick"):
        stamps = [item.message.stamp_ns for item in of(sourced, topic)]
        assert len(stamps) > (2 if topic == "tick" else 20)
        assert stamps == sorted(set(stamps))
    assert len(of(sourced, "rig")) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.999])
def test_a_truncated_bag_is_refused_in_one_sentence(tmp_path, kind, share):
    path = write_bag(tmp_path, kind, Drive(seconds=5.0, images="rgb8"))
    file = path if kind == "ros1" else next(f for f in path.iterdir() if f.suffix != ".yaml")
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    node = ReplayNode(ReplayConfig(data=path))
    with pytest.raises(UserError) as caught:
        list(node.source())
    text = str(caught.value)
    assert "\n" not in text
    assert file.name in text or path.name in text
    assert "copy it again" in text or "not a" in text


def test_what_is_there_of_a_truncated_bag_can_be_used(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive(seconds=20.0, images="rgb8"))
    file = next(path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.8)])
    sourced, problems = play(path, allow_truncated=True)
    assert 20 < len(of(sourced, "lidar/scan")) < 200
    assert "truncated" in problems[0]


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
def test_ros2_files_open_without_their_metadata(tmp_path, kind):
    path = write_bag(tmp_path, kind, Drive())
    (path / "metadata.yaml").unlink()
    assert len(play(path)[0]) > 60
    file = next(path.iterdir())
    assert len(play(file)[0]) > 60


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_bags(tmp_path, kind, mode):
    sourced, problems = play(write_bag(tmp_path, kind, Drive(compression=mode)))
    assert problems == []
    assert len(of(sourced, "lidar/scan")) == 20
    assert sourced[0].message.camera.fx_px == 50.0


@pytest.mark.parametrize("kind", ["sqlite", "mcap"])
def test_the_size_of_the_metadata_is_limited(tmp_path, kind):
    path = write_bag(tmp_path, kind, Drive(seconds=0.2))
    with (path / "metadata.yaml").open("a") as file:
        file.write("# recorded in the yard\n" * 200_000)
    with pytest.raises(UserError, match=r"metadata.yaml: .*longer than 4000000 bytes"):
        Bag(path)


def test_what_is_no_bag_is_refused(tmp_path):
    for name, content, words in [
        ("a.bag", b"hello", "not a bag"),
        ("b.mcap", b"hello hello hello", "not an MCAP"),
        ("c.db3", b"hello" * 100, "not a bag"),
        ("d.txt", b"hello", "not a bag"),
        ("e.bag", b"", "empty"),
    ]:
        (tmp_path / name).write_bytes(content)
        assert words in refusal(tmp_path / name)
    (tmp_path / "folder").mkdir()
    assert "no data found" in refusal(tmp_path / "folder")
    assert "no such file" in refusal(tmp_path / "nowhere")


@pytest.mark.parametrize("kind", KINDS)
def test_zero_messages(tmp_path, kind):
    drive = Drive(seconds=0.0, tf="")
    assert "has no messages" in refusal(write_bag(tmp_path, kind, drive))


def test_a_folder_with_truth_beside_its_bag_is_its_bag(tmp_path):
    path = write_bag(tmp_path, "mcap", Drive())
    (tmp_path / "house").mkdir()
    shutil.move(path, tmp_path / "house" / "bag")
    (tmp_path / "house" / "groundtruth.txt").write_text("")
    assert len(play(tmp_path / "house")[0]) > 60


TYPES = {
    "camera/image": "sensor_msgs/msg/CompressedImage",
    "lidar/scan": "sensor_msgs/msg/LaserScan",
    "wheel/odometry": "nav_msgs/msg/Odometry",
    "external/pose": "geometry_msgs/msg/PoseStamped",
}


@pytest.mark.parametrize(
    "name", ["house_a", "redkitchen/bag", "freiburg/aces.bag", "freiburg/fr079.bag", "freiburg/intel.bag"]
)
def test_the_shared_recordings_play(shared_dir, name):
    path = shared_dir / "data" / name
    sourced, problems = play(path, duration_s=20.0)
    assert problems == []
    with AnyReader([path / "bag" if name == "house_a" else path]) as bag:
        stop_ns = bag.start_time + 20 * 10**9
        types = [connection.msgtype for connection, _, _ in bag.messages(stop=stop_ns)]
    for topic, type_name in TYPES.items():
        assert len(of(sourced, topic)) == types.count(type_name)
    rig = sourced[0].message
    assert rig.assumed == ()
    if name == "house_a":
        expected = camera_mount(0.10, 0.0, 0.45, pitch_down_rad=np.radians(2.0))
        assert np.allclose(rig.camera.T_body_camera, expected, atol=1e-9)
        assert rig.camera.fx_px == 530.0
    if name == "freiburg/fr079.bag":
        assert rig.lidar.T_body_lidar[0, 3] == pytest.approx(0.04)


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_mutated_messages_raise_value_errors_only(tmp_path, kind):
    """Every sensor and transform message, 400 times with wrong bytes or cut short."""
    rng = np.random.default_rng(11)
    path = write_bag(tmp_path, kind, Drive(seconds=0.1, pose=True))
    topics = {ros_type: sensor.topic for sensor in SENSORS.values() for ros_type in sensor.ros_types}
    with Bag(path) as bag:
        originals = list(bag.messages())
    assert len(originals) == 6
    for raw in originals:
        for _ in range(400):
            data = bytearray(raw.data)
            for position in rng.integers(0, len(data), rng.integers(1, 6)):
                data[position] = rng.integers(0, 256)
            data = bytes(data[: rng.integers(0, len(data) + 1)] if rng.random() < 0.3 else data)
            try:
                message = deserialize(raw._replace(data=data))
                if raw.type_name in topics:
                    build_message(topics[raw.type_name], ros_fields(topics[raw.type_name], message))
                if raw.type_name in TF_TYPES:
                    TransformReading(InputReport()).add(raw.topic, message)
                if raw.type_name == "sensor_msgs/msg/LaserScan":
                    ScanReader("/scan", InputReport()).read(laser_of_ros(message, raw.at_ns))
            except ValueError:
                pass
            header_stamp_ns(raw._replace(data=data))
