"""`beamsplat offline`: the same recording gives the same bytes, on disk as in the hash."""

import hashlib
import json

import pytest
from rich.console import Console

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.messages.codec import encode
from beamsplat.common.recording import RecordingReader
from beamsplat.tools.system.offline import run_offline
from tests.common.nodes import TABLE
from tests.tools.cli.test_cli import ROOT, beamsplat

QUIET = Console(quiet=True)


def _run(tmp_path, name, **options):
    nodes = {"replay": {"kind": "drive", "seconds": 2.0}, "localization": {"kind": "slow", **options}}
    return run_offline(Deployment(nodes=nodes), tmp_path / name, QUIET, TABLE)


def test_twice_the_same_bytes_also_when_frames_are_dropped(tmp_path):
    first, second = (_run(tmp_path, name, step_cost_s=0.15) for name in ("a", "b"))
    assert first["sha256"] == second["sha256"]
    assert first["dropped"]["localization"]["camera/image"] > 30
    recordings = [sorted((tmp_path / n / "messages").iterdir()) for n in ("a", "b")]
    for a, b in zip(*recordings):
        assert hashlib.sha256(a.read_bytes()).digest() == hashlib.sha256(b.read_bytes()).digest(), a.name
    assert _run(tmp_path, "c")["sha256"] != first["sha256"]


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot create this folder"):
        _run(tmp_path / "file", "a")


def test_the_recording_holds_every_message(tmp_path):
    summary = _run(tmp_path, "a")
    assert json.loads((tmp_path / "a" / "summary.json").read_text()) == summary
    counts, payloads = {}, 0
    with RecordingReader(tmp_path / "a" / "messages") as reader:
        for item in reader.messages():
            counts[item.topic] = counts.get(item.topic, 0) + 1
            payloads += len(encode(item.message))
    assert counts == summary["topics"]
    assert payloads > 0


@pytest.mark.slow
def test_a_real_bag_twice_through_the_command(shared_dir, tmp_path):
    deployment = load_deployment(ROOT / "deploy/poses.toml", ("replay.data=x", "recorder.out=x"))
    assert "localization" in deployment.nodes
    bag = shared_dir / "data/redkitchen/bag"
    summaries = []
    for name in ("a", "b"):
        done = beamsplat("offline", "deploy/poses.toml", "--data", bag, "--out", tmp_path / name, "--json")
        assert done.returncode == 0, done.stderr
        summaries.append(json.loads(done.stdout))
    assert summaries[0]["sha256"] == summaries[1]["sha256"]
    assert summaries[0]["topics"]["camera/image"] == 200
    assert summaries[0]["topics"]["localization/odometry"] == 200
