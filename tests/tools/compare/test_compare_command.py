"""The commands `compare` and `eval compare`: options and what they refuse."""

import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.tools.cli.main import app


@pytest.mark.parametrize("words", [["compare"], ["eval", "compare"]])
def test_help_shows_an_example(words):
    done = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "200"})
    assert done.exit_code == 0
    assert f"beamsplat {' '.join(words)} " in done.output


def test_sessions_without_a_robot_half_are_refused(tmp_path):
    for name in "ab":
        SessionFolder(tmp_path / name).create()
    words = ["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "out")]
    with pytest.raises(UserError, match=r"a: has no robot half \(lidar map\)"):
        CliRunner().invoke(app, words, catch_exceptions=False)
    assert not (tmp_path / "out").exists()


def test_only_generated_homes_are_rearranged(tmp_path):
    for options in (["--site", "office", "--lidar-only"], ["--scene", __file__]):
        words = ["simulate", "--out", str(tmp_path / "r"), "--moved", "2", *options]
        done = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
        assert done.exit_code == 2
        assert "changes a generated home" in done.output
