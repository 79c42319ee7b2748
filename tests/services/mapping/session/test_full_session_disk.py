"""A mapper starts with its session on a full or read-only disk, and saves as soon as the disk has room."""

import pytest

from beamsplat.common.mapfiles.session import SessionFolder
from tests.common.files.small_disk import SmallDisk
from tests.services.mapping.session.maps import feed, handle, make_node, message


@pytest.fixture
def disk(tmp_path):
    disk = SmallDisk(tmp_path / "disk", 8)
    yield disk
    disk.close()


@pytest.mark.parametrize("fault", ["full", "read-only"])
@pytest.mark.parametrize("before", ["no session", "a session"])
def test_a_mapper_starts_without_room_and_saves_later(disk, fault, before):
    path, old = disk.path / "s", [] if before == "no session" else [0, 1]
    if old:
        node = make_node(path, half_steps=1, full_steps=1)
        feed(node, old)
        list(node.drain())
        node.close()
    if fault == "full":
        disk.fill()
    else:
        disk.set_read_only(True)
    node = make_node(path, half_steps=1, full_steps=1)
    assert sorted(node._mapper.keyframes) == [message(number).id for number in old]
    sent = handle(node, "keyframes/frame", message(3))
    assert "keyframes/ack" not in sent  # the robot keeps it
    assert "NOT SAVED" in sent["mapping/status"][0].session
    if fault == "full":
        disk.free()
    else:
        disk.set_read_only(False)
    assert handle(node, "keyframes/frame", message(3))["keyframes/ack"][0].status == "ok"
    list(node.drain())
    node.close()
    folder = SessionFolder(path)
    assert folder.manifest()["keyframes"] == len(old) + 1
    assert folder.keyframe_ids() == [message(number).id for number in [*old, 3]]
