"""The wheel: one package, typed, with its data; a base install that works from an empty directory."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from a clean export of the working tree's last commit."""
    folder = tmp_path_factory.mktemp("wheel")
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=False)
    if archive.returncode:
        pytest.skip("not a git checkout")
    subprocess.run(["tar", "-x", "-C", folder], input=archive.stdout, check=True)
    _run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder / "dist", folder)
    (found,) = (folder / "dist").glob("*.whl")
    return found


def _run(*command, cwd=None, ok=(0,), **environment):
    """Run a command in which nothing of the checkout can be imported."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd or "/", capture_output=True, text=True, timeout=1800, check=False,
        env=clean | environment,
    )  # fmt: skip
    assert done.returncode in ok, f"{command}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done


@pytest.mark.slow
def test_it_holds_one_package_and_its_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].partition("-")[0] for name in names} == {"beamsplat"}
    data = {
        "beamsplat/py.typed", "beamsplat/deploy/demo.toml", "beamsplat/deploy/models.toml",
        "beamsplat/deploy/paper/monogs-lidar.toml", "beamsplat/services/page/static/page.js",
        "beamsplat/common/raster/cuda/raster.cu",
    }  # fmt: skip
    assert data <= set(names)
    assert not [name for name in names if name.startswith("beamsplat/tools/api/")]


@pytest.mark.slow
def test_it_holds_the_3d_viewer_with_its_licences(tmp_path):
    built = ROOT / "services" / "page" / "static" / "viewer"
    if not (built / "viewer.js").exists():
        pytest.skip("needs the built 3D viewer: make web")
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True)
    subprocess.run(["tar", "-x", "-C", tmp_path], input=archive.stdout, check=True)
    shutil.copytree(built, tmp_path / "services" / "page" / "static" / "viewer")
    _run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path / "dist", tmp_path)
    (found,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(found) as files:
        folder = "beamsplat/services/page/static/viewer/"
        assert files.read(folder + "viewer.js") == (built / "viewer.js").read_bytes()
        assert "Permission is hereby granted" in files.read(folder + "licences.txt").decode()  # three.js: MIT


@pytest.fixture(scope="module")
def base_install(wheel, tmp_path_factory):
    """(interpreter, empty directory) of an environment with the wheel and no extras."""
    folder = tmp_path_factory.mktemp("base")
    _run(sys.executable, "-m", "venv", folder / "venv")
    python = folder / "venv" / "bin" / "python"
    _run(python, "-m", "pip", "install", "-q", wheel)
    (folder / "empty").mkdir()
    return python, folder / "empty"


@pytest.mark.slow
def test_a_base_install_works_from_an_empty_directory(base_install):
    python, empty = base_install
    beamsplat = python.with_name("beamsplat")
    environment = {"XDG_STATE_HOME": str(empty / "state"), "XDG_DATA_HOME": str(empty / "data")}
    assert "ModuleNotFoundError" in _run(python, "-c", "import common", cwd=empty, ok=(1,)).stderr
    assert "Run a system" in _run(beamsplat, "--help", cwd=empty, **environment).stdout
    assert "unidepth" in _run(beamsplat, "models", "list", cwd=empty, **environment).stdout
    _run(beamsplat, "doctor", cwd=empty, ok=(0, 2), **environment)
    refused = _run(beamsplat, "check", "deploy/demo.toml", cwd=empty, ok=(2,), **environment)
    assert "replay.data" in refused.stderr or "data" in refused.stderr
    for command in (("simulate", "--out", "drive", "--seconds", "10"), ("demo", "--seconds", "10")):
        done = _run(beamsplat, *command, cwd=empty, ok=(2,), **environment)
        assert "pip install 'beamsplat[" in " ".join(done.stderr.split())
        assert "Traceback" not in done.stderr
    code = "import beamsplat, numpy as np; beamsplat.LidarSlam(beamsplat.LidarSlamSettings(), np.eye(4))"
    _run(python, "-c", code, cwd=empty, **environment)


@pytest.mark.slow
def test_the_demo_runs_with_the_extras_that_it_names(base_install, wheel):
    python, empty = base_install
    _run(python, "-m", "pip", "install", "-q", f"{wheel}[demo]")
    environment = {"XDG_STATE_HOME": str(empty / "state"), "BEAMSPLAT_CACHE": str(empty / "cache")}
    beamsplat = python.with_name("beamsplat")
    _run(beamsplat, "simulate", "--out", "drive", "--seconds", "10", cwd=empty, **environment)
    _run(beamsplat, "demo", "--data", "drive/bag", "--out", "demo", cwd=empty, **environment)
    for name in ("report.html", "map/splats.ply", "trajectory.tum", "session/session.json"):
        assert (empty / "demo" / name).is_file(), name
