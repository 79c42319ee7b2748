"""`--memory 1GB` is the mapper's budget."""

import pytest
from typer.testing import CliRunner

from beamsplat.common.config.deployment import load_deployment
from beamsplat.common.errors import UserError
from beamsplat.tools.cli.main import app
from beamsplat.tools.cli.memory_option import memory_overrides


@pytest.mark.parametrize(
    ("text", "mb"),
    [("1GB", 1000.0), ("600MB", 600.0), ("1.5 gb", 1500.0), ("1GiB", 1073.74), (".5GB", 500.0)],
)
def test_sizes_as_people_say_them(text, mb, tmp_path):
    (tmp_path / "d.toml").write_text('robot = "r"\n[nodes.mapping]\nmemory_mb = 1.0\n')
    deployment = load_deployment(tmp_path / "d.toml", memory_overrides(text))
    assert deployment.nodes["mapping"]["memory_mb"] == pytest.approx(mb)
    assert memory_overrides(None) == ()


@pytest.mark.parametrize("text", ["1000", "GB", "1 TB", "-1GB", "1.2.3GB", ""])
def test_what_is_no_size_is_refused_with_an_example(text):
    with pytest.raises(UserError, match="for example 1GB"):
        memory_overrides(text)


@pytest.mark.parametrize("command", ["run", "demo"])
def test_commands_take_it(command):
    assert (
        "--memory"
        in CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200", "TERM": "dumb"}).output
    )
