"""One router for all tests of this folder; each test uses a robot name of its own."""

import itertools

import pytest

from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from tests.conftest import free_port

_numbers = itertools.count()


@pytest.fixture(scope="package")
def router_endpoint():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router((endpoint,)):
        yield endpoint


@pytest.fixture
def robot():
    return f"test{next(_numbers)}"


@pytest.fixture
def make_bus(router_endpoint, robot):
    """Make buses of nodes of the test's robot, each with a session of its own."""
    made = []

    def make(node, epoch=1):
        instance = f"{len(made):016x}"
        made.append(Bus(open_session((router_endpoint,)), robot, node, instance, epoch))
        return made[-1]

    yield make
    for bus in made:
        bus.session.close()
