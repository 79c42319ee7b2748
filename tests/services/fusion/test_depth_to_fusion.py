"""Depth and fusion as nodes occluded_walls the lidar localization: metric depth, or a reason why not."""

import cv2
import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.messages import DepthEstimate, Image, Odometry, Rig, Scan
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.node import Job
from beamsplat.services.depth.node import DepthNode
from beamsplat.services.depth.source import Estimate
from beamsplat.services.fusion.calibration.startup_check import CalibrationHealth
from beamsplat.services.fusion.node import FusionNode
from beamsplat.tools.system.assembly import build_node
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
    absrel, inside, answered = [], [], []
    for stamp_ns, message in fused.items():
        file = shared_dir / f"data/house_a/depth_gt/{stamp_ns}.png"
        if file.exists():
            truth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / 1000.0
            known = (truth > 0) & np.isfinite(message.depth_m)
            answered.append(known.sum() / (truth > 0).sum())  # what is doubtful gets no answer
            error = np.abs(message.depth_m - truth)[known]
            absrel.append(np.mean(error / truth[known]))
            inside.append(np.mean(error < 3.0 * message.sigma_m[known]))
    assert len(absrel) >= 6
    assert np.mean(answered) > 0.85
    assert min(answered) > 0.6  # the first images have nothing before them
    assert np.mean(absrel) < 0.10
    assert np.mean(inside) > 0.85
    for message in fused.values():
        assert message.inlier_share > 0.8
        assert message.residual_m < 0.03


def test_images_are_swept_as_the_keyframes_service_decides(shared_dir):
    """Every candidate gets one decision, and the fused depth carries it; published keyframes are those."""
    nodes = {
        "replay": {"data": str(shared_dir / "data/house_a/bag"), "duration_s": 4.0},
        "localization": {"kind": "lidar"}, "depth": {"source": "stixel"}, "fusion": {},
        "keyframes": {"distance_m": 0.4},
    }  # fmt: skip
    deployment, by_topic = Deployment(nodes=nodes), {}

    def on_message(envelope):
        by_topic.setdefault(envelope.topic, {})[envelope.message.stamp_ns] = envelope.message

    Lockstep([build_node(deployment, name) for name in nodes], on_message).run()
    candidates, decisions = by_topic["keyframes/candidate"], by_topic["keyframes/decision"]
    assert set(candidates) == set(decisions) == set(by_topic["fusion/depth"])
    selected = {stamp for stamp, decision in decisions.items() if decision.keyframe}
    assert selected == {stamp for stamp, fused in by_topic["fusion/depth"].items() if fused.keyframe}
    assert selected == set(by_topic["keyframes/frame"])
    assert 2 <= len(selected) < 0.5 * len(decisions)


def test_candidates_without_an_answer_are_dropped_and_counted():
    node = FusionNode(FusionNode.Config())
    node.configure()
    out = _feed(node, RIG, _scan(7 * S), _odometry(7 * S))
    for k in range(15):
        out += _feed(node, *_moment(k, _live_image(k)))
    assert {topic for topic, _ in out} == {"keyframes/candidate"}
    assert len(out) == 15
    assert node.overtaken == 15 - 8  # the others may still be answered
    assert node.awaits_feedback()
    list(node.on_feedback_timeout(1.0))
    assert (node.overtaken, node.awaits_feedback()) == (15, False)


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
        waiting = list(node.handle(topics[type(message)], message))
        while waiting:
            output = waiting.pop(0)
            if isinstance(output, Job):
                waiting = [*node.handle_job(output.name, output.run()), *waiting]
            else:
                out.append(output)
    return out


S = 100_000_000


def test_an_estimate_waits_for_the_pose_of_its_image():
    node = DepthNode(DepthNode.Config(source="stixel"))
    node.configure()
    assert _feed(node, RIG, _odometry(0), _scan(0), _image(5 * S // 10)) == []
    ((topic, estimate),) = _feed(node, _odometry(S))
    assert (topic, estimate.stamp_ns, estimate.status) == ("depth/estimate", 5 * S // 10, "ok")
    assert np.isfinite(estimate.values).mean() > 0.5


class Looking:
    """A depth source that looks at the image, and waits for the beams."""

    uses_beams = True

    def estimate(self, view):
        return Estimate(np.ones(view.image_rgb.shape[:2], np.float32), "metric")


def test_a_source_that_looks_at_images_works_on_the_newest_and_the_others_are_counted():
    node = DepthNode(DepthNode.Config(source="tests.services.fusion.test_depth_to_fusion:Looking"))
    node.configure()
    _feed(node, RIG, _odometry(0), _scan(0), _image(2 * S // 10), _image(6 * S // 10), _image(15 * S // 10))
    ((_, estimate),) = _feed(node, _odometry(S))
    assert estimate.stamp_ns == 6 * S // 10
    assert node.overtaken == 1
    assert "overtaken" in node.detail


def test_a_geometric_source_works_on_every_image():
    node = DepthNode(DepthNode.Config(source="stixel"))
    node.configure()
    _feed(node, RIG, _odometry(0), _scan(0), _image(2 * S // 10), _image(6 * S // 10), _image(15 * S // 10))
    assert [m.stamp_ns for _, m in _feed(node, _odometry(S))] == [2 * S // 10, 6 * S // 10]
    assert node.overtaken == 0


def test_an_image_of_another_size_is_refused_with_both_sizes():
    node = DepthNode(DepthNode.Config(source="none"))
    node.configure()
    ((_, estimate),) = _feed(node, RIG, _image(S, size=(320, 240)))
    assert "320x240" in estimate.status
    assert estimate.values.size == 0


@pytest.mark.parametrize(
    ("image", "reason"),
    [(_image(S // 2, 0), "black|dark"), (_image(S // 2, 255), "overexposed|bright|white")],
)
def test_an_image_that_shows_nothing_gives_no_depth(image, reason):
    node = _node()
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


def _node(**config):
    """A fusion node in a system without a keyframes service."""
    node = FusionNode(FusionNode.Config(**config))
    node.without_producer = frozenset({"keyframes/decision"})
    node.configure()
    return node


def _moment(k, image, ranges=2.0, values=None, status="ok"):
    """Scan, pose, image and estimate of the k-th tenth of a second, the body 5 cm on each time."""
    stamp = (10 + k) * S
    scan = _scan(stamp).model_copy(update={"ranges_m": np.full(300, ranges, np.float32)})
    T = np.eye(4)
    T[0, 3] = 0.05 * k
    odometry = Odometry(stamp_ns=stamp, T_odom_body=T, covariance=np.eye(3))
    taken = image.model_copy(update={"stamp_ns": stamp - S // 2})
    kind = "none" if values is None else "metric"
    values = np.zeros((0, 0), np.float32) if values is None else values
    estimate = DepthEstimate(stamp_ns=taken.stamp_ns, source="none", kind=kind, values=values, status=status)
    return scan, odometry, taken, estimate


def _drive(node, moments):
    out = _feed(node, RIG, _scan(7 * S), _odometry(7 * S))
    for moment in moments:
        out += _feed(node, *moment)
    # A last pose, so that the last image can be placed.
    out += _feed(node, _odometry(30 * S).model_copy(update={"T_odom_body": moments[-1][1].T_odom_body}))
    return [message for topic, message in out if topic == "fusion/depth"]


def _live_image(k):
    rgb = np.random.default_rng(100 + k).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    return _image(0).model_copy(update={"data": rgb.reshape(-1)})


def _nothing_false(messages):
    """Whatever is refused carries no depth; whatever carries depth says ok."""
    for message in messages:
        assert (message.status == "ok") == (message.depth_m.size > 0)
        assert message.depth_m.size == 0 or np.isfinite(message.depth_m).any()


def test_no_beams_in_view_is_said_and_gives_no_depth():
    messages = _drive(_node(), [_moment(k, _live_image(k), ranges=np.inf) for k in range(3)])
    assert messages
    assert all("no beams in view" in m.status for m in messages)
    _nothing_false(messages)


def test_a_frozen_camera_is_said_once_the_robot_has_moved():
    image = _live_image(0)
    messages = _drive(_node(), [_moment(k, image) for k in range(8)])
    assert "frozen" in messages[-1].status
    _nothing_false(messages)


@pytest.mark.parametrize("values", [np.nan, 0.0])
def test_a_network_that_answers_rubbish_is_not_asked(values):
    """Its estimate comes with a reason; geometry alone carries the image, without its numbers."""
    rubbish = np.full((480, 640), values, np.float32)
    node = _node()
    messages = _drive(
        node,
        [_moment(k, _live_image(k), values=rubbish, status="the network returned rubbish") for k in range(3)],
    )
    good = _drive(_node(), [_moment(k, _live_image(k)) for k in range(3)])
    assert len(messages) == len(good) > 0
    for with_rubbish, without in zip(messages, good):
        assert with_rubbish.status == without.status
        assert np.array_equal(with_rubbish.depth_m, without.depth_m, equal_nan=True)
    _nothing_false(messages)


@pytest.mark.parametrize("values", [np.nan, 0.0])
def test_rubbish_that_calls_itself_ok_does_no_harm_either(values):
    rubbish = np.full((480, 640), values, np.float32)
    messages = _drive(_node(), [_moment(k, _live_image(k), values=rubbish) for k in range(3)])
    good = _drive(_node(), [_moment(k, _live_image(k)) for k in range(3)])
    for with_rubbish, without in zip(messages, good):
        assert np.array_equal(with_rubbish.depth_m, without.depth_m, equal_nan=True)


def test_the_calibration_check_is_told_beside_the_health():
    node = _node()
    _drive(node, [_moment(k, _live_image(k)) for k in range(3)])
    assert "calibration not checked yet" in node.detail
    assert _doubts(node) is None
    off = _node(check_pairs=0)
    _drive(off, [_moment(k, _live_image(k)) for k in range(3)])
    assert "calibration" not in off.detail


def _doubts(node):
    return {f.name: f.value for f in node.figures.report()}.get("calibration_doubts")


@pytest.mark.parametrize(
    ("cause", "status", "doubts"),
    [
        ("ok", "ok", 0.0),
        ("clock", "the camera's clock is wrong", 1.0),
        ("unchecked", "cannot be checked", None),
    ],
)
def test_the_result_of_the_calibration_check_is_a_figure(cause, status, doubts):
    node, none = _node(), np.full(3, np.nan)
    list(node.on_job_check_calibration(CalibrationHealth(status, 0.3, 0.0, 1.0, none, none, 60, cause)))
    assert _doubts(node) == doubts
