"""Received keyframes are on the mapper's disk before they are processed, also if the mapper is killed."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.messages import Tick
from beamsplat.common.messages.depth_codec import pack_mask
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.services.keyframes.node import KeyframesConfig, KeyframesNode
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.mapper import Mapper
from beamsplat.services.mapping.node import MappingNode
from beamsplat.services.mapping.session.checkpointer import Checkpointer
from beamsplat.services.mapping.session.inbox import Inbox
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, handle, insert_waiting, make_node, message


def arrive(node, keyframe):
    """Return the acknowledgements that are sent on arrival."""
    return [m.status for _, m in node.handle_arrival("keyframes/frame", keyframe)]


def ids(node):
    return sorted(node._mapper.keyframes)


def test_a_received_keyframe_is_acknowledged_once_and_survives_a_killed_mapper(tmp_path):
    node = make_node(tmp_path / "s")
    assert arrive(node, message(0)) == arrive(node, message(1)) == ["ok"]
    assert arrive(node, message(1)) == ["ok"]  # sent again before its turn
    sent = handle(node, "keyframes/frame", message(0))
    assert "keyframes/ack" not in sent
    node.close()  # as a killed process does: the lock ends
    again = insert_waiting(make_node(tmp_path / "s"))
    assert ids(again) == [message(0).id, message(1).id]
    assert arrive(again, message(1)) == ["ok"]
    again.close()


def test_a_keyframe_refused_later_is_answered_again_and_removed_from_disk(tmp_path):
    node = make_node(tmp_path / "s")
    everything_moves = pack_mask(np.zeros((r.HEIGHT, r.WIDTH), bool))
    empty = message(0).model_copy(update={"mask": everything_moves})
    assert arrive(node, empty) == ["ok"]
    (answer,) = handle(node, "keyframes/frame", empty)["keyframes/ack"]
    assert "mask leaves no pixel" in answer.status
    assert SessionFolder(tmp_path / "s").keyframe_ids() == []
    assert arrive(node, empty) == [answer.status]
    node.close()


def test_keyframes_dropped_by_the_mailbox_are_read_from_disk(tmp_path):
    node = make_node(tmp_path / "s")
    for number in range(5):
        arrive(node, message(number))
    handle(node, "keyframes/frame", message(3))  # 0 to 2 were dropped by the mailbox
    assert ids(node) == [message(3).id]
    sent = handle(node, "tick", Tick(stamp_ns=r.T0 + 9 * SECOND, count=1))
    assert ids(node) == [message(0).id, message(3).id]
    assert "keyframes/ack" not in {*sent, *(output[0] for output in node.drain())}  # all were answered
    assert ids(node) == [message(number).id for number in range(5)]
    node.close()


def test_a_keyframe_that_cannot_be_written_is_not_acknowledged(tmp_path):
    checkpointer = Checkpointer(tmp_path / "s", 10**9)
    inbox = Inbox(checkpointer)
    checkpointer.folder.keyframes.rmdir()
    checkpointer.folder.keyframes.write_text("no folder any more")
    assert not inbox.accept(1, False, lambda: ("s", b"x"))
    assert len(inbox) == 0
    assert not inbox.start(1)
    assert checkpointer.status_text(Mapper()).startswith("NOT SAVED")
    checkpointer.close()


def test_a_mapper_that_crashes_repeatedly_still_writes_a_checkpoint(tmp_path):
    folder = SessionFolder(tmp_path / "s")
    for number in range(4):
        node = make_node(tmp_path / "s", session_every_s=2.5)
        assert folder.manifest() is None
        arrive(node, message(number))
        handle(node, "keyframes/frame", message(number))
        node.close()
    assert folder.manifest()["keyframes"] == 1  # the last one; the others wait on the disk
    node = insert_waiting(make_node(tmp_path / "s"))
    assert ids(node) == [message(number).id for number in range(4)]
    node.close()


def test_a_hand_over_that_cannot_be_written_leaves_the_map_with_its_mapper(tmp_path):
    """What common/control.py does next: the mapper goes on as it was, and may hand over later."""
    node, edge = make_node(tmp_path / "s"), tmp_path / "s" / "edge"
    handle(node, "keyframes/frame", message(0))
    edge.rename(tmp_path / "away")
    edge.write_text("no folder any more")
    with pytest.raises(UserError, match="NOT SAVED"):
        node.hand_over()
    edge.unlink()
    (tmp_path / "away").rename(edge)
    with pytest.raises(UserError, match="uses this session"):
        SessionFolder(tmp_path / "s").lock()
    handle(node, "keyframes/frame", message(1))
    assert ids(node) == [message(0).id, message(1).id]
    node.hand_over()
    again = insert_waiting(make_node(tmp_path / "s"))
    assert ids(again) == [message(0).id, message(1).id]
    again.close()


def test_acknowledgements_do_not_wait_for_a_slow_mapper(tmp_path):
    """Three seconds a keyframe, one every quarter of a second: all are answered before the second is mapped."""
    heard = []
    mapper = MappingNode(
        MappingConfig(session=tmp_path / "s", half_steps=1, full_steps=0, tick_steps=0, step_cost_s=3.0)
    )
    Lockstep(
        [r.RoomDrive(r.DriveConfig(pictures=10)), r.Localizer(r.LocalizerConfig()), r.Fusion(r.Fusion.Config()),
         KeyframesNode(KeyframesConfig(distance_m=0.15)), mapper],
        lambda letter: heard.append((letter.topic, letter.message.stamp_ns)),
    ).run()  # fmt: skip
    sent = [stamp for topic, stamp in heard if topic == "keyframes/frame"]
    answered = [i for i, (topic, _) in enumerate(heard) if topic == "keyframes/ack"]
    mapped = [i for i, (topic, _) in enumerate(heard) if topic == "mapping/status"]
    assert len(set(sent)) == len(answered) == len(mapped) >= 4
    assert answered[-1] < mapped[1]
