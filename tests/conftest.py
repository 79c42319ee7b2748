"""Fixtures that all tests share."""

import socket
from pathlib import Path

import pytest
from hypothesis import settings

# The first example compiles kernels, and the machine may be busy: no test is about time.
settings.register_profile("beamsplat", deadline=None)
settings.load_profile("beamsplat")


# Tests of whole systems, drivers and servers: they run alone, so that no process starves another.
LIVE = ("common/zenoh", "services/camera", "services/lidar", "services/monitor", "services/page", "services/ros2",
        "services/uplink", "tools/cli", "tools/keys", "tools/setup", "tools/system")  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that must not run in parallel with others."""
    here = Path(__file__).parent
    for item in items:
        folder = item.path.relative_to(here).parent.as_posix()
        if folder.startswith(LIVE) or "free_endpoint" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.live)


SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Recordings with truth and network weights, which the repository does not contain."""
    if not (SHARED / "data").is_dir():
        pytest.skip("needs the shared recordings, which are not part of the repository")
    return SHARED


def free_port() -> int:
    """A loopback port nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def free_endpoint() -> str:
    """A loopback endpoint nobody listens on."""
    return f"tcp/127.0.0.1:{free_port()}"
