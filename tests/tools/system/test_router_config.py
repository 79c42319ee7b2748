"""What is written for others to run: a router's configuration for zenohd, a unit for systemd."""

import shutil
import subprocess
import time
from pathlib import Path

import pytest
import zenoh

from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.cli.system import router_config

ROOT = Path(__file__).resolve().parents[3]


def test_a_router_from_the_printed_configuration_routes(tmp_path, free_endpoint, capsys):
    router_config(ROOT / "deploy/demo.toml", [f'router.listen=["{free_endpoint}"]'])
    file = tmp_path / "router.json5"
    file.write_text(capsys.readouterr().out)
    config = zenoh.Config.from_file(str(file))
    with zenoh.open(config), open_session((free_endpoint,)) as a, open_session((free_endpoint,)) as b:
        heard = []
        b.declare_subscriber("beamsplat/demo/x", lambda sample: heard.append(sample.payload.to_bytes()))
        deadline = time.monotonic() + 10.0
        while not heard and time.monotonic() < deadline:
            a.put("beamsplat/demo/x", b"hello")
            time.sleep(0.05)
        assert heard[0] == b"hello"
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("mode") == '"router"'


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_unit_is_one_that_systemd_takes(tmp_path):
    text = (ROOT / "deploy/systemd/beamsplat@.service").read_text()
    unit = tmp_path / "beamsplat@robot.service"
    unit.write_text(
        text.replace("/opt/beamsplat/.venv/bin/beamsplat", shutil.which("true")).replace(
            "/opt/beamsplat", "/"
        )
    )
    done = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, timeout=60
    )
    mine = [line for line in done.stderr.splitlines() if "beamsplat@" in line]
    assert mine == []
    bad = tmp_path / "beamsplat@bad.service"
    bad.write_text(unit.read_text().replace("KillMode=mixed", "KillMode=sometimes"))
    done = subprocess.run(["systemd-analyze", "verify", str(bad)], capture_output=True, text=True, timeout=60)
    assert "kill mode" in done.stderr.lower()  # it does look
