"""Dockerfile and compose file: that what they name is there, and that their commands are ones we take."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from beamsplat.common.config.deployment import load_deployment

ROOT = Path(__file__).resolve().parents[3]
DOCKERFILE = (ROOT / "deploy" / "Dockerfile").read_text()
SERVICES = yaml.safe_load((ROOT / "deploy" / "compose.yaml").read_text())["services"]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


def test_all_that_is_copied_into_the_image_exists():
    copied = [
        name
        for line in re.findall(r"^COPY --chown=beamsplat (.+) \S+$", DOCKERFILE, re.M)
        for name in line.split()
    ]
    packages = re.search(r"^FOLDERS = \((.+)\)$", (ROOT / "setup.py").read_text(), re.M)
    needed = {*re.findall(r'"(\w+)"', packages[1]), "setup.py", "pyproject.toml", "constraints.txt"}
    assert needed <= set(copied)
    assert all((ROOT / name).exists() for name in copied)


def test_the_image_has_the_torch_of_make_setup():
    (version,) = re.findall(r"torch==([\d.]+)", DOCKERFILE)
    assert f"TORCH := torch=={version}\n" in (ROOT / "Makefile").read_text()


@pytest.mark.parametrize("name", list(SERVICES))
def test_a_service_builds_from_what_there_is_and_runs_what_is_mounted(name):
    service = SERVICES[name]
    build = service["build"]
    assert (
        ROOT / "deploy" / build["context"] / build["dockerfile"]
    ).resolve() == ROOT / "deploy" / "Dockerfile"
    arguments = build.get("args", {})
    assert set(arguments) <= set(re.findall(r"^ARG (\w+)", DOCKERFILE, re.M))
    assert arguments.get("EXTRA", "edge") in EXTRAS
    verb, file, *options = service["command"]
    assert verb == "run"
    mounts = dict(reversed(re.fullmatch(r"\$\{\w+:-(.+)\}:([^:]+)(?::ro)?", v).groups())
                  for v in service["volumes"] if v.startswith("$"))  # fmt: skip
    deployment = load_deployment(ROOT / "deploy" / mounts[file], tuple(options[1::2]))
    assert str(deployment.security.keys).replace("~", "/home/beamsplat") in mounts
    if deployment.role == "robot":
        inside = {device.rpartition(":")[2] for device in service["devices"]}
        assert deployment.nodes["lidar"]["device"] in inside
        assert f"/opt/beamsplat/{deployment.nodes['camera']['rig']}" in mounts
    else:
        assert deployment.nodes["mapping"]["session"].startswith("/state/")
