"""What all commands have in common: bounds of numbers, and an --out that can be written."""

import typing

import pytest
from typer.models import OptionInfo
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.tools.cli.main import app
from beamsplat.tools.cli.options import writable


def functions(typer_app):
    for command in typer_app.registered_commands:
        yield command.callback
    for group in typer_app.registered_groups:
        yield from functions(group.typer_instance)


def options(function):
    """(name, type, typer's OptionInfo) of each option."""
    for name, hint in typing.get_type_hints(function, include_extras=True).items():
        inner = [part for part in typing.get_args(hint) if typing.get_origin(part) is typing.Annotated]
        hint = inner[0] if inner else hint
        info = [item for item in getattr(hint, "__metadata__", ()) if isinstance(item, OptionInfo)]
        if info:
            yield name, hint.__origin__, info[0]


OPTIONS = [(f.__name__, *option) for f in functions(app) for option in options(f)]
NUMBERS = [row for row in OPTIONS if {float, int} & {row[2], *typing.get_args(row[2])}]
OUTS = [row for row in OPTIONS if row[1] == "out"]


@pytest.mark.parametrize(
    ("command", "name", "kind", "info"), NUMBERS, ids=[f"{r[0]}-{r[1]}" for r in NUMBERS]
)
def test_every_number_has_a_bound(command, name, kind, info):
    assert info.min is not None, f"{command} --{name} takes any negative number"


@pytest.mark.parametrize(("command", "name", "kind", "info"), OUTS, ids=[row[0] for row in OUTS])
def test_a_folder_that_cannot_be_written_is_refused_before_the_work_begins(command, name, kind, info):
    assert info.callback is writable


def test_the_tables_above_hold_what_they_should():
    assert len(NUMBERS) > 30
    assert {"demo", "simulate", "export", "slam", "offline"} <= {row[0] for row in OUTS}


def test_a_folder_without_permission_is_refused(tmp_path, monkeypatch):
    assert writable(tmp_path / "new" / "deep") == tmp_path / "new" / "deep"
    assert not (tmp_path / "new").exists()
    assert writable(None) is None
    with pytest.raises(UserError, match=r"--out = /dev/null/x: /dev/null is a file"):
        CliRunner().invoke(app, ["simulate", "--out", "/dev/null/x"], catch_exceptions=False)
    monkeypatch.setattr("os.access", lambda path, mode: False)  # the tests may run as root
    with pytest.raises(UserError, match=f"{tmp_path} cannot be written"):
        writable(tmp_path / "new")


@pytest.mark.parametrize(
    "arguments", [("demo", "--seconds", "-3"), ("demo", "--rate", "-1"), ("top", "x.toml", "--seconds", "-1")]
)
def test_a_number_out_of_bounds_is_refused(arguments):
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2
    assert "greater than or equal to" in done.output or "is not in the range" in done.output
