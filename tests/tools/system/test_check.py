"""`beamsplat check` refuses what a deployment names and cannot be used, before anything starts."""

import pytest
from typer.testing import CliRunner

from beamsplat.common.config.deployment import Deployment
from beamsplat.tools.cli.main import app
from beamsplat.tools.system.assembly import faults, missing_resources


def fatal(**nodes):
    deployment = Deployment(nodes=nodes)
    assert [fault.text for fault in faults(deployment) if fault.fatal] == []
    return [fault.text for fault in missing_resources(deployment)]


@pytest.mark.parametrize(
    ("node", "options", "words"),
    [
        ("depth", {"source": "stixl"}, ("nodes.depth", "'stixl'", "did you mean 'stixel'", "fastdepth")),
        ("depth", {"options": {"colour": 3}}, ("nodes.depth", "'colour'", "max_depth_m")),
        ("depth", {"options": {"max_depth_m": "far"}}, ("nodes.depth", "max_depth_m = 'far'", "number")),
        ("depth", {"source": "recorded", "options": {"folder": "no/maps"}}, ("nodes.depth", "no/maps")),
        (
            "depth",
            {"source": "unidepth", "options": {"model": "no/net.onnx"}},
            ("nodes.depth", "no/net.onnx"),
        ),
        ("camera", {"rig": "no/rig.toml"}, ("nodes.camera", "rig = no/rig.toml", "beamsplat rig")),
        ("camera", {"kind": "none", "rig": "no/rig.toml"}, ("nodes.camera", "rig = no/rig.toml")),
        ("camera", {"source": "no/video.avi"}, ("nodes.camera", "source = 'no/video.avi'", "no such file")),
        ("ros2", {"rig": "no/rig.toml"}, ("nodes.ros2", "rig = no/rig.toml")),
        ("replay", {"data": ".", "rig": "no/rig.toml"}, ("nodes.replay", "rig = no/rig.toml")),
        ("localization", {"resume": "no/map"}, ("nodes.localization", "resume = no/map")),
        ("localization", {"save": "/dev/null/x"}, ("nodes.localization", "save = /dev/null/x", "is a file")),
        ("mapping", {"session": "/dev/null/x"}, ("nodes.mapping", "session = /dev/null/x", "is a file")),
        ("mapping", {"save": "/proc/x"}, ("nodes.mapping", "save = /proc/x")),
        ("recorder", {"out": "/dev/null/x"}, ("nodes.recorder", "out = /dev/null/x")),
        ("monitor", {"save": "/dev/null/x.rrd"}, ("nodes.monitor", "save = /dev/null/x.rrd")),
        ("page", {"certificate": "no.pem"}, ("nodes.page", "certificate = no.pem")),
    ],
)
def test_what_a_deployment_names_must_be_there(node, options, words, tmp_path, monkeypatch):
    if options.get("save") == "/proc/x":
        monkeypatch.setattr("os.access", lambda path, mode: False)  # the tests may run as root
    (text,) = fatal(**{node: options})
    for word in words:
        assert word in text


def test_devices_and_streams_may_be_connected_later():
    for source in ("0", "/dev/video7", "rtsp://camera/stream"):
        assert fatal(camera={"source": source}) == []


def test_missing_keys_of_a_link_to_another_host_are_named(tmp_path):
    uplink = {"uplink": {"edge": "tls/edge.local:7448"}}
    deployment = Deployment(role="robot", nodes=uplink, security={"keys": tmp_path / "keys"})
    (fault,) = missing_resources(deployment)
    assert f"security.keys = {tmp_path / 'keys'}: ca.pem is missing" in fault.text
    (fault,) = missing_resources(Deployment(nodes={}, router={"listen": ("tcp/0.0.0.0:7447",)}))
    assert "leaves this host unprotected" in fault.text
    assert missing_resources(deployment, ("localization",)) == []


def test_the_command_names_the_file_the_field_and_the_value(tmp_path):
    file = tmp_path / "d.toml"
    file.write_text('[nodes.depth]\nsource = "stixl"\n[nodes.camera]\nrig = "no/rig.toml"\n')
    done = CliRunner().invoke(app, ["check", str(file)])
    assert done.exit_code == 2
    assert f"{file}: nodes.depth: there is no depth source 'stixl'" in done.output
    assert f"{file}: nodes.camera: rig = no/rig.toml" in done.output
