"""Opening of pages in the user's browser."""

from __future__ import annotations

import os
import sys
import webbrowser
from typing import Annotated

import typer

BrowserOption = Annotated[
    bool, typer.Option(" /--no-browser", help="Do not open a browser (none is opened without a display)")
]


def open_in_browser(address: str) -> bool:
    """Open an address in the user's browser; return False if there is no display, or no browser."""
    display = sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return display and webbrowser.open(address)
