"""A restarted replay continues at the stored position, without a pause; the token bucket."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages import ExternalPose, Rig
from beamsplat.common.runtime.live import Live, LiveSettings
from beamsplat.common.runtime.node import Node, SourceItem
from beamsplat.common.runtime.pacing import TokenBucket
from beamsplat.common.topics import TOPICS

SECOND_NS = 1_000_000_000


class Player(Node):
    """Publishes the calibration, then 100 poses at 10 Hz."""

    name = "replay"
    outputs = ("rig", "external/pose")

    def source(self):
        yield SourceItem(SECOND_NS, "rig", Rig(stamp_ns=SECOND_NS))
        for i in range(100):
            pose = ExternalPose(stamp_ns=i, T_map_body=np.eye(4))
            yield SourceItem(SECOND_NS + i * SECOND_NS // 10, "external/pose", pose)


class FakePublication:
    """Collects the messages; stops the node at `last`."""

    def __init__(self, topic, live, sent, last):
        self.row = TOPICS[topic]
        self._live, self._sent, self._last = live, sent, last

    def put(self, message):
        self._sent.append((self.row.name, message.stamp_ns))
        if self.row.name == "external/pose" and message.stamp_ns == self._last:
            self._live.stop()


@pytest.fixture
def play(tmp_path):
    def run(*, resume, last=99, rate=0.0):
        sent = []
        live = Live(Player(Player.Config()), LiveSettings("r", (), tmp_path, rate=rate, resume=resume))
        live._position._PERIOD_S = 0.0
        live.running.publications = {name: FakePublication(name, live, sent, last) for name in Player.outputs}
        live._run_source()
        return sent, live

    return run


def test_a_restarted_replay_continues_without_a_pause(play):
    assert len(play(resume=False, last=49)[0]) == 51
    # In real time, 5 s pass between the calibration, which is published again, and the next pose.
    slept = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("beamsplat.common.runtime.live.time.sleep", slept.append)
        sent, _ = play(resume=True, last=50, rate=1.0)
    assert [stamp for topic, stamp in sent if topic == "external/pose"] == [50]
    assert sent[0][0] == "rig"
    assert slept == []
    assert play(resume=True, last=51)[0][-1] == (
        "external/pose",
        51,
    )  # the repeated calibration did not move the position


def test_a_new_run_starts_at_the_beginning(play, monkeypatch):
    live = play(resume=False, last=49)[1]

    def fails(endpoints, *rest, **options):
        raise UserError("no router")

    monkeypatch.setattr("beamsplat.common.runtime.live.open_session", fails)
    with pytest.raises(UserError):  # the new run ends before its first message
        Live(live.running.node, live.running.settings).run()
    assert ("external/pose", 1) in play(resume=True)[0]


def test_a_finished_replay_is_not_repeated(play):
    play(resume=False)[1]._position.finish()
    assert play(resume=True)[0] == [("rig", SECOND_NS)]


def test_a_token_bucket_allows_a_burst_and_then_its_rate():
    now = [0.0]
    bucket = TokenBucket(10.0, lambda: now[0])
    assert [bucket.take() for _ in range(25)].count(True) == 20
    now[0] = 1.05
    assert [bucket.take() for _ in range(25)].count(True) == 10
    now[0] = 100.0
    assert [bucket.take() for _ in range(25)].count(True) == 20
