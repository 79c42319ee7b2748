"""What a loop closure sends: the poses of the submaps, over real Zenoh sessions, and no chunk again."""

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.mapfiles.anchor_poses import AnchorPoses
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.messages import Anchors, Tick
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import Bus, key, open_router, open_session
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.services.mapping.node import MappingConfig, MappingNode
from tests.common.polling import wait_until
from tests.services.mapping.session.gallery import message

SUBMAPS = 100
PUBLISHED = ("mapping/chunk", "mapping/anchors")


class Wire:
    """Samples received on the topics of a mapper, with the bytes of payload and header."""

    def __init__(self, session):
        self.samples, self._kept = [], []
        for name in PUBLISHED:
            row = topic(name)
            self._kept.append(
                declare_subscription(session, key("robot", name), row, row.delivery, self.samples.append)
            )

    def take(self, count):
        """Return the next `count` messages, and their bytes."""
        wait_until(lambda: len(self.samples) >= count)
        taken, self.samples[:] = list(self.samples), []
        size = sum(len(s.payload) + len(s.attachment) for s in taken)
        names = [str(s.key_expr).partition("robot/")[2] for s in taken]
        return [decode_sample(s, topic(n)).message for s, n in zip(taken, names)], size


@pytest.fixture
def wire(free_endpoint):
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as listening:
        heard = Wire(listening)
        with Bus(open_session((free_endpoint,)), "robot", "mapping", "ab" * 8, 1) as bus:
            publications = {name: bus.publish(name) for name in PUBLISHED}
            bus.wait_for_subscribers(PUBLISHED, 5.0)

            def send(node, name, content):
                sent = [out for out in node.handle(name, content) if out[0] in publications]
                for published, outgoing in sent:
                    publications[published].put(outgoing)
                return len(sent)

            yield heard, send


def closed_loop():
    """Return new poses of all submaps: a drift that grows along the drive is removed."""
    ids = np.arange(SUBMAPS)
    T = [make_transform(so3_exp([0.0, 0.0, 0.004 * i]), np.array([0.01 * i, 12.0 * i, 0.0])) for i in ids]
    return Anchors(stamp_ns=1, anchor_ids=ids, T_map_anchor=np.array(T), optimisation=1)


def test_a_loop_closure_over_100_submaps_sends_less_than_50_kb(wire):
    heard, send = wire
    options = {"half_steps": 0, "full_steps": 0, "mend_steps": 3, "tick_steps": 0}
    node = MappingNode(MappingConfig(chunk_every=1, chunk_error_px=0.1, **options))
    node.configure()
    for number in range(SUBMAPS):  # one keyframe each, 12 m apart
        frame = message(4 * number, places=10**6)
        send(node, "keyframes/frame", frame)
    chunks, of_chunks = heard.take(SUBMAPS)
    assert {c.anchor_id for c in chunks} == set(range(SUBMAPS))

    sent = send(node, "localization/anchors", closed_loop())
    moved, of_closure = heard.take(1)
    assert (sent, [type(m).__name__ for m in moved]) == (1, ["MapAnchors"])
    assert of_closure <= 50_000
    assert of_chunks > 5 * of_closure

    # A viewer that has the chunks has the map at once.
    poses = AnchorPoses()
    for m in moved:
        poses.update(m.pose_revision, zip(m.anchor_ids.tolist(), m.T_map_anchor))
    store = node._mapper.store
    for chunk in chunks:
        shown = transform_gaussians(unpack(chunk.packed), poses.pose(chunk.anchor_id))
        np.testing.assert_allclose(shown[:3], store.chunk(chunk.anchor_id)[:3], atol=0.005)

    while node.has_idle_work():  # the steps that close the gaps
        assert list(node.handle_idle()) == []
    changed = send(node, "tick", Tick(stamp_ns=2, count=2))  # what these steps have changed follows
    assert changed == 1
    (chunk,), _ = heard.take(1)
    np.testing.assert_allclose(chunk.T_map_anchor, poses.pose(chunk.anchor_id), atol=1e-12)
    assert chunk.pose_revision == moved[0].pose_revision == 1
