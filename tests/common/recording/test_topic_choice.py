"""Topics are chosen as an expert would, with the reason; where the names do not tell, the option is named."""

import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.recording.topic_choice import (
    Candidate,
    choose_camera_info,
    choose_topic,
    left_out_by_name,
)

TYPES = {
    "scan": "sensor_msgs/msg/LaserScan", "odometry": "nav_msgs/msg/Odometry", "raw": "sensor_msgs/msg/Image",
    "jpeg": "sensor_msgs/msg/CompressedImage", "info": "sensor_msgs/msg/CameraInfo",
}  # fmt: skip


def topics(kind, *names, count=100):
    return [Candidate(name, TYPES[kind], count) for name in names]


def chosen(sensor, found, **options):
    choice = choose_topic(sensor, found, "drive", **options)
    return None if choice is None else (choice.topic.name, choice.reason)


@pytest.mark.parametrize(
    ("names", "best"),
    [
        (("/scan", "/scan_filtered"), "/scan_filtered"),  # ROSbot
        (("/scan", "/scan_raw"), "/scan"),  # Hiwonder
        (("/scan_raw", "/scan", "/scan_filtered"), "/scan_filtered"),
        (("/robot/scan", "/robot/scan/filtered"), "/robot/scan/filtered"),
        (("/scan", "/depth_scan"), "/scan"),
        (("/scan", "/camera/scan"), "/scan"),
        (("/depth_scan",), "/depth_scan"),
    ],
)
def test_scans(names, best):
    name, reason = chosen("scan", topics("scan", *names))
    assert name == best
    assert ("scan_topic sets another" in reason) == (len(names) > 1)


@pytest.mark.parametrize(
    "names", [("/front/scan", "/rear/scan"), ("/scan", "/scan_back"), ("/r1/scan", "/r2/scan")]
)
def test_two_lidars_need_an_option(names):
    with pytest.raises(UserError, match=r"scan_topic = .* \(--scan-topic\)"):
        chosen("scan", topics("scan", *names))
    assert chosen("scan", topics("scan", *names), named=names[1])[0] == names[1]


def test_a_filtered_topic_with_few_messages_is_not_used():
    found = [*topics("scan", "/scan"), *topics("scan", "/scan_filtered", count=20)]
    assert chosen("scan", found)[0] == "/scan"


@pytest.mark.parametrize(
    ("found", "best"),
    [
        (topics("raw", "/cam/image_raw", "/cam/image_rect", "/cam/image_rect_color")
         + topics("info", "/cam/camera_info"), "/cam/image_raw"),
        (topics("raw", "/cam/image_raw") + topics("jpeg", "/cam/image_raw/compressed"), "/cam/image_raw/compressed"),
        (topics("raw", "/c/color/image_raw", "/c/infra1/image_rect_raw", "/c/depth/image_rect_raw"), "/c/color/image_raw"),
        (topics("raw", "/oakd/rgb/preview/image_raw", "/oakd/rgb/image_raw"), "/oakd/rgb/image_raw"),
        (topics("raw", "/oakd/rgb/preview/image_raw"), "/oakd/rgb/preview/image_raw"),
        (topics("raw", "/cam/image_raw", "/cam/debug/image_raw"), "/cam/image_raw"),
        (topics("raw", "/depth_cam/depth/image_raw", "/depth_cam/rgb/image_raw"), "/depth_cam/rgb/image_raw"),
        (topics("raw", "/depth_camera/image_raw", "/depth_camera/depth/image_raw"), "/depth_camera/image_raw"),
        (topics("raw", "/c/aligned_depth_to_color/image_raw", "/c/color/image_raw"), "/c/color/image_raw"),
    ],
)  # fmt: skip
def test_images(found, best):
    assert chosen("image", found)[0] == best


def test_two_cameras_need_an_option():
    with pytest.raises(UserError, match="--image-topic"):
        chosen("image", topics("raw", "/left/image_raw", "/right/image_raw"))


@pytest.mark.parametrize(
    ("names", "near", "best"),
    [
        (("/odom", "/odometry/filtered"), "", "/odometry/filtered"),
        (("/odom", "/odom_raw"), "", "/odom"),
        (("/odom", "/visual_odom"), "", "/odom"),
        (("/odom", "/ground_truth/odom"), "", "/odom"),
        (("/robot1/odom", "/robot2/odom"), "/robot2/scan", "/robot2/odom"),
    ],
)
def test_odometry(names, near, best):
    assert chosen("odometry", topics("odometry", *names), near=near)[0] == best


def test_the_camera_info_of_an_image_is_the_one_beside_it():
    infos = topics("info", "/camera_info", "/front/camera_info", "/front/depth/camera_info")
    assert choose_camera_info(infos, "/front/image_raw/compressed", "drive") == "/front/camera_info"
    assert choose_camera_info(infos, "/image_raw", "drive") == "/camera_info"
    with pytest.raises(UserError, match="--camera-info-topic"):
        choose_camera_info(topics("info", "/a/camera_info", "/b/camera_info"), "/c/image", "drive")


def test_images_that_are_left_out_by_their_names_are_listed_with_the_word():
    found = topics("raw", "/depth_cam/depth/image_raw", "/depth_cam/rgb/image_raw", "/seg/semantic_mask")
    left_out = left_out_by_name(found, "image")
    assert set(left_out) == {"/depth_cam/depth/image_raw", "/seg/semantic_mask"}
    assert "'depth'" in left_out["/depth_cam/depth/image_raw"]
    assert "'mask', 'semantic'" in left_out["/seg/semantic_mask"]
    assert chosen("image", found)[0] == "/depth_cam/rgb/image_raw"
    named = chosen("image", found, named="/seg/semantic_mask")
    assert named[0] == "/seg/semantic_mask"
