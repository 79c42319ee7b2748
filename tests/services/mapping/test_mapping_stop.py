"""The end of a mapper by a signal: in the middle of its work, of its start, and with keyframes that wait."""

import threading

import pytest

from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.runtime.live import Live
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Job, StopRequested
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.mapper import HALF
from beamsplat.services.mapping.node import MappingNode
from tests.common.polling import wait_until
from tests.services.mapping.session.maps import feed, insert_waiting, make_node, message

ENDLESS = 100_000  # steps: hours


@pytest.fixture
def saved(tmp_path):
    """The folder of a session with four keyframes in its checkpoint, and three newer ones."""
    node = make_node(tmp_path / "s", half_steps=1, full_steps=1, session_every_s=1e6)
    feed(node, range(4))
    node._session.save()
    feed(node, range(4, 7))
    node.close()
    return tmp_path / "s"


def test_optimisation_ends_between_two_steps_and_the_map_is_saved(tmp_path):
    node = make_node(tmp_path / "s", half_steps=1, full_steps=1)
    feed(node, range(2))
    node._mapper.must_stop = lambda: node._mapper.steps >= 20
    node.must_stop = node._mapper.must_stop
    node.config = node.config.model_copy(update={"half_steps": ENDLESS, "full_steps": ENDLESS})
    sent = feed(node, [2])
    assert node._mapper.steps == 20
    assert [ack.status for ack in sent["keyframes/ack"]] == ["ok"]
    assert node._mapper.refine(ENDLESS, HALF) == 0.0
    outputs = list(node.drain())
    assert [type(output) for output in outputs] == [Job]  # nothing is published
    list(node.handle_job("checkpoint", outputs[0].run()))
    node.close()
    assert SessionFolder(tmp_path / "s").manifest()["steps"] == 20


def test_keyframes_that_wait_when_the_process_must_stop_stay_on_disk(tmp_path):
    node = make_node(tmp_path / "s", half_steps=1, full_steps=1)
    feed(node, range(2))
    for number in range(2, 8):
        assert [ack.status for _, ack in node.on_arrival("keyframes/frame", message(number))] == ["ok"]
    steps = node._mapper.steps
    node.must_stop = lambda: True
    for job in node.drain():
        list(node.handle_job("checkpoint", job.run()))
    assert node._mapper.steps == steps
    node.close()
    again = insert_waiting(make_node(tmp_path / "s", half_steps=1, full_steps=1))
    assert sorted(again._mapper.keyframes) == [message(n).id for n in range(8)]
    again.close()


@pytest.mark.parametrize("calls", [0, 1, 3])
def test_a_stop_while_the_session_is_opened_changes_nothing_in_it(saved, calls):
    """After some keyframes of the checkpoint."""
    before = SessionFolder(saved).manifest()
    node = MappingNode(MappingConfig(session=saved))
    asked = []
    node.must_stop = lambda: len(asked) >= calls or asked.append(1)
    with pytest.raises(StopRequested):
        node.configure()
    assert "resuming: keyframe" in node.detail
    node.close()
    assert SessionFolder(saved).manifest() == before
    assert len(insert_waiting(make_node(saved, half_steps=1, full_steps=1))._mapper.keyframes) == 7


def test_a_resumed_mapper_decodes_a_keyframe_when_it_needs_it(saved):
    node = insert_waiting(make_node(saved, half_steps=1, full_steps=1, session_every_s=1e6))
    node._session.save()
    node.close()
    again = make_node(saved, half_steps=1, full_steps=1)
    assert [k.levels.decoded for k in again._mapper.keyframes.values()] == [False] * 7
    again._mapper.refine(2)
    assert sum(k.levels.decoded for k in again._mapper.keyframes.values()) == 2
    again._session.save()
    assert sum(k.levels.decoded for k in again._mapper.keyframes.values()) == 2
    again.close()


def test_a_resumed_mapper_works_before_it_has_inserted_what_is_newer_than_its_checkpoint(saved):
    """A backlog of hours on disk delays neither new keyframes nor the state "active"; sent again, it is known."""
    node = make_node(saved, half_steps=10, full_steps=10)
    assert len(node._mapper.keyframes) == 4
    sent = feed(node, [7, 5])
    assert [ack.id for ack in sent["keyframes/ack"]] == [message(7).id]
    assert sorted(node._mapper.keyframes) == [message(n).id for n in (0, 1, 2, 3, 5, 7)]
    insert_waiting(node)
    assert sorted(node._mapper.keyframes) == [message(n).id for n in range(8)]
    node.close()


def test_a_live_mapper_in_endless_work_ends_after_a_signal(tmp_path, free_endpoint):
    """On a real router; the keyframe arrives on the bus, and its optimisation would take hours."""
    folder = tmp_path / "s"
    node = MappingNode(MappingConfig(session=folder, half_steps=ENDLESS))
    with open_router((free_endpoint,)):
        alone = frozenset({"localization/anchors", "tick"})
        live = Live(node, LiveSettings("test", (free_endpoint,), tmp_path / "run", without_producer=alone))
        thread = threading.Thread(target=live.run, daemon=True)
        thread.start()
        wait_until(lambda: live.running.state == "active", 60.0)
        with Bus(open_session((free_endpoint,)), "test", "keyframes", "ab" * 8, 1) as bus:
            publication = bus.publish("keyframes/frame")
            wait_until(lambda: (publication.put(message(0)), node._mapper.steps > 2)[1], 60.0)
            live.stop()
            thread.join(60.0)
    assert not thread.is_alive()
    assert SessionFolder(folder).manifest()["keyframes"] == 1
    assert 2 < SessionFolder(folder).manifest()["steps"] < ENDLESS
