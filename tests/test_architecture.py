"""The import rules of the repository, checked on the syntax trees."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(p for folder in ("common", "services", "tools") for p in ROOT.glob(f"{folder}/**/*.py"))
MODULES = {
    "beamsplat." + p.relative_to(ROOT).as_posix().removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    for p in SOURCES
}  # fmt: skip
MAX_LINES = 500

# Files of a service that may know messages, the bus and configuration. All others are libraries.
SHELLS = {
    "node.py", "config.py", "messages.py", "intake.py", "live_session.py", "open.py",
    "outputs.py", "query_handlers.py",  # parts of a large node
}  # fmt: skip
SHELL_ONLY = (
    "zenoh", "beamsplat.common.zenoh", "beamsplat.common.runtime", "beamsplat.common.messages",
    "beamsplat.common.topics", "beamsplat.common.config.deployment",
)  # fmt: skip
# Of these packages, what is free of messages, bus and runners.
LIBRARY_ALLOWED = (
    "beamsplat.common.runtime.stamp_merger", "beamsplat.common.runtime.rate_limited_log",
    "beamsplat.common.runtime.health", "beamsplat.common.runtime.alerts", "beamsplat.common.runtime.figures",
    "beamsplat.common.messages.image_codec", "beamsplat.common.messages.splat_codec",
    "beamsplat.common.messages.depth_codec", "beamsplat.common.messages.depth_png",
    "beamsplat.common.messages.image_header", "beamsplat.common.zenoh.rmw",
)  # fmt: skip


def _imports(path: Path) -> set[str]:
    """Dotted names that a file imports; a name that is itself a module stands without its package."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names
            if not names <= MODULES:
                found.add(str(node.module))
    return found


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Path relative to the repository -> dotted names that the file imports."""
    return {p.relative_to(ROOT).as_posix(): _imports(p) for p in SOURCES}


def _within(name: str, packages: tuple[str, ...]) -> bool:
    return any(f"{name}.".startswith(f"{package}.") for package in packages)


def test_imports_run_one_way(imports):
    """`common` <- `services` <- `tools`; no service imports another one; nothing imports the tests."""
    above = {
        "common": ("beamsplat.services", "beamsplat.tools"),
        "services": ("beamsplat.tools",),
        "tools": (),
    }
    wrong = []
    for path, names in imports.items():
        folder, service = path.split("/")[:2]
        for name in names:
            if _within(name, (*above[folder], "tests", "common", "services", "tools")):
                wrong.append(f"{path} imports {name}")
            parts = name.split(".")
            if folder == "services" and name.startswith("beamsplat.services.") and parts[2] != service:
                wrong.append(f"{path} imports another service: {name}")
    assert not wrong


def test_only_bench_commands_use_the_benchmarks(imports):
    """What a user's command and a benchmark share is in `tools/report` or `tools/evaluation`."""
    allowed = ("tools/bench/", "tools/cli/bench.py", "tools/cli/bench_endurance.py", "tools/cli/bench_mapping.py",
               "tools/cli/bench_geometry.py", "tools/cli/depth.py")  # fmt: skip
    wrong = [
        f"{path} imports {name}"
        for path, names in imports.items()
        if not path.startswith(allowed)
        for name in names
        if _within(name, ("beamsplat.tools.bench",))
    ]
    assert not wrong


def test_libraries_of_services_know_no_bus(imports):
    wrong = [
        f"{path} imports {name}"
        for path, names in imports.items()
        if path.startswith("services/") and path.count("/") > 1 and Path(path).name not in SHELLS
        for name in names
        if _within(name, SHELL_ONLY) and not _within(name, LIBRARY_ALLOWED)
        and name != "beamsplat.common.messages"
    ]  # fmt: skip
    assert not wrong


def test_there_are_no_import_cycles(imports):
    """Imports under `TYPE_CHECKING` and inside functions count too: two files that need each other are one."""
    modules = {
        "beamsplat." + path.removesuffix(".py").removesuffix("/__init__").replace("/", "."): names
        for path, names in imports.items()
    }
    graph = {module: {n for n in names if n in modules and n != module} for module, names in modules.items()}
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join([*trail[trail.index(module) :], module])
        if module not in done:
            for name in sorted(graph[module]):
                visit(name, (*trail, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def test_files_have_a_length_that_can_be_reviewed():
    lengths = {p.relative_to(ROOT).as_posix(): len(p.read_text().splitlines()) for p in SOURCES}
    assert not {path: n for path, n in lengths.items() if n > MAX_LINES}


def test_the_services_folder_holds_one_folder_per_process():
    from beamsplat.services.nodes import NODES

    folders = {p.name for p in (ROOT / "services").iterdir() if (p / "__init__.py").is_file()}
    assert folders == set(NODES)
    assert {p.name for p in (ROOT / "services").glob("*.py")} == {"__init__.py", "nodes.py"}


def test_heavy_imports_stay_out_of_the_command_line():
    """`beamsplat --help` must not wait for torch, numba, rerun or the simulator."""
    heavy = {"torch", "numba", "rerun", "trimesh", "embreex", "onnxruntime", "cv2", "scipy", "rosbags"}
    for path in ROOT.glob("tools/cli/*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {str(node.module).split(".")[0]}
            else:
                continue
            assert not names & heavy, f"{path.name} imports {names & heavy} at the top"


def test_no_two_public_classes_share_a_name():
    found: dict[str, list[str]] = {}
    for path in SOURCES:
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(path.relative_to(ROOT).as_posix())
    assert not {name: paths for name, paths in found.items() if len(paths) > 1}


def test_every_compiled_function_uses_the_kernel_decorator():
    """Its cache notices changed helpers; `numba.njit` alone would run old machine code."""
    allowed = {"common/compiled.py", "common/raster/simd_memory.py"}
    users = {p.relative_to(ROOT).as_posix() for p in SOURCES if "njit" in p.read_text()}
    assert users <= allowed
