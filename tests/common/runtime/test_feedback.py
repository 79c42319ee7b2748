"""A node that hears of its own output: it ends all the same, in both runners, and hears every answer."""

import threading
import time

import numpy as np
import pytest

from beamsplat.common.messages import CameraModel, Keyframe, KeyframeAck
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.live import Live, LiveSettings
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.common.runtime.mailbox import NO_PRODUCER, Envelope, Mailbox
from beamsplat.common.runtime.node import Input, Node, merged_topics
from beamsplat.common.zenoh.bus import open_router
from tests.common.nodes import SensorSource, SensorSourceConfig

CAMERA = CameraModel(
    width_px=4, height_px=4, fx_px=4.0, fy_px=4.0, cx_px=2.0, cy_px=2.0, T_body_camera=np.eye(4)
)
BYTES = np.zeros(1, np.uint8)


class Asks(Node):
    """A keyframe for every scan; counts the answers."""

    name = "keyframes"
    inputs = ("lidar/scan", Input("keyframes/ack", feedback=True))
    outputs = ("keyframes/frame",)

    def configure(self):
        self.heard, self.order = [], []

    def on_lidar_scan(self, scan):
        self.order.append("scan")
        yield (
            "keyframes/frame",
            Keyframe(stamp_ns=scan.stamp_ns, id=scan.stamp_ns, encoding="png", picture=BYTES, camera=CAMERA,
                     anchor_id=0, T_anchor_body=np.eye(4), T_map_anchor=np.eye(4), depth_png=BYTES,
                     sigma_png=BYTES),
        )  # fmt: skip

    def on_keyframes_ack(self, ack):
        self.order.append("ack")
        self.heard.append(ack.id)
        return iter(())


class Answers(Node):
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


def _drive(**change):
    return SensorSource(SensorSourceConfig(seconds=2.0, images=False, **change))


def test_in_lockstep_a_loop_of_two_nodes_ends():
    asks, answers = Asks(Asks.Config()), Answers(Answers.Config())
    Lockstep([_drive(), asks, answers]).run()
    assert answers.ended
    assert len(asks.heard) == 20
    assert asks.order[:4] == ["scan", "ack", "scan", "ack"]


def test_an_answer_after_the_end_is_still_heard():
    """The slow mapper answers when the keyframes' own input has ended long ago."""
    asks, answers = Asks(Asks.Config()), Answers(Answers.Config(step_cost_s=5.0))
    Lockstep([_drive(), asks, answers]).run()
    assert answers.ended
    assert len(asks.heard) == 20
    assert asks.order[-15:] == ["ack"] * 15


def test_live_a_loop_of_two_nodes_ends(tmp_path, free_endpoint):
    nodes = [Asks(Asks.Config()), Answers(Answers.Config())]
    settings = {
        "robot": "test",
        "endpoints": (free_endpoint,),
        "run_dir": tmp_path,
        "exit_when_drained": True,
    }
    with open_router((free_endpoint,)):
        # Who asks stays when it has ended, as processes do: the last answers come after.
        asking = Live(nodes[0], LiveSettings(**{**settings, "exit_when_drained": False}))
        lives = [Live(nodes[1], LiveSettings(**settings))]
        everyone = frozenset({"keyframes", "mapping"})
        lives.append(Live(_drive(), LiveSettings(**settings, rate=4.0, wait_for=everyone)))
        threads = [threading.Thread(target=live.run, daemon=True) for live in (*lives, asking)]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + 30.0
        for thread in threads[:-1]:
            thread.join(max(deadline - time.monotonic(), 0.0))
        assert not any(thread.is_alive() for thread in threads[:-1]), "the loop waits for itself"
        while len(nodes[0].heard) < 20 and time.monotonic() < deadline:
            time.sleep(0.05)
        asking.stop()
        threads[-1].join(10.0)
    assert nodes[1].ended
    assert len(nodes[0].heard) == 20


@pytest.mark.parametrize("delivery", [None, "latest"])
def test_feedback_is_neither_merged_nor_waited_for(delivery):
    node = type(
        "Hears",
        (Asks,),
        {"name": "keyframes", "inputs": ("lidar/scan", Input("keyframes/ack", delivery, feedback=True))},
    )
    assert merged_topics(node) == ("lidar/scan",)
    mailbox = Mailbox(node)
    mailbox.end("lidar/scan", "ab" * 8, 0)
    assert mailbox.ended
    for i in range(3):
        ack = KeyframeAck(stamp_ns=100 - i, id=i)  # older each time: still in order of arrival
        mailbox.put(Envelope("keyframes/ack", Header(ack.stamp_ns, 0, 0, i, 0, "mapping", "cd" * 8), ack))
    assert not mailbox.ended
    wanted = [0, 1, 2] if delivery is None else [2]
    assert [mailbox.pop().message.id for _ in wanted] == wanted
    assert mailbox.counts["keyframes/ack"].dropped == (0 if delivery is None else 2)
    mailbox.end("keyframes/ack", "cd" * 8, 0, sent=3)
    assert mailbox.ended
    assert mailbox.counts["keyframes/ack"].lost == 0


def test_a_node_without_other_inputs_than_feedback_does_not_end_by_itself():
    mailbox = Mailbox(Asks)
    mailbox.end("keyframes/ack", "cd" * 8, 0)
    assert not mailbox.ended
    mailbox.end("lidar/scan", NO_PRODUCER, 0)
    assert not mailbox.ended  # nobody feeds it at all: it waits, as every node does
