"""Deployment files: overrides, and rejection of invalid files with file, field and value in the error."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.config.base import parse
from beamsplat.common.config.deployment import NodeConfig, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.registry import make_node
from beamsplat.services.nodes import NODES


def _file(tmp_path, text):
    path = tmp_path / "robot.toml"
    path.write_text(text)
    return path


def test_load_deployment_applies_overrides(tmp_path):
    path = _file(
        tmp_path, 'robot = "r2"\n[nodes.replay]\ndata = "bag"\n[router]\nlisten = ["tcp/127.0.0.1:1"]\n'
    )
    deployment = load_deployment(
        path, ("replay.data=other bag", "replay.rate=2.5", "rate=4", 'router.listen=["tcp/[::1]:9"]')
    )
    assert deployment.robot == "r2"
    assert deployment.rate == 4.0
    assert deployment.router.listen == ("tcp/[::1]:9",)
    assert deployment.nodes["replay"] == {"data": "other bag", "rate": 2.5}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot = ", "not a TOML file"),
        ('robott = "x"', r"unknown option 'robott' \(options are: .*robot"),
        ('robot = "A B"', "robot = 'A B'"),
        ("rate = -1", r"rate = -1: .*greater than or equal to 0"),
        ("[nodes]\nreplay = 3", r"nodes.replay = 3"),
    ],
)
def test_invalid_files_raise_errors_with_field_and_value(tmp_path, text, message):
    with pytest.raises(UserError, match=message) as caught:
        load_deployment(_file(tmp_path, text))
    assert "robot.toml" in str(caught.value)


def test_missing_file_raises_user_error(tmp_path):
    with pytest.raises(UserError, match=r"none\.toml: no such deployment file"):
        load_deployment(tmp_path / "none.toml")


@pytest.mark.parametrize("override", ["replay.data", "=3", "a..b=1", "robot.x=1"])
def test_invalid_overrides_raise_user_error(tmp_path, override):
    with pytest.raises(UserError, match="--set"):
        load_deployment(_file(tmp_path, 'robot = "r"'), (override,))


@given(st.text(max_size=40))
def test_any_override_text_is_accepted_or_raises_user_error(tmp_path_factory, text):
    path = _file(tmp_path_factory.mktemp("c"), "")
    with contextlib.suppress(UserError):
        load_deployment(path, (text,))


def test_unknown_and_invalid_node_options_raise_user_error():
    with pytest.raises(UserError, match="node 'x': unknown option 'stepcost'"):
        parse(NodeConfig, {"stepcost": 1}, "node 'x'")
    with pytest.raises(UserError, match="threads = 0"):
        parse(NodeConfig, {"threads": 0}, "node 'x'")


@pytest.mark.parametrize(
    ("override", "hint"),
    [
        ("camera.source=9", """--set 'camera.source="9"'"""),
        ("camera.source=true", """--set 'camera.source="true"'"""),
        ("camera.rig=7", """--set 'camera.rig="7"'"""),
        ("recorder.without=tick", """--set 'recorder.without=["tick"]'"""),
    ],
)
def test_a_value_of_another_type_is_told_how_to_be_quoted(tmp_path, override, hint):
    (tmp_path / "d.toml").write_text("[nodes.camera]\n[nodes.recorder]\n")
    deployment = load_deployment(tmp_path / "d.toml", (override,))
    node = override.partition(".")[0]
    with pytest.raises(UserError) as refused:
        make_node(NODES[node], deployment.nodes[node], "d.toml")
    assert hint in str(refused.value)
    repaired = load_deployment(tmp_path / "d.toml", (hint.removeprefix("--set ").strip("'"),))
    make_node(NODES[node], repaired.nodes[node], "d.toml")


def test_the_hint_also_names_options_of_the_deployment_itself(tmp_path):
    (tmp_path / "d.toml").write_text("")
    with pytest.raises(UserError, match="""--set 'robot="9"'"""):
        load_deployment(tmp_path / "d.toml", ("robot=9",))
