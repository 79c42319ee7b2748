"""A node with feedback of its own output ends in both runners, and handles all feedback."""

import threading
import time

import numpy as np
import pytest

from beamsplat.common.messages import CameraModel, Keyframe, KeyframeAck
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.runtime.live import Live, LiveSettings
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from beamsplat.common.runtime.node import Input, Node, merged_topics
from beamsplat.common.zenoh.bus import open_router
from tests.common.nodes import SensorSource, SensorSourceConfig
from tests.common.polling import wait_until

CAMERA = CameraModel(
    width_px=4, height_px=4, fx_px=4.0, fy_px=4.0, cx_px=2.0, cy_px=2.0, T_body_camera=np.eye(4)
)
BYTES = np.zeros(1, np.uint8)


class Requester(Node):
    """Publishes a keyframe for every scan; collects the acknowledgements."""

    name = "keyframes"
    inputs = ("lidar/scan", Input("keyframes/ack", feedback=True))
    outputs = ("keyframes/frame",)

    def configure(self):
        self.acknowledged, self.order = [], []

    def on_lidar_scan(self, scan):
        self.order.append("scan")
        yield (
            "keyframes/frame",
            Keyframe(stamp_ns=scan.stamp_ns, id=scan.stamp_ns, encoding="png", picture=BYTES, camera=CAMERA,
                     anchor_id=0, T_anchor_body=np.eye(4), T_map_anchor=np.eye(4), depth=BYTES,
                     sigma=BYTES),
        )  # fmt: skip

    def on_keyframes_ack(self, ack):
        self.order.append("ack")
        self.acknowledged.append(ack.id)
        return iter(())


class Responder(Node):
    name = "mapping"
    inputs = ("keyframes/frame",)
    outputs = ("keyframes/ack",)

    def configure(self):
        self.ended = False

    def on_keyframes_frame(self, frame):
        yield "keyframes/ack", KeyframeAck(stamp_ns=frame.stamp_ns, id=frame.id)

    def drain(self):
        self.ended = True
        return ()


def _sensors(**change):
    return SensorSource(SensorSourceConfig(seconds=2.0, images=False, **change))


def test_in_lockstep_a_loop_of_two_nodes_ends():
    requester, responder = Requester(Requester.Config()), Responder(Responder.Config())
    Lockstep([_sensors(), requester, responder]).run()
    assert responder.ended
    assert len(requester.acknowledged) == 20
    assert requester.order[:4] == ["scan", "ack", "scan", "ack"]


def test_feedback_after_the_end_is_still_handled():
    """The slow mapper acknowledges long after the inputs of the keyframes node have ended."""
    requester, responder = Requester(Requester.Config()), Responder(Responder.Config(step_cost_s=5.0))
    Lockstep([_sensors(), requester, responder]).run()
    assert responder.ended
    assert len(requester.acknowledged) == 20
    assert requester.order[-15:] == ["ack"] * 15


def test_live_a_loop_of_two_nodes_ends(tmp_path, free_endpoint):
    nodes = [Requester(Requester.Config()), Responder(Responder.Config())]
    settings = {
        "robot": "test",
        "endpoints": (free_endpoint,),
        "run_dir": tmp_path,
        "exit_when_drained": True,
    }
    with open_router((free_endpoint,)):
        # The requester's process stays after its inputs have ended: the last acknowledgements arrive later.
        requesting = Live(nodes[0], LiveSettings(**{**settings, "exit_when_drained": False}))
        lives = [Live(nodes[1], LiveSettings(**settings))]
        everyone = frozenset({"keyframes", "mapping"})
        lives.append(Live(_sensors(), LiveSettings(**settings, rate=4.0, wait_for=everyone)))
        threads = [threading.Thread(target=live.run, daemon=True) for live in (*lives, requesting)]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + 30.0
        for thread in threads[:-1]:
            thread.join(max(deadline - time.monotonic(), 0.0))
        assert not any(thread.is_alive() for thread in threads[:-1]), "the nodes wait for each other"
        wait_until(lambda: len(nodes[0].acknowledged) == 20, 30.0)
        requesting.stop()
        threads[-1].join(10.0)
    assert nodes[1].ended
    assert len(nodes[0].acknowledged) == 20


@pytest.mark.parametrize("delivery", [None, "latest"])
def test_feedback_is_neither_merged_nor_waited_for(delivery):
    node = type(
        "Hears",
        (Requester,),
        {"name": "keyframes", "inputs": ("lidar/scan", Input("keyframes/ack", delivery, feedback=True))},
    )
    assert merged_topics(node) == ("lidar/scan",)
    mailbox = Mailbox(node)
    mailbox.end("lidar/scan", ProcessId("replay", 0, "ab" * 8))
    assert mailbox.ended
    for i in range(3):
        ack = KeyframeAck(stamp_ns=100 - i, id=i)  # older each time: still in order of arrival
        mailbox.put(Envelope("keyframes/ack", Header(ack.stamp_ns, 0, 0, i, 0, "mapping", "cd" * 8), ack))
    assert not mailbox.ended
    wanted = [0, 1, 2] if delivery is None else [2]
    assert [mailbox.pop().message.id for _ in wanted] == wanted
    assert mailbox.counts["keyframes/ack"].dropped == (0 if delivery is None else 2)
    mailbox.end("keyframes/ack", ProcessId("mapping", 0, "cd" * 8), sent=3)
    assert mailbox.ended
    assert mailbox.counts["keyframes/ack"].lost == 0


def test_a_node_without_other_inputs_than_feedback_does_not_end_by_itself():
    mailbox = Mailbox(Requester)
    mailbox.end("keyframes/ack", ProcessId("mapping", 0, "cd" * 8))
    assert not mailbox.ended
    mailbox.end("lidar/scan", None)
    assert not mailbox.ended  # no producer at all: it waits, as every node does
