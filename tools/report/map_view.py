"""The 3D map inside a report: the viewer and the packed Gaussians in one HTML file, without any request."""

from __future__ import annotations

import base64
import json
import re
from html import escape
from typing import Any

import numpy as np

from beamsplat.common.mapfiles.detail import merge_by_cell
from beamsplat.common.messages.splat_codec import pack
from beamsplat.services.page.map3d.levelled_map import LevelledMap
from beamsplat.services.page.static_files import read_viewer
from beamsplat.tools.view.saved_map import pieces

MAX_REPORT_BYTES = 15_000_000  # of the whole file: it is sent by mail and opened on phones
_MARGIN_BYTES = 50_000  # for index and markup
# Edges of the cells in which Gaussians are merged until the map fits.
_CELLS_M = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.24, 0.32)
NOT_BUILT = (
    "<p>The 3D map is not in this report: its viewer is not built (`make web`). `beamsplat export MAP --to "
    "ply` writes the map for other viewers.</p>"
)
_START = """const box = document.getElementById("map3d");
try {
  const embedded = JSON.parse(document.getElementById("map3d-data").textContent);
  beamsplatViewer.openViewer(box, {base: "", saved: true, embedded});
} catch (error) { box.textContent = `The 3D map cannot be shown: ${error.message}`; }"""


def map_section(
    params: np.ndarray,  # float32 [14, N], z up
    path_m: np.ndarray,  # [K, >= 2] way of the robot in the same frame
    used_bytes: int,
) -> str:
    """Return the map as HTML with its own viewer, or why there is none.

    The Gaussians are merged in cells until the report has at most `MAX_REPORT_BYTES`.

    Args:
        used_bytes: size of the rest of the report.
    """
    viewer = read_viewer()
    if "viewer.js" not in viewer:
        return NOT_BUILT
    script = _inline_script(viewer["viewer.js"].body.decode())
    licences = viewer["licences.txt"].body.decode("utf-8", "replace") if "licences.txt" in viewer else ""
    rest = used_bytes + len(script.encode()) + len(escape(licences).encode()) + _MARGIN_BYTES
    fitted = _fitted(params, path_m, MAX_REPORT_BYTES - rest)
    if fitted is None:
        return "<p>The 3D map is not in this report: its pictures leave no room for it.</p>"
    data, count, cell_m = fitted
    merged = f", merged in cells of {100 * cell_m:g} cm for this file" if cell_m else ""
    parts = [
        '<h2>The map in 3D</h2><div id="map3d" style="position:relative;height:min(70vh,640px)"></div>',
        f"<p>{count} Gaussians{merged}. Drag to turn, scroll to zoom.</p>",
        f"<script type='module'>{script}</script>",
        f"<script type='application/json' id='map3d-data'>{data}</script>",
        f"<script type='module'>{_START}</script>",
    ]
    if licences:
        parts.append(
            f"<details><summary>Licences of the viewer</summary><pre>{escape(licences)}</pre></details>"
        )
    return "".join(parts)


def _inline_script(source: str) -> str:
    """Return JavaScript that may stand between script tags: nothing in it ends the element."""
    return re.sub(r"<(/script|!--)", lambda found: f"<\\{found[1]}", source, flags=re.IGNORECASE)


def _fitted(params: np.ndarray, path_m: np.ndarray, budget_bytes: int) -> tuple[str, int, float] | None:
    """Return the data of the viewer as JSON of at most `budget_bytes`, with the number of Gaussians and the
    cell (m); None if even the largest cell needs more."""
    for cell_m in _CELLS_M:
        merged = merge_by_cell(params, cell_m)
        data = embedded_map(merged, path_m)
        text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
        if len(text) <= budget_bytes:
            return text, merged.shape[1], cell_m
    return None


def embedded_map(params: np.ndarray, path_m: np.ndarray) -> dict[str, Any]:
    """Return a map as the viewer takes it without a server: index of `/map3d` and packed Gaussians."""
    map_ = LevelledMap(2**40, "report")
    for number, piece in enumerate(pieces(params)):
        map_.put(number, 1, np.eye(4), 0.0, pack(piece).tobytes())
    return {
        "producer": map_.producer, "revision": 1, "saved": True, "note": "", "editable": False,
        "chunks": map_.index(), "keyframes": [], "camera": None,
        "limited": {"coarsened": 0, "left_out": 0, "budget_mb": 0},
        "path": np.round(100.0 * np.asarray(path_m)[:, :2]).astype(int).ravel().tolist(),
        "data": {str(a): base64.b64encode(packed).decode() for a, packed in map_.finest().items()},
    }  # fmt: skip
