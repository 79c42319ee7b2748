"""The files of the page: HTML, JavaScript, style and icon, by the path of their request."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

_FOLDER = Path(__file__).parent / "static"
_HTML, _SCRIPT = "text/html; charset=utf-8", "text/javascript; charset=utf-8"
_FILES = {
    "/": ("index.html", _HTML),
    "/page.js": ("page.js", _SCRIPT),
    "/map.js": ("map.js", _SCRIPT),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/view": ("viewer.html", _HTML),
    "/view.js": ("view.js", _SCRIPT),
    "/fleet": ("fleet.html", _HTML),
    "/fleet.js": ("fleet.js", _SCRIPT),
}
OF_FLEET = ("/fleet", "/fleet.js")  # the other files are also served for each robot
_LIVE, _SAVED = b'data-saved="false"', b'data-saved="true"'  # in viewer.html
_VIEWER_KINDS = {".js": _SCRIPT, ".css": "text/css; charset=utf-8", ".txt": "text/plain; charset=utf-8"}


class ViewerFile(NamedTuple):
    """A file of the built 3D viewer."""

    body: bytes
    kind: str  # content type
    tag: str  # identifies the content, for caches


def read_files(saved: bool = False) -> dict[str, tuple[bytes, str]]:
    """Return (content, content type) of each file by the path of its request.

    `saved`: the page /view shows a map that does not change.
    """
    files = {path: ((_FOLDER / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()}
    if saved:
        page, kind = files["/view"]
        files["/view"] = page.replace(_LIVE, _SAVED), kind
    return files


def read_viewer() -> dict[str, ViewerFile]:
    """Return the files of the 3D viewer by name; none if it has not been built (`make web`)."""
    out = {}
    for path in sorted((_FOLDER / "viewer").glob("*")):
        if path.suffix in _VIEWER_KINDS and path.is_file():
            body = path.read_bytes()
            out[path.name] = ViewerFile(
                body, _VIEWER_KINDS[path.suffix], f'"{hashlib.sha256(body).hexdigest()[:16]}"'
            )
    return out
