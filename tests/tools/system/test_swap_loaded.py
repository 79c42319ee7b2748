"""Twenty take-overs in a row of the real depth service and of the real mapper, while the robot drives on.

What was measured is printed: `pytest -s`.
"""

import itertools
import re
import time

import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health
from beamsplat.common.topics import HEALTH, Topic, topic
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.services.nodes import NODES
from tests.common.topic_listener import TopicListener
from tests.services.mapping.room_drive import TABLE
from tests.tools.system.test_swap import System

SWAPS = 20


class TimedTopicListener(TopicListener):
    """Also when each message came, and of which epoch it was."""

    def __init__(self, session, name):
        row = topic(name)
        self.messages, self.came_s, self.epochs = [], [], []

        def take(sample):
            letter = decode_sample(sample, row)
            self.messages.append(letter.message)
            self.came_s.append(time.monotonic())
            self.epochs.append(letter.header.epoch)

        self._kept = declare_subscription(session, f"beamsplat/r1/{name}", row, "every", take)

    def gaps_s(self):
        """Between each epoch's last message and the next one's first."""
        rows = list(zip(self.epochs, self.came_s))
        return [b[1] - a[1] for a, b in itertools.pairwise(rows) if b[0] != a[0]]


def report(name, ears, sentences):
    gaps = sorted(ears.gaps_s())
    usual = sorted(b - a for a, b in itertools.pairwise(ears.came_s))
    print(f"\n{name}: {len(sentences)} take-overs, {len(ears.messages)} messages; seconds between two messages: "
          f"median {usual[len(usual) // 2]:.3f}, longest {usual[-1]:.3f}; over a take-over: median "
          f"{gaps[len(gaps) // 2]:.3f}, longest {gaps[-1]:.3f}")  # fmt: skip
    print("\n".join(sentences))


class Healths:
    """What every instance of a node has counted, by its last words."""

    def __init__(self, system, node):
        self._latest = {}
        system.session.declare_subscriber(f"beamsplat/r1/health/{node}", self._take)

    def _take(self, sample):
        health = decode_sample(sample, Topic(HEALTH, Health, (), 1, "latest")).message
        self._latest[health.instance] = health

    def overtaken(self):
        """Pictures, on the way or while they waited for their pose; of an instance's last second not all."""
        waiting = [re.match(r"(\d+) images overtaken", h.detail) for h in self._latest.values()]
        dropped = [i.dropped for h in self._latest.values() for i in h.inputs if i.topic == "camera/image"]
        return sum(int(found[1]) for found in waiting if found) + sum(dropped)


@pytest.mark.slow
def test_the_depth_service_is_taken_over_twenty_times(tmp_path, free_endpoint, shared_dir):
    nodes = {
        "replay": {"data": str(shared_dir / "data" / "house_a" / "bag"), "loop": True},
        "localization": {"kind": "lidar"},
        "depth": {"source": "stixel"},
    }
    with System(tmp_path, free_endpoint, nodes, table=NODES) as system:
        ears, pictures = (
            TimedTopicListener(system.session, "depth/estimate"),
            TopicListener(system.session, "camera/image"),
        )
        healths = Healths(system, "depth")
        system.wait(lambda: len(ears.messages) > 20, 120)
        sentences = []
        for number in range(SWAPS):
            sentences.append(system.swap("depth", f"floor_known={'true' if number % 2 else 'false'}"))
            count = len(ears.messages)
            system.wait(lambda count=count: len(ears.messages) > count + 10)
        stamps, taken = ears.stamps(), set(pictures.stamps())
    report("depth", ears, sentences)
    within = {s for s in taken if stamps[0] <= s <= stamps[-1]}
    print(f"{len(within - set(stamps))} of {len(within)} pictures have no estimate; "
          f"{healths.overtaken()} were overtaken, in standby or not")  # fmt: skip
    assert len(set(ears.epochs)) == SWAPS + 1
    assert stamps == sorted(set(stamps)), "a stamp came twice, or late"
    assert not any("are lost" in sentence for sentence in sentences)


@pytest.mark.slow
def test_the_mapper_is_taken_over_twenty_times_and_its_session_goes_along(tmp_path, free_endpoint):
    nodes = {
        "replay": {"kind": "room", "pictures": 4000},
        "localization": {"kind": "known"},
        "fusion": {"kind": "true"},
        "keyframes": {"distance_m": 0.15},
        "mapping": {"session": str(tmp_path / "session"), "half_steps": 4, "full_steps": 3, "tick_steps": 2},
    }
    with System(tmp_path / "state", free_endpoint, nodes, table=TABLE) as system:
        sent, status = (
            TopicListener(system.session, "keyframes/frame"),
            TimedTopicListener(system.session, "mapping/status"),
        )
        acks, previews = (
            TopicListener(system.session, "keyframes/ack"),
            TopicListener(system.session, "mapping/preview"),
        )
        system.wait(lambda: len(status.messages) > 3, 120)
        sentences = []
        for number in range(SWAPS):
            sentences.append(system.swap("mapping", f"half_steps={4 + number % 2}"))
            count = len(status.messages)
            system.wait(lambda count=count: len(status.messages) > count + 3, 60)
        upto = len(sent.messages)
        system.wait(lambda: {m.id for m in sent.messages[:upto]} <= set(acks.ids()), 60)
        keyframes = system.board.records["keyframes"].health.detail
        count = len(status.messages)
    report("mapping", status, sentences)
    print(f"{len(set(sent.ids()))} keyframes sent, {len(acks.messages)} answers; keyframes says: {keyframes}")
    assert len(set(status.epochs)) == SWAPS + 1
    for name, ears in {"status": status, "answer": acks, "preview": previews}.items():
        assert len(ears.stamps()) == len(set(ears.stamps())), f"a {name} came twice"
    assert len(sent.ids()) == len(set(sent.ids())), "a keyframe had to be sent again"
    mapped = [m.keyframes for m in status.messages if m.status == "ok"]
    # Those that a successor takes from the disk, acknowledged before their turn came, have no status of their own.
    assert mapped == sorted(set(mapped)), "the map has forgotten a keyframe"
    last = next(m for m in reversed(status.messages) if m.status == "ok")
    before = {m.id for m in sent.messages if m.stamp_ns <= last.stamp_ns}
    assert last.keyframes == len(before), "a keyframe was lost on the way"
    assert {m.id for m in sent.messages[:upto]} <= set(acks.ids())
    assert "dropped" not in keyframes


@pytest.mark.slow
def test_a_mapper_without_a_session_cannot_be_taken_over_and_says_why(tmp_path, free_endpoint):
    nodes = {"replay": {"kind": "room", "pictures": 400}, "mapping": {}}
    with System(tmp_path, free_endpoint, nodes, table=TABLE) as system:
        system.wait(lambda: "mapping" in system.board.records, 60)
        with pytest.raises(UserError, match=r"mapping.session.*--cold"):
            system.swap("mapping", "half_steps=5")
        with pytest.raises(UserError, match=r"mapping.session.*--cold"):
            system.swap("mapping", f"session={tmp_path / 'other'}")
