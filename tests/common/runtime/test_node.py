"""Errors in a node class are raised at its definition, undeclared outputs when they are published."""

import numpy as np
import pytest

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.messages import Correction, ExternalPose
from beamsplat.common.runtime.node import Job, Node, UndeclaredOutput, merged_topics
from beamsplat.common.topics import TOPICS
from tests.common.nodes import Chain, Slow


def test_a_missing_handler_fails_at_definition():
    with pytest.raises(TypeError, match="on_lidar_scan"):
        type("WithoutHandler", (Node,), {"name": "localization", "inputs": ("lidar/scan",)})


def test_an_unknown_topic_fails_at_definition():
    with pytest.raises(KeyError, match="there is no topic 'lidar/scans'"):
        type("Misspelt", (Node,), {"name": "localization", "outputs": ("lidar/scans",)})


def test_a_foreign_topic_fails_at_definition():
    with pytest.raises(TypeError, match="whose producers are"):
        type("ForeignOutput", (Node,), {"name": "localization", "outputs": ("camera/image",)})


def _node(handler):
    def on_external_pose(self, message):
        yield handler

    cls = type(
        "Writer",
        (Node,),
        {
            "name": "localization",
            "inputs": ("external/pose",),
            "outputs": ("localization/odometry",),
            "on_external_pose": on_external_pose,
        },
    )
    return cls(NodeConfig())


@pytest.mark.parametrize(
    ("output", "error"),
    [
        (("localization/correction", Correction(stamp_ns=0, T_map_odom=np.eye(4))), "not among its outputs"),
        (
            ("localization/odometry", Correction(stamp_ns=0, T_map_odom=np.eye(4))),
            "published a Correction on",
        ),
        (Job("dig", lambda: None), "no method on_job_dig"),
    ],
)
def test_undeclared_outputs_raise(output, error):
    pose = ExternalPose(stamp_ns=0, T_map_body=np.eye(4))
    with pytest.raises(UndeclaredOutput, match=error):
        list(_node(output).handle("external/pose", pose))


def test_merged_inputs_are_those_of_delivery_every():
    assert merged_topics(Chain) == ("wheel/odometry", "lidar/scan")
    assert merged_topics(Slow) == ("lidar/scan",)
    assert Chain.queries() == ("count",)


def test_topic_rows_are_consistent():
    for name, row in TOPICS.items():
        assert row.producers
        assert row.delivery != "latched" or row.cache == 1, name
        assert row.delivery != "every" or row.cache == 0 or row.cache >= 30 * row.rate_hz, (
            f"{name}: the cache does not survive an outage of 30 s"
        )


def test_only_nodes_with_on_health_receive_health_reports():
    assert not Chain.watches_health()
    watcher = type("Watcher", (Node,), {"name": "monitor", "on_health": lambda self, health: None})
    assert watcher.watches_health()
