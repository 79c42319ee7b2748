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


def test_the_budget_of_gpu_memory_is_an_option_of_its_own(tmp_path):
    (tmp_path / "d.toml").write_text('robot = "r"\n[nodes.mapping]\n')
    options = load_deployment(tmp_path / "d.toml", memory_overrides("1GB", "2GB")).nodes["mapping"]
    assert options == {"memory_mb": 1000.0, "gpu_memory_mb": 2000.0}
    with pytest.raises(UserError, match="--gpu-memory '2': expected a number and MB or GB"):
        memory_overrides(None, "2")


@pytest.mark.parametrize("text", ["1000", "GB", "1 TB", "-1GB", "1.2.3GB", ""])
def test_what_is_no_size_is_refused_with_an_example(text):
    with pytest.raises(UserError, match="for example 1GB"):
        memory_overrides(text)


@pytest.mark.parametrize("command", ["run", "demo"])
def test_commands_take_it(command):
    output = CliRunner().invoke(app, [command, "--help"], env={"COLUMNS": "200", "TERM": "dumb"}).output
    assert "--memory" in output
    assert "--gpu-memory" in output
