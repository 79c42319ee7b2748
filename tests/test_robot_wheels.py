"""What a robot installs exists for its processor: wheels for 64-bit Arm (Raspberry Pi 4 and 5, Jetson)."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Up to glibc 2.36, which Raspberry Pi OS 12 has; JetPack 6 has 2.35, JetPack 5 has 2.31.
_GLIBC_MINORS = (17, *range(24, 37))


def wheels(python):
    """Wheel file names by package: all that `pip install beamsplat` would bring to such a machine."""
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    platforms = ["manylinux2014_aarch64", *(f"manylinux_2_{minor}_aarch64" for minor in _GLIBC_MINORS)]
    result = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--target", "unused",
         "--only-binary=:all:", "--implementation", "cp", "--python-version", python, "--report", "-",
         "-c", str(ROOT / "constraints.txt"), *(f"--platform={p}" for p in platforms), *dependencies],
        capture_output=True, text=True, timeout=300, cwd=ROOT,
    )  # fmt: skip
    if result.returncode:
        return result.stderr
    items = json.loads(result.stdout)["install"]
    return {i["metadata"]["name"].lower(): i["download_info"]["url"].rpartition("/")[2] for i in items}


@pytest.mark.slow
@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
def test_everything_a_robot_needs_has_a_wheel_for_arm(python):
    found = wheels(python)
    if isinstance(found, str) and "NewConnectionError" in found:
        pytest.skip("needs a package registry")
    assert isinstance(found, dict), found
    built = {name: file for name, file in found.items() if not file.endswith("-none-any.whl")}
    assert {"eclipse-zenoh", "numba", "onnxruntime", "opencv-python-headless", "rerun-sdk"} <= set(built)
    assert all("aarch64" in file for file in built.values()), built
    assert "torch" not in found, "a robot needs none"
    print(f"Python {python}: {len(found)} packages, built for aarch64: {', '.join(sorted(built.values()))}")
