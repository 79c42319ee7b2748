"""Depth and fusion as nodes behind the lidar localization: metric depth, or a reason why not."""

import cv2
import numpy as np
import pytest

from common.config import Deployment
from common.lockstep import Lockstep
from common.messages import DepthEstimate, Image, Odometry, Rig, Scan
from services.deployment import build_node
from services.depth.node import DepthNode
from services.fusion.node import FusionNode
from tests.common.samples import sample_messages

RIG = next(m for m in sample_messages() if type(m) is Rig)


@pytest.mark.slow
def test_the_house_comes_out_metric(shared_dir):
    """Six seconds through localization, depth and fusion: every frame answered, close to dense truth."""
    nodes = {
        "replay": {"data": str(shared_dir / "data/house_a/bag"), "duration_s": 7.0},
        "localization": {"kind": "lidar"},
        "depth": {"source": "stixel"},
        "fusion": {},
    }
    deployment, fused, clouds = Deployment(nodes=nodes), {}, []

    def on_message(letter):
        if letter.topic == "fusion/depth":
            fused[letter.message.stamp_ns] = letter.message
        elif letter.topic == "fusion/cloud":
            clouds.append(letter.message)

    Lockstep([build_node(deployment, name) for name in nodes], on_message).run()
    assert len(fused) > 50
    assert all(m.status == "ok" for m in fused.values())
    assert 3 <= sum(m.keyframe for m in fused.values()) == len(clouds)
    absrel, inside = [], []
    for stamp_ns, message in fused.items():
        file = shared_dir / f"data/house_a/depth_gt/{stamp_ns}.png"
        if file.exists():
            truth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / 1000.0
            known = (truth > 0) & np.isfinite(message.depth_m)
            assert known.sum() > 0.85 * (truth > 0).sum()  # what is doubtful gets no answer
            error = np.abs(message.depth_m - truth)[known]
            absrel.append(np.mean(error / truth[known]))
            inside.append(np.mean(error < 3.0 * message.sigma_m[known]))
    assert len(absrel) >= 6
    assert np.mean(absrel) < 0.10
    assert np.mean(inside) > 0.85
    for message in fused.values():
        assert message.inlier_share > 0.8
        assert message.residual_m < 0.03


def _scan(stamp_ns):
    return Scan(
        stamp_ns=stamp_ns, angle_min_rad=-1.5, angle_increment_rad=0.01, time_increment_s=1e-4, scan_time_s=0.1,
        range_min_m=0.1, range_max_m=12.0, ranges_m=np.full(300, 2.0, np.float32),
    )  # fmt: skip


def _odometry(stamp_ns):
    return Odometry(stamp_ns=stamp_ns, T_odom_body=np.eye(4), covariance=np.eye(3))


def _image(stamp_ns, value=None, size=(640, 480)):
    rgb = np.random.default_rng(1).integers(0, 255, (size[1], size[0], 3)).astype(np.uint8)
    data = rgb if value is None else np.full_like(rgb, value)
    return Image(
        stamp_ns=stamp_ns, width_px=size[0], height_px=size[1], encoding="rgb8", data=data.reshape(-1)
    )


def _feed(node, *messages):
    out = []
    topics = {Rig: "rig", Scan: "lidar/scan", Odometry: "localization/odometry", Image: "camera/image",
              DepthEstimate: "depth/estimate"}  # fmt: skip
    for message in messages:
        out += list(node.handle(topics[type(message)], message))
    return out


S = 100_000_000


def test_an_estimate_waits_for_the_pose_of_its_picture():
    node = DepthNode(DepthNode.Config(source="stixel"))
    node.configure()
    assert _feed(node, RIG, _odometry(0), _scan(0), _image(5 * S // 10)) == []
    ((topic, estimate),) = _feed(node, _odometry(S))
    assert (topic, estimate.stamp_ns, estimate.status) == ("depth/estimate", 5 * S // 10, "ok")
    assert np.isfinite(estimate.values).mean() > 0.5


def test_only_the_newest_ready_picture_is_worked_on_and_the_others_are_counted():
    node = DepthNode(DepthNode.Config(source="stixel"))
    node.configure()
    _feed(node, RIG, _odometry(0), _scan(0), _image(2 * S // 10), _image(6 * S // 10), _image(15 * S // 10))
    ((_, estimate),) = _feed(node, _odometry(S))
    assert estimate.stamp_ns == 6 * S // 10
    assert node.overtaken == 1
    assert "overtaken" in node.detail


def test_a_picture_of_another_size_is_refused_with_both_sizes():
    node = DepthNode(DepthNode.Config(source="none"))
    node.configure()
    ((_, estimate),) = _feed(node, RIG, _image(S, size=(320, 240)))
    assert "320x240" in estimate.status
    assert estimate.values.size == 0


@pytest.mark.parametrize(
    ("image", "reason"),
    [(_image(S // 2, 0), "black|dark"), (_image(S // 2, 255), "overexposed|bright|white")],
)
def test_a_picture_that_shows_nothing_gives_no_depth(image, reason):
    node = FusionNode(FusionNode.Config())
    node.configure()
    empty = DepthEstimate(stamp_ns=S // 2, source="none", kind="none", values=np.zeros((0, 0), np.float32))
    scans = [m for i in range(-3, 1) for m in (_scan(10 * S + i * S), _odometry(10 * S + i * S))]
    shifted = image.model_copy(update={"stamp_ns": 10 * S - S // 2})
    out = _feed(
        node, RIG, *scans[:-2], shifted, empty.model_copy(update={"stamp_ns": shifted.stamp_ns}), *scans[-2:]
    )
    ((topic, fused),) = out
    assert topic == "fusion/depth"
    assert fused.depth_m.size == 0
    assert any(word in fused.status for word in reason.split("|")), fused.status
