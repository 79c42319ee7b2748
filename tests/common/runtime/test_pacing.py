"""A restarted replay goes on where its predecessor died: neither earlier, nor later, nor after a pause."""

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
    """The calibration first, then 100 poses at 10 Hz."""

    name = "replay"
    outputs = ("rig", "external/pose")

    def source(self):
        yield SourceItem(SECOND_NS, "rig", Rig(stamp_ns=SECOND_NS))
        for i in range(100):
            pose = ExternalPose(stamp_ns=i, T_map_body=np.eye(4))
            yield SourceItem(SECOND_NS + i * SECOND_NS // 10, "external/pose", pose)


class FakePublication:
    """Keeps what is put; the node is stopped at `last`."""

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
        live._bookmark._PERIOD_S = 0.0
        live.running.publications = {name: FakePublication(name, live, sent, last) for name in Player.outputs}
        live._run_source()
        return sent, live

    return run


def test_it_goes_on_where_it_was_without_a_pause(play):
    assert len(play(resume=False, last=49)[0]) == 51
    # At the speed of the drive, 5 s lie between the calibration, said once more, and the next pose.
    slept = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("beamsplat.common.runtime.live.time.sleep", slept.append)
        sent, _ = play(resume=True, last=50, rate=1.0)
    assert [stamp for topic, stamp in sent if topic == "external/pose"] == [50]
    assert sent[0][0] == "rig"
    assert slept == []
    assert play(resume=True, last=51)[0][-1] == ("external/pose", 51)  # the calibration moved no bookmark


def test_a_new_run_forgets_the_place_of_an_earlier_one(play, monkeypatch):
    live = play(resume=False, last=49)[1]

    def dies(endpoints, *rest, **options):
        raise UserError("no router")

    monkeypatch.setattr("beamsplat.common.runtime.live.open_session", dies)
    with pytest.raises(UserError):  # the new run: killed before its first message
        Live(live.running.node, live.running.settings).run()
    assert ("external/pose", 1) in play(resume=True)[0]


def test_what_has_ended_is_not_played_again(play):
    play(resume=False)[1]._bookmark.finish()
    assert play(resume=True)[0] == [("rig", SECOND_NS)]


def test_an_allowance_lets_a_burst_through_and_then_its_rate():
    now = [0.0]
    allowance = TokenBucket(10.0, lambda: now[0])
    assert [allowance.take() for _ in range(25)].count(True) == 20
    now[0] = 1.05
    assert [allowance.take() for _ in range(25)].count(True) == 10
    now[0] = 100.0
    assert [allowance.take() for _ in range(25)].count(True) == 20
