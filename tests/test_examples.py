"""The examples run and do what they say; they are the documentation of the public API."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import beamsplat
from beamsplat.common.messages import LidarModel, Rig
from beamsplat.common.runtime.node import SourceItem
from tests.common.nodes import SensorSource

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


class CalibratedDrive(SensorSource):
    """The drive of the runners' tests, with a calibration."""

    outputs = ("rig", *SensorSource.outputs)

    def source(self):
        lidar = LidarModel(T_body_lidar=np.eye(4))
        yield SourceItem(1_000_000_000, "rig", Rig(stamp_ns=1_000_000_000, lidar=lidar))
        yield from super().source()


def _example(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_public_name_can_be_imported():
    assert {name for name in beamsplat.__all__ if getattr(beamsplat, name) is None} == set()
    assert set(beamsplat.__all__) <= set(dir(beamsplat))
    with pytest.raises(AttributeError, match="no attribute 'Slam'"):
        _ = beamsplat.Slam


def test_importing_the_package_is_fast_and_takes_no_heavy_module():
    code = "import sys, beamsplat; print(*sorted({'numpy', 'numba', 'cv2', 'zenoh', 'torch'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_lidar_slam_follows_the_truth_to_a_centimetre():
    assert _example("lidar_slam").main() < 0.01


def test_the_depth_of_a_corridor_is_right_to_two_centimetres():
    assert _example("depth").main() < 0.02


def test_the_map_shows_an_unseen_view(tmp_path):
    assert _example("gaussian_map").main(tmp_path / "wall.ply") > 26.0
    assert (tmp_path / "wall.ply").stat().st_size > 100_000


@pytest.fixture(scope="module")
def short_drive(tmp_path_factory):
    """Four seconds of scans, wheels and images as a recording of our own."""
    from rich.console import Console

    from beamsplat.common.config.deployment import Deployment
    from beamsplat.tools.system.offline import run_offline

    out = tmp_path_factory.mktemp("drive")
    nodes = {"replay": {"kind": f"{__name__}:CalibratedDrive", "images": False}}
    run_offline(Deployment(nodes=nodes), out, Console(quiet=True))
    return out / "messages"


def test_a_recording_is_read_as_messages(short_drive):
    counts = _example("read_recording").main(str(short_drive))
    assert counts["lidar/scan"] == 30
    assert counts["wheel/odometry"] == 150


def test_own_nodes_are_checked_and_run_by_a_deployment(short_drive, tmp_path):
    for arguments in (
        ("check", "own_nodes.toml", "--set", f"replay.data={short_drive}"),
        ("offline", "own_nodes.toml", "--data", short_drive, "--out", tmp_path / "out", "--json"),
    ):
        command = [sys.executable, "-m", "beamsplat", *map(str, arguments)]
        done = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert '"localization/odometry": 150' in done.stdout


def test_own_nodes_make_depth_of_a_real_drive(shared_dir, tmp_path):
    command = [
        sys.executable, "-m", "beamsplat", "offline", "own_nodes.toml", "--data",
        str(shared_dir / "data/house_a/bag"), "--set", "replay.duration_s=2", "--out", str(tmp_path), "--json",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, check=True)
    assert '"depth/estimate": 19' in done.stdout or '"depth/estimate": 20' in done.stdout
