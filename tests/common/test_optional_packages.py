"""A package that is not installed is named with the command that installs it."""

import subprocess
import sys

import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.optional_packages import missing_packages_explained, remedy_for
from beamsplat.services.nodes import NODES


@pytest.mark.parametrize(
    ("module", "remedy"),
    [
        ("torch", "pip install 'beamsplat[gpu]'"),
        ("torch.cuda", "pip install 'beamsplat[gpu]'"),
        ("trimesh", "pip install 'beamsplat[sim]'"),
        ("embreex.rtcore_scene", "pip install 'beamsplat[sim]'"),
        ("beamsplat.common.absent", None),
        ("nobody_requires_this", None),
    ],
)
def test_the_remedy_names_the_extra(module, remedy):
    assert remedy_for(module) == remedy


def test_the_remedy_follows_the_metadata_for_the_monitor():
    assert remedy_for("rerun").startswith("pip install '")


def test_only_packages_of_ours_are_explained():
    explained = missing_packages_explained("bench")
    with pytest.raises(UserError, match=r"bench needs the package torch, .*beamsplat.gpu."), explained:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")
    with pytest.raises(ModuleNotFoundError), missing_packages_explained():
        raise ModuleNotFoundError("No module named 'absent'", name="absent")


def test_a_node_whose_package_is_missing_says_so(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("beamsplat.services.monitor")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError, match=r"nodes.monitor \(rerun\) needs the package rerun"):
        NODES["monitor"].load("rerun")


@pytest.mark.parametrize("command", ["demo", "simulate"])
def test_a_base_install_is_told_the_extra_and_gets_no_folder(tmp_path, command):
    blocked = "import sys; sys.modules.update(embreex=None, trimesh=None)\n"
    code = blocked + "from beamsplat.tools.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, command, "--out", str(tmp_path / "out"), "--seconds", "2"],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "pip install 'beamsplat[sim]'" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
