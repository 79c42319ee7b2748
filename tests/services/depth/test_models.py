"""The models store: table, digest, resume, licence."""

import inspect
import re
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.depth.model_files import find_model, sha256_of
from beamsplat.services.depth.models import ModelEntry, find_entry, model_name, pull, read_model_table
from beamsplat.services.depth.source import SOURCES, DepthInput, make_source, source_class

DATA = bytes(range(256)) * 4000


class _Ranges(SimpleHTTPRequestHandler):
    """Serves files, in parts where asked."""

    asked: list[str] = []
    files: dict[str, bytes] = {}

    def do_GET(self):
        range_ = self.headers.get("Range")
        self.asked.append(range_ or "")
        content = self.files[self.path.lstrip("/")]
        start = int(range_.removeprefix("bytes=").split("-")[0]) if range_ else 0
        if start >= len(content):
            self.send_error(416)
            return
        self.send_response(206 if range_ else 200)
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        self.wfile.write(content[start:])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    _Ranges.asked, _Ranges.files = [], {"net.onnx": DATA}
    with ThreadingHTTPServer(("127.0.0.1", 0), _Ranges) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}/net.onnx"
        running.shutdown()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("BEAMSPLAT_MODELS", str(tmp_path))
    return tmp_path


def _digest(tmp_path):
    (tmp_path / "whole").write_bytes(DATA)
    return sha256_of(tmp_path / "whole")


def _row(**changes):
    return ModelEntry(
        **{"source": "fastdepth", "licence": "MIT", "commercial": True, "url": "", "sha256": ""} | changes
    )


def test_the_table_fits_and_names_sources_that_exist():
    table = read_model_table()
    assert {row.source for row in table.values()} <= set(SOURCES)
    assert all(row.url or row.how for row in table.values())
    assert not table["unidepth_v2_vits"].commercial
    with pytest.raises(UserError, match="there is no model"):
        find_entry("nothing", table)


def test_a_broken_download_goes_on_where_it_stopped(server, folder):
    (folder / "net.onnx.partial").write_bytes(DATA[:100_000])
    seen = []
    row = _row(url=server, sha256=_digest(folder))
    path = pull("net", row, agree=lambda _: False, progress=lambda done, total: seen.append((done, total)))
    assert path.read_bytes() == DATA
    assert _Ranges.asked == ["bytes=100000-"]
    assert seen[-1] == (len(DATA), len(DATA))
    assert find_model("net") == path
    assert not list(folder.glob("*.partial"))
    pull("net", row, agree=lambda _: False)
    assert len(_Ranges.asked) == 1  # it is here already


def test_a_download_that_was_complete_is_not_fetched_again(server, folder):
    (folder / "net.onnx.partial").write_bytes(DATA)
    assert pull("net", _row(url=server, sha256=_digest(folder)), agree=lambda _: False).read_bytes() == DATA


def test_a_file_of_another_digest_is_removed(server, folder):
    with pytest.raises(UserError, match="the table states"):
        pull("net", _row(url=server, sha256="0" * 64), agree=lambda _: True)
    assert not list(folder.iterdir())


def test_what_nobody_has_verified_and_what_is_not_commercial_is_asked_for(server, folder):
    asked = []

    def agree(question):
        asked.append(question)
        return len(asked) == 1

    with pytest.raises(UserError, match="not kept"):
        pull("net", _row(url=server, commercial=False, licence="CC-BY-NC-4.0"), agree)
    assert "CC-BY-NC-4.0" in asked[0]
    assert _digest(folder) in asked[1]
    with pytest.raises(UserError, match="licence"):
        pull("net", _row(url=server, commercial=False), lambda _: False)


def test_no_address_and_no_connection_are_said(folder):
    with pytest.raises(UserError, match="export it"):
        pull("net", _row(how="export it yourself."), lambda _: True)
    with pytest.raises(UserError, match="download failed"):
        pull("net", _row(url="http://127.0.0.1:9/net.onnx"), lambda _: True)


@pytest.mark.parametrize("source", sorted({row.source for row in read_model_table().values()}))
def test_the_name_of_a_source_means_the_model_that_it_uses_by_default(source):
    default = inspect.signature(source_class(source)).parameters["model"].default
    assert model_name(source, read_model_table()) == default
    assert find_entry(source, read_model_table()).source == source


def test_a_misspelt_model_is_answered_with_the_nearest_name():
    with pytest.raises(UserError, match="did you mean 'unidepth'"):
        model_name("unidpeth", read_model_table())


def test_the_commands_take_the_name_of_a_source(folder):
    from typer.testing import CliRunner

    from beamsplat.tools.cli.main import app

    metric = "depth_anything_v2_metric_hypersim_small"
    with pytest.raises(UserError, match=rf"{metric}: there is no file to download.*{metric}.onnx"):
        CliRunner().invoke(app, ["models", "pull", "depth_anything_metric"], catch_exceptions=False)
    with pytest.raises(UserError, match="model 'unidepth_v2_vits' is not in"):
        CliRunner().invoke(app, ["models", "check", "unidepth"], catch_exceptions=False)


def test_unidepth_is_not_downloaded_without_agreement(folder):
    from typer.testing import CliRunner

    from beamsplat.tools.cli.main import app

    with pytest.raises(UserError, match="licence not accepted; nothing was downloaded"):
        CliRunner().invoke(app, ["models", "pull", "unidepth"], input="n\n", catch_exceptions=False)
    assert not list(folder.iterdir())


def test_a_network_with_its_weights_in_a_second_file_runs_after_the_download(server, folder, tmp_path):
    """As onnx-community exports Depth Anything 3: the graph names `model.onnx_data`."""
    pytest.importorskip("onnx", reason="needs the package onnx, which builds the graphs")
    from tests.services.depth import graphs

    made = tmp_path / "made"
    made.mkdir()
    graphs.depth_anything_3(made / "model.onnx", data="model.onnx_data")
    _Ranges.files = {path.name: path.read_bytes() for path in made.iterdir()}
    assert set(_Ranges.files) == {"model.onnx", "model.onnx_data"}
    base = server.rpartition("/")[0]
    row = _row(
        source="depth_anything_3", url=f"{base}/model.onnx", sha256=sha256_of(made / "model.onnx"),
        data_url=f"{base}/model.onnx_data", data_sha256=sha256_of(made / "model.onnx_data"),
    )  # fmt: skip
    path = pull("da3", row, agree=lambda _: False)
    assert path == find_model("da3") == folder / "da3" / "model.onnx"
    image = np.random.default_rng(0).integers(0, 255, (96, 128, 3)).astype(np.uint8)
    view = DepthInput(1, image, Pinhole(100.0, 100.0, 63.5, 47.5, 128, 96))
    assert make_source("depth_anything_3", {"model": "da3", "input_px": 28}).estimate(view).ok
    asked = len(_Ranges.asked)
    pull("da3", row, agree=lambda _: False)
    assert len(_Ranges.asked) == asked  # both are here already

    broken = row.model_copy(update={"data_sha256": "0" * 64})
    with pytest.raises(UserError, match=r"model\.onnx_data has sha256"):
        pull("other", broken, agree=lambda _: True)
    with pytest.raises(UserError, match="is not in"):
        find_model("other")  # half of a network is not installed


def test_the_list_names_size_and_licence():
    from typer.testing import CliRunner

    from beamsplat.tools.cli.main import app

    text = CliRunner().invoke(app, ["models", "list"], env={"COLUMNS": "220"}).output
    row = next(line for line in text.splitlines() if "moge_2_vits_normal" in line)
    assert "MIT" in row
    assert "141" in row


def test_the_models_that_the_documents_pull_can_be_pulled():
    root = Path(__file__).resolve().parents[3]
    table, named = read_model_table(), set()
    for page in (root / "README.md", *(root / "docs").rglob("*.md")):
        named |= set(re.findall(r"models pull (?:--yes )?([a-z0-9_]+)", page.read_text()))
    assert named
    for name in named:
        assert find_entry(name, table).url, f"{name}: there is no file to download"
