"""Bytes that real Zenoh sessions carry: depth as it is stored, and payloads that are never encoded twice."""

import numpy as np

from beamsplat.common.messages import FusedDepth, Image, Keyframe
from beamsplat.common.messages import codec as message_codec
from beamsplat.common.messages.codec import encode, kept_payload
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma, unpack_depth
from beamsplat.common.runtime.node import Input
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from tests.common.polling import wait_until
from tests.common.samples import sample_messages

SAMPLES = {type(m): m for m in sample_messages()}


def room():
    """Depth float32 [480, 640] (m): floor, a wall, and a step in it, with noise of 0.2 mm."""
    v, u = np.mgrid[:480, :640].astype(np.float32)
    floor = 0.45 * 530.0 / np.maximum(v - 240.0, 1e-3)
    wall = 3.0 / (1.0 - 0.4 * (u - 320.0) / 530.0)
    depth = np.minimum(np.where(v > 240.0, floor, np.inf), np.where(u > 400.0, wall + 0.8, wall))
    return (depth + np.random.default_rng(0).normal(0.0, 2e-4, depth.shape)).astype(np.float32)


class Received:
    """Raw samples of one topic."""

    def __init__(self, bus, robot, name):
        self.samples, self._row = [], topic(name)
        self._kept = declare_subscription(
            bus.session, key(robot, name), self._row, "every", self.samples.append
        )

    @property
    def envelopes(self):
        return [decode_sample(sample, self._row) for sample in self.samples]


def received(make_bus, robot, name, messages, backlog=0):
    """Publish messages and return what another session receives."""
    producer, consumer = make_bus("fusion"), make_bus("keyframes")
    heard = Received(consumer, robot, name)
    publication = producer.publish(name)
    producer.wait_for_subscribers((name,), 5.0)
    for message in messages:
        publication.put(message, backlog)
    wait_until(lambda: len(heard.samples) == len(messages))
    return heard


def test_a_fused_depth_takes_a_tenth_of_its_2_4_mb(make_bus, robot):
    depth = room()
    message = FusedDepth.of(depth, 0.02 * depth, stamp_ns=1, keyframe=True)
    heard = received(make_bus, robot, "fusion/depth", [message])
    size = len(heard.samples[0].payload) + len(heard.samples[0].attachment)
    assert size < 0.1 * 2 * depth.nbytes
    error_mm = np.abs(heard.envelopes[0].message.depth_m - depth) * 1e3
    assert error_mm.max() <= 0.501


def test_a_keyframe_passes_on_the_bytes_of_fusion_and_is_encoded_once(make_bus, robot, monkeypatch):
    encoded = []
    pieces = message_codec._pieces
    monkeypatch.setattr(message_codec, "_pieces", lambda m: encoded.append(type(m)) or pieces(m))
    depth = room()
    fused = FusedDepth.of(depth, 0.02 * depth, stamp_ns=1)
    keyframe = SAMPLES[Keyframe].model_copy(update={"depth": fused.depth, "sigma": fused.sigma})
    queued = encode(keyframe, keep=True)  # as the outbox does, before it is published
    heard = received(make_bus, robot, "keyframes/frame", [keyframe, keyframe], backlog=7)
    assert encoded == [Keyframe]
    envelopes = heard.envelopes
    for envelope in envelopes:
        assert envelope.header.backlog == 7
        assert kept_payload(envelope.message) == queued  # what a session stores, and a recorder writes
        assert encode(envelope.message) == queued
    assert encoded == [Keyframe]
    again = envelopes[0].message
    np.testing.assert_array_equal(again.depth, pack_depth(depth))
    np.testing.assert_array_equal(again.sigma, pack_sigma(0.02 * depth))
    assert np.abs(unpack_depth(again.depth, depth.shape) - depth).max() <= 0.000501


def test_headers_are_read_without_the_payload(make_bus, robot):
    producer, consumer = make_bus("camera"), make_bus("observer")
    headers, faults = [], []
    consumer.subscribe_headers(Input("camera/image", "every"), headers.append, lambda *f: faults.append(f))
    publication = producer.publish("camera/image")
    producer.wait_for_subscribers(("camera/image",), 5.0)
    image = SAMPLES[Image]
    sent = [publication.put(image.model_copy(update={"stamp_ns": stamp_ns})) for stamp_ns in range(5)]
    wait_until(lambda: len(headers) == 5)
    assert headers == sent
    producer.session.put(key(robot, "camera/image"), b"no header")
    wait_until(lambda: faults)
    assert "without a header" in faults[0][1]
