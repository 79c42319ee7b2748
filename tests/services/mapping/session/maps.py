"""Keyframe messages of the synthetic room, and a mapper for them, for the session tests."""

import numpy as np

from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.messages import Keyframe, Tick
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.node import MappingNode
from tests.services.mapping import room_drive as r

SECOND = 1_000_000_000


def message(number, stamp_ns=None, **change):
    """Return one keyframe per second; the second half is anchored to anchor 1."""
    rgb, depth = r.shot(number)
    anchor = int(number >= 4)
    T_map_anchor = r.T_map_body(4 * anchor)
    stamp_ns = r.T0 + number * SECOND if stamp_ns is None else stamp_ns
    fields = {
        "stamp_ns": stamp_ns, "id": stamp_ns, "encoding": "png", "picture": r.jpeg(rgb), "camera": r.CAMERA_MODEL,
        "anchor_id": anchor, "T_anchor_body": inverse(T_map_anchor) @ r.T_map_body(number),
        "T_map_anchor": T_map_anchor, "depth": pack_depth(depth),
        "sigma": pack_sigma(np.full_like(depth, 0.01)),
        "beams": np.array([[80.0, 60.0, depth[60, 80], 0.01]], np.float32),
    }  # fmt: skip
    return Keyframe(**{**fields, **change})


def make_node(session=None, **options):
    """Return a configured mapper with few steps."""
    options = {"half_steps": 4, "full_steps": 3, "tick_steps": 2, **options}
    node = MappingNode(MappingConfig(session=session, **options))
    node.configure()
    return node


def feed(node, numbers):
    """Pass keyframes to a node, run background jobs at once; return its outputs by topic."""
    sent = {}
    for number in numbers:
        handle(node, "keyframes/frame", message(number), sent)
    return sent


def insert_waiting(node):
    """Let a resumed node insert the keyframes on disk that are newer than its checkpoint; return the node."""
    while node._session.has_skipped:
        handle(node, "tick", Tick(stamp_ns=1, count=1))
    return node


def handle(node, topic, content, sent=None):
    """Pass one message to a node; return `sent` with its outputs added."""
    sent = {} if sent is None else sent
    for output in node.handle(topic, content):
        if isinstance(output, tuple):
            sent.setdefault(output[0], []).append(output[1])
        else:
            list(node.handle_job(output.name, output.run()))
    return sent
