"""The rules of the house, read from the syntax trees."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted([*ROOT.glob("common/**/*.py"), *ROOT.glob("services/**/*.py")])
MAX_LINES = 320

# Files of a service that may know messages, the bus and the command line. All others are libraries.
SHELLS = {"node.py", "config.py", "messages.py", "cli.py", "__main__.py"}
SHELL_ONLY = ("zenoh", "common.bus", "common.streams", "common.queries", "common.live", "common.lockstep",
              "common.topics", "common.messages", "common.map_messages", "common.sensor_models", "common.node", "common.config", "common.registry")  # fmt: skip
NOT_A_SERVICE = {"bench", "evaluation"}  # they measure the whole house


def _imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


def _service(path: Path) -> str | None:
    parts = path.relative_to(ROOT).parts
    return parts[1] if parts[0] == "services" and len(parts) > 2 and parts[1] not in NOT_A_SERVICE else None


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_run_one_way(path):
    for name in _imports(path):
        if path.is_relative_to(ROOT / "common"):
            assert not name.startswith("services"), f"common must not know services: {name}"
        assert not name.startswith("tests"), name
        service = _service(path)
        if service and path.name != "cli.py" and name.startswith("services."):
            assert name.split(".")[1] == service, f"services must not import each other: {name}"


@pytest.mark.parametrize(
    "path",
    [p for p in SOURCES if _service(p) and p.name not in SHELLS],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_libraries_know_no_bus(path):
    for name in _imports(path):
        for forbidden in SHELL_ONLY:
            assert not f"{name}.".startswith(f"{forbidden}."), f"a library imports {name}"


def test_no_file_is_long():
    long = {
        str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text().splitlines())) > MAX_LINES
    }
    assert not long


def test_heavy_imports_stay_out_of_the_command_line():
    """`beamsplat --help` must not wait for torch, numba, rerun or the simulator."""
    heavy = {"torch", "numba", "rerun", "trimesh", "embreex", "onnxruntime", "cv2", "scipy", "rosbags"}
    for path in [*ROOT.glob("services/*.py"), *ROOT.glob("services/*/cli.py")]:
        tree = ast.parse(path.read_text())
        for node in tree.body:
            if isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {node.module.split(".")[0]}
            else:
                continue
            assert not names & heavy, f"{path.name} imports {names & heavy} at the top"
