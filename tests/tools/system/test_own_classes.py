"""Nodes and depth sources of somebody's own module, named in a deployment as "module:Class"."""

import subprocess
import sys
import textwrap

import pytest

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError
from beamsplat.services.depth.source import make_source
from beamsplat.tools.system.assembly import build_node, faults

MODULE = """
    import numpy as np
    from beamsplat.common.config.deployment import NodeConfig
    from beamsplat.common.runtime.node import Node
    from beamsplat.services.depth.source import Estimate

    class Config(NodeConfig):
        gain: float = 1.0

    class MyDepth(Node):
        name = "depth"
        Config = Config
        inputs = ("camera/image",)
        outputs = ("depth/estimate",)
        def on_camera_image(self, message):
            return iter(())

    class Wheels(Node):
        name = "wheels"
        outputs = ("wheel/odometry",)

    class Listener(Node):
        name = "listener"
        inputs = ("wheel/odometry",)
        def on_wheel_odometry(self, message):
            return iter(())

    class MySource:
        uses_beams = True
        def __init__(self, depth_m: float = 2.0):
            self.depth_m = depth_m
        def estimate(self, view):
            return Estimate(np.full(view.camera.shape, self.depth_m, np.float32), "metric")

    class NoNode:
        pass
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """The name of a module in the working directory."""
    name = f"own_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{name}.py").write_text(textwrap.dedent(MODULE))
    (tmp_path / f"{name}_broken.py").write_text("import numpy\nx = 1 / 0\n")
    (tmp_path / f"{name}_wrong.py").write_text(
        "from beamsplat.common.runtime.node import Node\n"
        'class Wrong(Node):\n    name = "ghost"\n    outputs = ("lidar/scan",)\n'
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    return name


def test_a_class_of_ones_own_replaces_a_shipped_service(module):
    deployment = Deployment(nodes={"depth": {"kind": f"{module}:MyDepth", "gain": 2.0}})
    node = build_node(deployment, "depth")
    assert type(node).__name__ == "MyDepth"
    assert node.config.gain == 2.0
    assert [fault for fault in faults(deployment) if fault.fatal] == []


def test_a_node_that_no_service_has_the_name_of_runs_if_its_class_declares_it(module):
    nodes = {"wheels": {"kind": f"{module}:Wheels"}, "listener": {"kind": f"{module}:Listener"}}
    assert faults(Deployment(nodes=nodes)) == []


@pytest.mark.parametrize(
    ("name", "kind", "complaint"),
    [
        ("ghost", "", "no such service"),
        ("wheelz", "{}:Wheels", "declares name = 'wheels', expected 'wheelz'"),
        ("depth", "{}:Absent", "has no class 'Absent'"),
        ("depth", "{}:NoNode", "does not derive from"),
        ("depth", "{}_absent:X", "there is no module"),
        ("depth", "{}_broken:X", "ZeroDivisionError: division by zero"),
        ("depth", "{}_broken:X", "_broken.py, line 2"),
        ("ghost", "{}_wrong:Wrong", "publishes lidar/scan, whose producers are"),
        ("depth", "not a module:X", "expected 'module:Class'"),
        ("operator", "{}:Wheels", "reserved"),
    ],
)
def test_a_class_that_cannot_be_the_node_is_refused_in_one_sentence(module, name, kind, complaint):
    options = {"kind": kind.format(module)} if kind else {}
    (fault,) = faults(Deployment(nodes={name: options}))
    assert complaint in fault.text
    assert f"nodes.{name}" in fault.text


def test_a_depth_source_of_ones_own_is_made_with_its_options(module):
    assert make_source(f"{module}:MySource", {"depth_m": 3.0}).depth_m == 3.0
    node = build_node(Deployment(nodes={"depth": {"source": f"{module}:MySource"}}), "depth")
    node.check_resources()
    node.configure()
    assert node._needs_beams
    with pytest.raises(UserError, match="depth_m = 'far'"):
        make_source(f"{module}:MySource", {"depth_m": "far"})
    with pytest.raises(UserError, match="unexpected keyword argument 'colour'"):
        make_source(f"{module}:MySource", {"colour": 3})
    with pytest.raises(UserError, match="no method estimate"):
        make_source(f"{module}:NoNode")


def test_the_command_finds_a_module_in_the_working_directory(module, tmp_path):
    (tmp_path / "d.toml").write_text(
        f'[nodes.wheels]\nkind = "{module}:Wheels"\n[nodes.listener]\nkind = "{module}:Listener"\n'
    )
    command = (
        "import sys; sys.path = [p for p in sys.path if p]; from beamsplat.tools.cli.main import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", command, "check", "d.toml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "2 nodes" in done.stdout
