"""Camera localization node: published poses and the reported scale."""

import cv2
import numpy as np
import pytest

from beamsplat.common.messages import CameraModel, DepthEstimate, Image, Rig
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.services.localization.camera.node import CameraLocalization, CameraLocalizationConfig
from tests.services.localization.camera.box import T_BODY_CAMERA, drive, pose_error, render_view

PATH = drive(8)


class ImageSource(Node):
    """Publishes the calibration and images at 10 Hz."""

    name = "replay"
    outputs = ("rig", "camera/image")

    def source(self):
        model = CameraModel(
            width_px=160, height_px=120, fx_px=140.0, fy_px=140.0, cx_px=79.5, cy_px=59.5,
            T_body_camera=T_BODY_CAMERA,
        )  # fmt: skip
        yield SourceItem(0, "rig", Rig(stamp_ns=0, camera=model))
        for i, T in enumerate(PATH):
            data = cv2.imencode(".png", cv2.cvtColor(render_view(T)[0], cv2.COLOR_RGB2BGR))[1].ravel()
            data = data[:50] if i == 5 else data  # a truncated image
            stamp_ns = (i + 1) * 100_000_000
            yield SourceItem(
                stamp_ns, "camera/image",
                Image(stamp_ns=stamp_ns, width_px=160, height_px=120, encoding="png", data=data),
            )  # fmt: skip


class TrueDepthSource(Node):
    """Publishes the true depth of every image as the kind that the test sets; subscribes to poses as the real
    depth node does."""

    name = "depth"
    inputs = ("camera/image", "localization/odometry")
    outputs = ("depth/estimate",)
    kind = "metric"

    def on_localization_odometry(self, message):
        return iter(())

    def on_camera_image(self, image):
        z = render_view(PATH[image.stamp_ns // 100_000_000 - 1])[1]
        values = {"metric": z, "disparity": 1.0 / z, "none": np.zeros((0, 0), np.float32)}[self.kind]
        yield (
            "depth/estimate",
            DepthEstimate(stamp_ns=image.stamp_ns, source="truth", kind=self.kind, values=values),
        )


def run(kind, **options):
    depth = TrueDepthSource(TrueDepthSource.Config())
    depth.kind = kind
    config = CameraLocalizationConfig(width_px=160, scale_sigma=0.01, **options)
    envelopes = []
    Lockstep([ImageSource(ImageSource.Config()), depth, CameraLocalization(config)], envelopes.append).run()
    poses = [x.message for x in envelopes if x.topic == "localization/odometry"]
    corrections = [x.message for x in envelopes if x.topic == "localization/correction"]
    return poses, corrections


def test_metric_depth_yields_metric_poses_and_bad_images_are_rejected():
    poses, corrections = run("metric")
    assert len(poses) == len(PATH)
    assert len(corrections) == 1
    assert np.array_equal(corrections[0].T_map_odom, np.eye(4))
    assert poses[0].status == "relocalizing"
    assert poses[5].status == "rejected"
    assert "decode" in poses[5].detail
    for i in (1, 2, 3, 4, 6, 7):
        assert poses[i].status == "ok"
        assert poses[i].metric
        assert pose_error(PATH[i], poses[i].T_odom_body)[0] < 0.03
        assert np.all(np.isfinite(poses[i].covariance))


@pytest.mark.parametrize(("kind", "options"), [("disparity", {}), ("none", {}), ("none", {"depth": "none"})])
def test_depth_without_a_unit_is_reported_as_arbitrary_scale(kind, options):
    poses, _ = run(kind, **options)
    good = [p for p in poses if p.status == "ok"]
    assert len(good) >= 5
    assert not any(p.metric for p in good)
    assert all("scale is arbitrary" in p.detail for p in good)


def test_the_kind_is_in_the_registry():
    from beamsplat.services.nodes import NODES

    assert NODES["localization"].load("camera") is CameraLocalization
