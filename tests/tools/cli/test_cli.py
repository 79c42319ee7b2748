"""The command as a user meets it: exit codes, one clear sentence, help with examples."""

import subprocess
import sys
from pathlib import Path

import pytest

from beamsplat.tools.cli.doctor import congestion

ROOT = Path(__file__).resolve().parents[3]

POSES = ("--set", "replay.data=x", "--set", "recorder.out=x")


def beamsplat(*arguments, **kwargs):
    return subprocess.run(
        [sys.executable, "-m", "beamsplat", *map(str, arguments)],
        capture_output=True, text=True, timeout=120, cwd=ROOT, **kwargs,
    )  # fmt: skip


def test_help_names_every_command_and_each_has_an_example():
    from typer.testing import CliRunner

    from beamsplat.tools.cli.main import app

    shown = beamsplat("--help").stdout
    for command in app.registered_commands:
        name = command.name or command.callback.__name__.replace("_", "-")
        assert name in shown
        helped = CliRunner().invoke(app, [name, "--help"])
        assert helped.exit_code == 0
        assert "xample" in helped.output, f"{name} has no example"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("check", "no.toml"), "no.toml: no such deployment file"),
        (("check", "deploy/demo.toml", "--set", "replay.speed=2"), "unknown option 'speed'"),
        (
            ("check", "deploy/demo.toml", "--set", "router.port=1"),
            "unknown option 'router.port' (options are: connect,",
        ),
        (("check", "deploy/demo.toml", "--set", "replay.[/x]=1"), "unknown option '[/x]'"),
        (
            ("serve", "deploy/demo.toml", "router", "--set", 'router.listen=["no"]'),
            "no is not a Zenoh endpoint",
        ),
        (
            ("run", "deploy/poses.toml", *POSES, "router", "--set", "state_dir=/dev/null/x"),
            "cannot create this folder",
        ),
        (("run", "deploy/poses.toml", *POSES, "router", "nope"), "has no node 'nope'"),
        (("offline", "deploy/demo.toml", "--data", "no/bag", "--out", "{tmp}"), "no/bag"),
        (("info", "no/bag"), "no/bag"),
        (("rig", "no/bag", "--out", "{tmp}/rig.toml"), "no/bag"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(tmp_path, arguments, complaint):
    done = beamsplat(*(a.replace("{tmp}", str(tmp_path)) for a in arguments))
    assert done.returncode == 2, done.stderr
    assert complaint in done.stderr + done.stdout
    assert "Traceback" not in done.stderr


def test_missing_data_and_misspelt_nodes_are_named_before_anything_starts(tmp_path):
    for command in ("check", "run"):
        done = beamsplat(
            command, "deploy/demo.toml", "--set", "replay.data=nowhere", "--set", f"state_dir={tmp_path}"
        )
        assert done.returncode == 2
        assert done.stderr.count("nowhere: no such file or folder") == 1
    assert not list(tmp_path.iterdir())
    done = beamsplat("swap", "deploy/demo.toml", "detph", "--set", "source=stixel")
    assert "did you mean 'depth'?" in done.stderr
    done = beamsplat("session", "info", str(tmp_path / "none"))
    assert "no such folder" in done.stderr
    assert "Errno" not in done.stderr


def test_run_without_a_router_port_says_what_to_do(tmp_path, free_endpoint):
    from beamsplat.common.zenoh.bus import open_router

    with open_router((free_endpoint,)):
        done = beamsplat(
            "run", "deploy/poses.toml", "router", "--set", f'router.listen=["{free_endpoint}"]',
            "--set", f"state_dir={tmp_path}", "--set", "replay.data=x", "--set", "recorder.out=x",
        )  # fmt: skip
    assert done.returncode == 2
    assert "router" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir()), "a refused run created something"


def test_doctor_says_what_tcp_makes_of_a_bad_link():
    assert congestion("bbr").verdict == "ok"
    found = congestion("cubic")
    assert found.verdict == "note"
    assert "cubic" in found.text
    assert "tcp_congestion_control=bbr" in found.remedy


def test_doctor_names_a_taken_port(tmp_path, free_endpoint):
    import socket

    deployment = tmp_path / "d.toml"
    deployment.write_text(f'state_dir = "{tmp_path}"\n[router]\nlisten = ["{free_endpoint}"]\n')
    host, port = free_endpoint.removeprefix("tcp/").split(":")
    with socket.socket() as squatter:
        squatter.bind((host, int(port)))
        squatter.listen()
        taken = beamsplat(
            "doctor", deployment, "--brief", env={"PATH": "/usr/bin", "COLUMNS": "300", "HOME": str(tmp_path)}
        )
    assert taken.returncode == 1
    assert "cannot be listened on" in taken.stdout
    free = beamsplat("doctor", deployment, env={"PATH": "/usr/bin", "COLUMNS": "300", "HOME": str(tmp_path)})
    assert f"{free_endpoint} is free" in free.stdout


def test_keys_are_made_listed_and_taken_away(tmp_path):
    folder = tmp_path / "authority"

    def keys(*arguments):
        return beamsplat("keys", *arguments, "--authority", folder)

    assert "keys init" in keys("issue", "r1").stderr  # nothing there yet
    assert "keys issue edge" in keys("init").stdout
    assert "--address" in keys("issue", "edge", "--role", "edge").stderr
    assert keys("issue", "edge", "--role", "edge", "--address", "edge.local").returncode == 0
    assert str(folder / "hosts" / "r1") in keys("issue", "r1").stdout
    assert "lower case" in keys("issue", "R1/**").stderr
    assert (
        "Input should be 'robot', 'monitor', 'operator' or 'edge'"
        in keys("issue", "x", "--role", "king").stderr
    )
    listed = keys("list").stdout.splitlines()
    assert [line.split()[:4] for line in listed] == [
        ["edge", "edge", "robot", "*"],
        ["r1", "robot", "robot", "r1"],
    ]
    assert keys("remove", "r1").returncode == 0
    assert len(keys("list").stdout.splitlines()) == 1
    assert "[r1]" not in (folder / "hosts" / "edge" / "hosts.toml").read_text()
    assert "no host 'r1'" in keys("remove", "r1").stderr
