"""Hand-over: no stamp is published twice, and what neither process published is counted as lost."""

import numpy as np
import pytest

from beamsplat.common.messages import Odometry
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.handover import Handover, parse_progress
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from tests.common.nodes import Sink
from tests.common.tiles import tile


def grid(stamp_ns):
    return tile(stamp_ns, np.zeros((1, 1), np.int8))


def published(handover, topic, stamps):
    """Return the stamps that are not held back."""
    return [stamp for stamp in stamps if not handover.holds_back(topic, grid(stamp))]


def activated(handover, after):
    return [(topic, message.stamp_ns) for topic, message in handover.activate(parse_progress(after))]


def test_a_successor_continues_where_its_predecessor_ended():
    old, new = Handover(standby=False), Handover(standby=True)
    first = published(old, "a", range(5))
    assert published(new, "a", range(2, 8)) == []
    assert (old.reached(), new.reached()) == ('{"a": 4}', '{"a": 7}')
    after = old.retire()
    assert published(old, "a", [9]) == []
    assert first + [stamp for _, stamp in activated(new, after)] == list(range(8))
    assert published(new, "a", [8]) == [8]
    assert new.lost == 0


def test_a_slow_successor_does_not_repeat_what_its_predecessor_published():
    new = Handover(standby=True)
    new.holds_back("a", grid(1))
    assert activated(new, '{"said": {"a": 5}}') == []
    assert published(new, "a", range(2, 9)) == [6, 7, 8]
    assert published(new, "b", [2]) == [2]
    assert new.retire() == '{"said": {"a": 8, "b": 2}}'


def test_a_topic_on_which_the_predecessor_published_nothing_is_published_from_the_start():
    new = Handover(standby=True)
    new.holds_back("b", grid(3))
    after = Handover(standby=False).retire()
    assert after == '{"said": {}}'
    assert activated(new, after) == [("b", 3)]


def test_of_more_than_sixteen_held_messages_the_oldest_are_dropped_and_counted_as_lost():
    new = Handover(standby=True)
    published(new, "a", range(20))
    assert activated(new, '{"said": {"a": 1}}') == [("a", stamp) for stamp in range(4, 20)]
    assert new.lost == 2  # 2 and 3: the predecessor published 0 and 1


def test_the_limit_of_sixteen_is_for_all_topics_together():
    new = Handover(standby=True)
    for stamp in range(10):
        published(new, "a", [stamp])
        published(new, "b", [stamp])
    assert len(activated(new, '{"said": {"a": 1}}')) == 16
    assert new.lost == 2  # 0 and 1 on b


@pytest.mark.parametrize(
    "answer", ["not JSON", "[]", "3", '{"said": 3}', '{"handled": []}', '{"said": {"a": "b"}}']
)
def test_activation_with_anything_but_the_answer_of_retire_fails_and_changes_nothing(answer):
    new = Handover(standby=True)
    new.holds_back("a", grid(7))
    with pytest.raises(ValueError):
        activated(new, answer)
    assert new.standby
    assert activated(new, '{"said": {}}') == [("a", 7)]


def envelope(sequence, instance="a" * 16):
    odometry = Odometry(stamp_ns=sequence, T_odom_body=np.eye(4), covariance=np.eye(3))
    header = Header(sequence, 0, 0, sequence, 1, "localization", instance)
    return Envelope("localization/odometry", header, odometry)


def test_inputs_that_the_predecessor_handled_are_known_by_sequence_number():
    mailbox = Mailbox(Sink)
    for sequence in (0, 1, 2, 5):
        mailbox.put(envelope(sequence))
    for name in ("localization/correction", "localization/grid"):
        mailbox.end(name, None)
    assert mailbox.pop().header.sequence == 0
    old, new = Handover(standby=False), Handover(standby=True)
    activated(new, old.retire(mailbox.handled()))
    # 1, 2 and 5 are queued, 3 and 4 are missing: they may arrive yet.
    assert [s for s in range(8) if not new.was_handled(envelope(s))] == [1, 2, 3, 4, 5, 6, 7]
    assert not new.was_handled(envelope(0, "b" * 16))
