"""Depth of a spinning robot is that of an ideal lidar driver, whatever the driver publishes."""

import cv2
import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.geometry.transforms import quat_xyzw_from_matrix, se2_to_se3
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.tools.system.assembly import build_node
from tests.common.scans.robots import DRIVERS, START_NS, Drive, odometry, oradar_ms200, sweeps
from tests.services.fusion.room import CAMERA, CLOSED, CLOSED_WALLS, LIDAR_Z, T_BODY_CAMERA, render
from tests.services.replay.make_bags import camera_info
from tests.services.replay.test_scan_cases import Bench

OF_ROBOTS = (
    "sllidar_ros2", "rplidar_mirrored", "ldlidar_stl_ros2", "ld08_driver", "coin_d4_driver", "ydlidar_ros2_driver",
)  # fmt: skip
IMAGES_HZ = 4.0
_START_XY_M = (-1.1, -2.1)  # from the flat of `Drive` to the room


class RoomDrive(Drive):
    """The drive with two spins of 5 s at 1 rad/s, in the closed room."""

    def __call__(self, t):
        return super().__call__(t) + np.array([*_START_XY_M, 0.0])


@pytest.fixture(scope="module")
def drive():
    return RoomDrive()


@pytest.fixture(scope="module")
def images(drive):
    """Stamp (ns), JPEG and true depth of the images."""
    found = []
    for t in np.arange(0.3, drive.seconds - 0.5, 1.0 / IMAGES_HZ):
        rgb, depth = render(se2_to_se3(drive(np.array([t]))[0]), surfaces=CLOSED)
        jpeg = cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].ravel()
        found.append((START_NS + round(t * 1e9), jpeg, depth))
    return found


def record(path, lasers, wheels, images):
    """Write the bag of a robot with camera, lidar and wheel odometry."""
    bench = Bench(path)
    bag, rows = bench.bag, []
    size_px = (CAMERA.width_px, CAMERA.height_px)
    for stamp_ns, jpeg, _ in images:
        header = bag.header(stamp_ns, "camera_optical_frame")
        image = bag.new("sensor_msgs/msg/CompressedImage", header=header, format="jpeg", data=jpeg)
        rows.append(("/camera/image_raw/compressed", image, stamp_ns + 20_000_000))
        info = camera_info(bag, stamp_ns, CAMERA.fx_px, size_px)
        rows.append(("/camera/camera_info", info, stamp_ns + 20_000_000))
    quat = quat_xyzw_from_matrix(T_BODY_CAMERA[:3, :3])
    edges = [
        ("base_link", "laser", (0.0, 0.0, LIDAR_Z), (0.0, 0.0, 0.0, 1.0)),
        ("base_link", "camera_optical_frame", T_BODY_CAMERA[:3, 3], quat),
    ]
    return bench.write(lasers, wheels, edges=edges, others=rows)


def depth_absrel(path, images):
    """Return the mean AbsRel of the fused depth of all images, and the ratio of pixels with an answer."""
    nodes = {
        "replay": {"data": str(path)}, "localization": {"kind": "lidar"}, "depth": {"source": "stixel"}, "fusion": {},
    }  # fmt: skip
    deployment, fused = Deployment(nodes=nodes), {}

    def on_message(envelope):
        if envelope.topic == "fusion/depth" and envelope.message.status == "ok":
            fused[envelope.message.stamp_ns] = envelope.message.depth_m

    Lockstep([build_node(deployment, name) for name in nodes], on_message).run()
    assert len(fused) > 0.9 * len(images)
    errors, answered = [], []
    for stamp_ns, _, truth in images:
        if stamp_ns in fused:
            known = np.isfinite(fused[stamp_ns])
            errors.append(np.mean(np.abs(fused[stamp_ns] - truth)[known] / truth[known]))
            answered.append(known.mean())
    return float(np.mean(errors)), float(np.mean(answered))


@pytest.mark.slow
def test_depth_on_a_spinning_robot_is_that_of_the_ideal_driver(tmp_path, drive, images):
    wheels = odometry(drive)
    ideal = sweeps(drive, beams=160, clockwise=True, walls=CLOSED_WALLS)
    published = {name: [DRIVERS[name](m, k) for k, m in enumerate(ideal)] for name in OF_ROBOTS}
    published["oradar_ms200"] = oradar_ms200(ideal)
    clean, answered = depth_absrel(record(tmp_path / "clean", ideal, wheels, images), images)
    assert answered > 0.6
    for name, lasers in published.items():
        absrel, share = depth_absrel(record(tmp_path / name, lasers, wheels, images), images)
        print(
            f"{name}: AbsRel {absrel:.4f} of {share:.2f} of the pixels; ideal {clean:.4f} of {answered:.2f}"
        )
        assert absrel <= 1.1 * clean, name
        assert share > 0.95 * answered, name
