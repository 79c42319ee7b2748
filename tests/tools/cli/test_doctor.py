"""What the doctor says of a deployment, and that it is true."""

import platform
import subprocess
import sys

import pytest

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.tools.cli import doctor


@pytest.fixture
def no_network(monkeypatch):
    """Without the checks of ports and devices."""
    for name in ("_router", "_devices"):
        monkeypatch.setattr(doctor, name, lambda deployment: iter(()))


def texts(deployment, verdict):
    return [finding.text for finding in doctor.examine(deployment) if finding.verdict == verdict]


def test_a_missing_rig_and_missing_keys_of_the_deployment_are_faults(tmp_path, no_network):
    file = tmp_path / "robot.toml"
    file.write_text(
        f'role = "robot"\nstate_dir = "{tmp_path}"\n[security]\nkeys = "{tmp_path}/keys"\n'
        '[nodes.camera]\nrig = "no/rig.toml"\n[nodes.uplink]\nedge = "tls/edge.local:7448"\n'
    )
    found = " ".join(texts(load_deployment(file), "fault"))
    assert "nodes.camera: rig = no/rig.toml" in found
    assert f"{tmp_path}/keys: ca.pem is missing" in found


def test_an_option_that_is_given_on_the_command_line_is_no_fault(tmp_path, no_network):
    deployment = Deployment(state_dir=tmp_path, nodes={"replay": {}, "depth": {"source": "stixl"}})
    assert any("option 'data' is required" in text for text in texts(deployment, "note"))
    assert any("'stixl'" in text for text in texts(deployment, "fault"))


def test_mapping_needs_neither_torch_nor_a_gpu_and_the_doctor_says_so(monkeypatch):
    monkeypatch.setattr(doctor, "_has_nvidia", lambda: False)
    monkeypatch.setattr(doctor, "cuda_obstacle", lambda: "there is no NVIDIA driver (libcuda.so.1)")
    (finding,) = doctor._gpu()
    assert (finding.subject, finding.verdict) == ("mapper", "ok")
    assert finding.text.startswith("on the CPU")
    monkeypatch.setattr(doctor, "_has_nvidia", lambda: True)
    on_cpu, why = doctor._gpu()
    assert (on_cpu.verdict, why.subject, why.verdict) == ("ok", "GPU", "note")
    assert "libcuda" in why.text
    code = (
        "import sys; sys.modules.update(torch=None, trimesh=None, embreex=None)\n"
        "from beamsplat.services.nodes import NODES; NODES['mapping'].load('default')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_version_is_one_line():
    from typer.testing import CliRunner

    from beamsplat.tools.cli.main import app

    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0
    assert done.output.count("\n") == 1
    assert done.output.startswith("beamsplat 0")
    assert f"Python {platform.python_version()}" in done.output
