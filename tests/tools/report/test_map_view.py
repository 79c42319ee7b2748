"""The map inside a report: complete data, bounded size, nothing that ends the script or loads from elsewhere."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from beamsplat.common.messages.splat_codec import unpack
from beamsplat.services.page import static_files
from beamsplat.tools.report import map_view
from beamsplat.tools.report.map_view import NOT_BUILT, map_section
from tests.services.page.test_levelled_map import gaussians

PATH = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]])
BUNDLE = 'const a = "</script><!-- x", b = /<\\/script>/; globalThis.beamsplatViewer = {openViewer() {}};'


class Scripts(HTMLParser):
    """Collects the content of the script elements, and what is loaded from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.found, self.loads, self._inside = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag == "script":
            self.found.append((dict(attributes)["type"], ""))
            self._inside = True
        self.loads += [v for k, v in attributes if k in ("src", "href") and not v.startswith("data:")]

    def handle_endtag(self, tag):
        self._inside = False

    def handle_data(self, data):
        if self._inside:
            self.found[-1] = (self.found[-1][0], self.found[-1][1] + data)


@pytest.fixture
def built(tmp_path, monkeypatch):
    """A page whose viewer is this text: the real one is made by npm."""
    (tmp_path / "viewer").mkdir()
    (tmp_path / "viewer" / "viewer.js").write_text(BUNDLE)
    (tmp_path / "viewer" / "licences.txt").write_text("MIT <c>")
    monkeypatch.setattr(static_files, "_FOLDER", tmp_path)


def test_the_viewer_gets_all_gaussians_and_the_path_without_a_request(built):
    params = gaussians(5000)
    scripts = Scripts(map_section(params, PATH, 0))
    assert [kind for kind, _ in scripts.found] == ["module", "application/json", "module"]
    assert scripts.loads == []
    assert "beamsplatViewer = {openViewer" in scripts.found[0][1]
    data = json.loads(scripts.found[1][1])
    assert data["saved"]
    assert data["path"] == [0, 0, 100, 50]
    (chunk,) = data["chunks"]
    blob = base64.b64decode(data["data"][str(chunk["anchor"])])
    found = unpack(np.frombuffer(blob, np.uint8))
    assert np.abs(found[:3] - params[:3]).max() < 1e-4
    assert len(blob) == chunk["levels"][0]["bytes"]


def test_a_large_map_is_merged_until_the_report_is_small_enough(built, monkeypatch):
    params = gaussians(30_000, side_m=1.0)
    monkeypatch.setattr(map_view, "MAX_REPORT_BYTES", 300_000)
    text = map_section(params, PATH, 60_000)
    assert len(text.encode()) + 60_000 <= 300_000
    shown = int(re.search(r"<p>(\d+) Gaussians, merged in cells of (\d+) cm", text)[1])
    assert 500 < shown < 15_000
    assert "no room" in map_section(params, PATH, 299_000)


def test_without_a_built_viewer_the_report_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(static_files, "_FOLDER", tmp_path)
    assert map_section(gaussians(10), PATH, 0) == NOT_BUILT
    assert "make web" in NOT_BUILT
