"""The lidar localization node on a real recording with ground truth: accuracy, reproducibility, robustness."""

import hashlib

import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.common.geometry.transforms import inverse, yaw_of
from beamsplat.common.messages import Rig, Scan
from beamsplat.common.messages.codec import encode
from beamsplat.common.recording import RecordingReader
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.node import Node
from beamsplat.services.localization.lidar2d.node import LidarLocalization
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import build_node
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.samples import sample_messages


def _house(shared_dir, **replay):
    nodes = {
        "replay": {"data": str(shared_dir / "data/house_a/bag"), "without": ("image",), **replay},
        "localization": {"kind": "lidar"},
    }
    return Deployment(nodes=nodes)


def _lockstep(deployment):
    envelopes, digest = [], hashlib.sha256()

    def on_message(envelope):
        if envelope.header.producer == "localization":
            envelopes.append(envelope)
            digest.update(encode(envelope.message))

    Lockstep([build_node(deployment, name) for name in deployment.nodes], on_message).run()
    return envelopes, digest.hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("without", [("image",), ("image", "odometry")], ids=["wheels", "scans alone"])
def test_published_poses_of_the_house_are_true(shared_dir, without):
    """Check the online poses, T_map_odom * T_odom_body as published, aligned by the first pose only."""
    envelopes, _ = _lockstep(_house(shared_dir, without=without))
    truth = read_tum(shared_dir / "data/house_a/groundtruth.txt")
    T_map_odom, stamps, online = np.eye(4), [], []
    for envelope in envelopes:
        if envelope.topic == "localization/correction":
            T_map_odom = envelope.message.T_map_odom
        elif envelope.topic == "localization/odometry":
            assert envelope.message.status == "ok"
            stamps.append(envelope.message.stamp_ns)
            online.append(T_map_odom @ envelope.message.T_odom_body)
    answered, T_world_body = truth.resampled(stamps)
    online = np.array(online)[answered]
    T_world_map = T_world_body[0] @ inverse(online[0])
    errors = inverse(T_world_body) @ (T_world_map @ online)
    assert len(online) > 870
    assert np.sqrt(np.mean(np.sum(errors[:, :2, 3] ** 2, axis=1))) <= 0.015
    assert np.sqrt(np.mean(yaw_of(errors) ** 2)) <= 0.003


@pytest.mark.slow
def test_the_output_is_reproducible_byte_for_byte(shared_dir):
    deployment = _house(shared_dir, duration_s=25.0)
    envelopes, first = _lockstep(deployment)
    assert {envelope.topic for envelope in envelopes} == set(LidarLocalization.outputs)
    assert _lockstep(deployment)[1] == first


@pytest.mark.slow
def test_live_operation_publishes_the_same_messages_as_lockstep(shared_dir, tmp_path, free_endpoint):
    """Includes background optimisation: its results are applied at fixed scans."""
    offline = _house(shared_dir, duration_s=12.0)
    envelopes, _ = _lockstep(offline)
    live = Deployment(
        robot="t",
        router=RouterConfig(listen=(free_endpoint,)),
        rate=3.0,
        state_dir=tmp_path / "state",
        nodes={**offline.nodes, "recorder": {"out": str(tmp_path / "rec")}},
    )
    with Supervisor(live) as supervisor:
        _until_recorded(supervisor, tmp_path / "rec")
    with RecordingReader(tmp_path / "rec") as reader:
        recorded = [r for r in reader.messages() if r.topic.startswith("localization/")]
    for topic in ("localization/odometry", "localization/movers"):
        expected = [encode(x.message) for x in envelopes if x.topic == topic]
        assert [encode(r.message) for r in recorded if r.topic == topic] == expected, topic


def _until_recorded(supervisor, folder):
    import time

    from beamsplat.common.zenoh.bus import open_session
    from beamsplat.tools.system.health_table import HealthTable

    with open_session(supervisor.deployment.router.listen) as session:
        board = HealthTable(session, "t")
        deadline = time.monotonic() + 90
        while board.states().get("recorder") != "drained":
            supervisor.poll()
            assert time.monotonic() < deadline, board.states()
            time.sleep(0.1)
    assert folder.exists()


def _feed(node: Node, topic, message):
    return [output for output in node.handle(topic, message) if isinstance(output, tuple)]


def test_scans_before_the_calibration_are_rejected():
    node = LidarLocalization(LidarLocalization.Config())
    node.configure()
    scan = next(m for m in sample_messages() if type(m) is Scan)
    ((topic, odometry),) = _feed(node, "lidar/scan", scan)
    assert topic == "localization/odometry"
    assert (odometry.status, odometry.detail) == ("rejected", "no calibration yet")
    assert np.isnan(odometry.covariance).all()


def test_malformed_scans_are_rejected_and_create_no_map():
    node = LidarLocalization(LidarLocalization.Config())
    node.configure()
    assert _feed(node, "rig", next(m for m in sample_messages() if type(m) is Rig)) == []
    for i, value in enumerate((np.nan, np.inf, -1.0, 0.0)):
        scan = Scan(
            stamp_ns=1_000_000_000 + i * 100_000_000, angle_min_rad=-3.0, angle_increment_rad=0.01,
            time_increment_s=0.0, scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0,
            ranges_m=np.full(600, value, np.float32),
        )  # fmt: skip
        outputs = dict(_feed(node, "lidar/scan", scan))
        assert outputs["localization/odometry"].status == "rejected"
        assert outputs["localization/odometry"].detail
        assert not outputs["localization/movers"].moving.any()
    assert list(node.drain()) == []


def test_the_node_is_in_the_node_table():
    assert NODES["localization"].load("lidar") is LidarLocalization
