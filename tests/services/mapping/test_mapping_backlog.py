"""Catching up after an outage: the more keyframes wait on the robot, the fewer steps each gets."""

import itertools

from beamsplat.common.messages.header import Header
from beamsplat.services.mapping.node import MappingConfig, MappingNode
from tests.services.keyframes.test_keyframes_node import keyframes_of


def test_steps_per_keyframe_follow_the_backlog():
    frames = keyframes_of()[1]
    node = MappingNode(MappingConfig(half_steps=8, full_steps=4, calm_backlog=4))
    node.configure()
    steps = [0]
    for frame, backlog in zip(frames, (1, 16, 1000)):
        node.on_header(Header(frame.stamp_ns, 0, 0, 0, 1, "keyframes", "ab" * 8, backlog))
        messages = list(node.handle("keyframes/frame", frame))
        steps += [m.steps for name, m in messages if name == "mapping/status"]
        assert [m.status for name, m in messages if name == "keyframes/ack"] == ["ok"]
    assert [b - a for a, b in itertools.pairwise(steps)] == [12, 3, 2]
