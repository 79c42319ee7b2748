"""A headless browser for tests.

`python -m tests.services.page.browser ADDRESS OUT.png` makes the screenshot in docs/ from a running page.
"""

import contextlib
import os
import shutil
import sys

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PHONE = {"width": 390, "height": 844}
# WebGL without a GPU, for the 3D map.
SOFTWARE_GL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
DESK = {"width": 1280, "height": 1150}


@contextlib.contextmanager
def browser():
    """Start the machine's Chromium; skip the test if there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install -e '.[dev]'")
    if CHROMIUM is None:
        pytest.skip("needs a browser: apt-get install chromium")
    sandbox = ["--no-sandbox"] if os.getuid() == 0 else []  # Chromium has no sandbox for root
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=sandbox + SOFTWARE_GL)
        try:
            yield chromium
        finally:
            chromium.close()


def main(address, out):
    """Save a screenshot of the page a few seconds after it was opened."""
    with browser() as chromium:
        page = chromium.new_page(viewport=DESK, device_scale_factor=1)
        page.goto(address)
        page.wait_for_selector('[data-picture="render"] img[data-number]', timeout=60_000)
        page.wait_for_timeout(5_000)
        page.screenshot(path=out)


if __name__ == "__main__":
    main(*sys.argv[1:])
