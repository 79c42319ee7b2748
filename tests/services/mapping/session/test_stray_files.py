"""Files in a session folder that the mapper did not write: it starts, saves, and leaves them alone."""

import pytest

from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.messages import Answer
from beamsplat.common.messages.codec import encode, schema_of
from tests.services.mapping.session.maps import feed, insert_waiting, make_node, message

STRAY = [
    "edge/state-old.npz", "edge/state-.npz", "edge/state-007.npz", "edge/state-\u0663.npz", "edge/state-1 (copy).npz",
    "edge/keyframes/old.kf", "edge/keyframes/007.kf", "edge/keyframes/-3.kf", "edge/keyframes/9" + "0" * 30 + ".kf",
    "edge/gaussians/copy.block", "edge/gaussians/007.block", "edge/notes.txt",
]  # fmt: skip
STRAY_FOLDERS = ["edge/state-9.npz", "edge/.git", "edge/keyframes/5.kf", "edge/keyframes/.cache"]


@pytest.fixture
def saved(tmp_path):
    """The folder of a session with four keyframes, saved."""
    node = make_node(tmp_path / "s", half_steps=1, full_steps=1)
    feed(node, range(4))
    node._session.save()
    node.close()
    return tmp_path / "s"


def test_stray_files_do_not_stop_the_mapper_and_stay(saved):
    for name in STRAY:
        (saved / name).write_text("stray")
    for name in STRAY_FOLDERS:
        (saved / name).mkdir()
    node = make_node(saved, session_every_s=1.0, half_steps=1, full_steps=1)
    feed(node, range(4, 7))
    assert node._session.status_text().startswith("saved at 7 keyframes")
    node.close()
    assert SessionFolder(saved).manifest()["keyframes"] == 7
    assert [name for name in STRAY if (saved / name).read_text() != "stray"] == []
    assert [name for name in STRAY_FOLDERS if not (saved / name).is_dir()] == []


def test_a_keyframe_file_that_holds_something_else_is_skipped_with_a_warning(saved, caplog):
    """A file with a valid checksum, but with another message, damaged bytes, or another keyframe."""
    folder, other = SessionFolder(saved), Answer(stamp_ns=1, text="")
    keyframe = message(5)
    folder.write_keyframe(11, schema_of(other), encode(other))
    folder.write_keyframe(12, schema_of(keyframe), b"no message")
    folder.write_keyframe(13, schema_of(keyframe), encode(keyframe))
    folder.write_keyframe(14, "Unknown/9.9", b"")
    node = insert_waiting(make_node(saved, half_steps=1, full_steps=1))
    assert sorted(node._mapper.keyframes) == [message(n).id for n in range(4)]
    node.close()
    for id in (11, 12, 13, 14):
        assert f"{id}.kf" in caplog.text
        assert (saved / "edge" / "keyframes" / f"{id}.kf").exists()


def test_a_known_keyframe_whose_file_holds_something_else_loses_only_itself(saved, caplog):
    folder, other = SessionFolder(saved), Answer(stamp_ns=1, text="")
    folder.write_keyframe(message(2).id, schema_of(other), encode(other))
    node = make_node(saved, half_steps=1, full_steps=1)
    assert sorted(node._mapper.keyframes) == [message(n).id for n in (0, 1, 3)]
    assert f"{message(2).id}.kf" in caplog.text
    feed(node, [6])
    assert len(node._mapper.keyframes) == 4
    node.close()
