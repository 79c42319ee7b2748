"""Fixtures of the tests of the 3D viewer in a browser."""

import pytest

from tests.services.page.browser import DESK, browser
from tests.web.map_server import MapServer


@pytest.fixture(scope="module")
def chromium():
    with browser() as it:
        yield it


@pytest.fixture
def server():
    with MapServer() as it:
        yield it


@pytest.fixture
def opened(chromium, server):
    """Return open(address, size): a page whose faults and foreign requests fail the test at its end.

    It is closed before the server.
    """
    pages = []

    def open_(address, size=DESK, **options):
        context = chromium.new_context(viewport=size, **options)
        page = context.new_page()
        page.faults = []
        page.on("console", lambda m: page.faults.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: page.faults.append(str(e)))
        page.on("request", lambda r: page.requests.append(r.url))
        page.requests = []
        page.goto(address)
        pages.append((context, page, address))
        return page

    yield open_
    for context, page, address in pages:
        foreign = [url for url in page.requests if not url.startswith((address.rsplit("/", 1)[0], "blob:"))]
        faults = list(page.faults)
        context.close()
        assert foreign == []
        assert faults == []
