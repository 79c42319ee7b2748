"""The command `simulate`: options, errors and output."""

import json

import typer
from typer.testing import CliRunner

from beamsplat.tools.cli.simulate import simulate

app = typer.Typer()
app.command()(simulate)
runner = CliRunner()


def test_help_shows_examples():
    result = runner.invoke(app, ["--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    assert "--lidar-only --laps" in result.output


def test_bad_values_name_the_option_and_exit_with_2(tmp_path):
    for option, value in (
        ("--size", "640"),
        ("--size", "9x9"),
        ("--distortion", "1,2"),
        ("--extrinsic-xyz-m", "a,b,c"),
    ):
        result = runner.invoke(app, ["--out", str(tmp_path / "r"), option, value], env={"COLUMNS": "200"})
        assert result.exit_code == 2
        assert option in result.output
    assert not (tmp_path / "r").exists()


def test_a_robot_that_is_unknown_or_has_another_camera_is_refused(tmp_path):
    for options, why in (
        (["--robot", "roomba"], "turtlebot4, rosmaster_x3, ugv_ld19, jetrover_g4"),
        (["--robot", "turtlebot4", "--size", "640x480"], "leave out --size"),
        (["--robot", "turtlebot4", "--distortion", "0.1,0,0,0,0"], "leave out --size"),
    ):
        result = runner.invoke(app, ["--out", str(tmp_path / "r"), *options], env={"COLUMNS": "200"})
        assert result.exit_code == 2
        assert why in result.output
    assert not (tmp_path / "r").exists()


def test_an_existing_folder_is_refused_with_2(tmp_path):
    result = runner.invoke(app, ["--out", str(tmp_path)], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert "--force" in result.output


def test_a_recording_is_summarised_as_json(scene_file, own_cache, tmp_path):
    options = [
        "--out",
        str(tmp_path / "r"),
        "--scene",
        str(scene_file),
        "--seed",
        "3",
        "--seconds",
        "2",
        "--lidar-only",
    ]
    result = runner.invoke(app, [*options, "--json"])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["scans"] == 19
    assert summary["images"] == 0
    assert (tmp_path / "r" / "bag" / "metadata.yaml").exists()
