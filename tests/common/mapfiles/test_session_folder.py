"""A session folder that nothing was written into is not left behind."""

from beamsplat.common.mapfiles.session import SessionFolder


def opened(path):
    folder = SessionFolder(path)
    folder.create()
    folder.lock()
    return folder


def test_a_session_that_has_remained_empty_is_removed(tmp_path):
    opened(tmp_path / "s").unlock()
    assert not (tmp_path / "s").exists()


def test_a_session_with_a_keyframe_or_a_robot_half_or_of_another_run_stays(tmp_path):
    folder = opened(tmp_path / "a")
    (folder.keyframes / "1.kf").write_bytes(b"x")
    folder.unlock()
    assert folder.exists()
    folder = opened(tmp_path / "b")
    folder.robot.mkdir()
    folder.unlock()
    assert folder.exists()
    folder = opened(tmp_path / "c")
    (folder.edge / "edge.json").write_text("{}")
    folder.unlock()
    assert folder.exists()
    (folder.edge / "edge.json").unlink()
    opened(tmp_path / "c").unlock()  # created by an earlier run
    assert folder.exists()
