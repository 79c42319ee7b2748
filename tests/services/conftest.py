from __future__ import annotations

from collections.abc import Iterator

import pytest

from beamsplat.common.zenoh.bus import open_router
from tests.conftest import free_port


@pytest.fixture(scope="module")
def router_endpoint() -> Iterator[str]:
    """The endpoint of a running router without access control."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router((endpoint,)):
        yield endpoint
