"""The files of the page: HTML, JavaScript, style and icon, by the path of their request."""

from __future__ import annotations

from pathlib import Path

_FOLDER = Path(__file__).parent / "static"
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/fleet": ("fleet.html", "text/html; charset=utf-8"),
    "/fleet.js": ("fleet.js", "text/javascript; charset=utf-8"),
}
OF_FLEET = ("/fleet", "/fleet.js")  # the other files are also served for each robot


def read_files() -> dict[str, tuple[bytes, str]]:
    """Return (content, content type) of each file by the path of its request."""
    return {path: ((_FOLDER / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
