"""Sessions and the memory budget of the GPU engine, on the CPU build of its kernels: GPU, host memory and disk."""

import json
import logging
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.blocks import block_file
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.messages import Tick
from beamsplat.services.mapping import node as node_module
from beamsplat.services.mapping.engines.cpu import CpuEngine
from beamsplat.services.mapping.engines.cuda import CudaEngine
from beamsplat.services.mapping.session.block_cache import BlockCache
from beamsplat.services.mapping.session.paging import image_bytes
from beamsplat.tools.cli.main import app
from tests.common.raster.cuda.shim import needs_compiler, shim_kernels
from tests.services.mapping.session import gallery
from tests.services.mapping.session.maps import SECOND, handle, make_node

PLACES = 24
FEW = {"half_steps": 1, "full_steps": 0, "tick_steps": 0, "stride_px": 12, "fine_stride_px": 8}


@pytest.fixture
def compute_on(monkeypatch):
    """Let mapping nodes compute on "cpu", or on "cuda" by the CPU build of its kernels."""

    def choose(name):
        def make(_, threads, gpu_memory_mb, sh_degree):
            budget = None if gpu_memory_mb is None else gpu_memory_mb * 1e6
            if name == "cpu":
                return CpuEngine(threads, sh_degree)
            return CudaEngine(shim_kernels(), budget, sh_degree)

        monkeypatch.setattr(node_module, "make_engine", make)

    return choose


def walk(node, numbers):
    sent = {}
    for number in numbers:
        handle(node, "keyframes/frame", gallery.message(number, PLACES), sent)
    return sent


def saved(node):
    list(node.drain())
    state = node._mapper.store.state()
    node.close()
    return state


@needs_compiler
@pytest.mark.parametrize(("first", "second"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_session_of_one_engine_is_continued_by_the_other(first, second, tmp_path, compute_on, caplog):
    folder = tmp_path / "s"
    compute_on(first)
    node = make_node(folder, **FEW)
    walk(node, range(2))
    before = saved(node)
    assert SessionFolder(folder).manifest()["engine"]["name"] == first

    compute_on(second)
    caplog.set_level(logging.INFO)
    node = make_node(folder, **FEW)
    assert re.search(rf"computed by {first} \(.*; {second} \(.* continues it", caplog.text)
    after = node._mapper.store.state()
    for name in before.keys() - {"events"}:
        np.testing.assert_array_equal(after[name], before[name])
    assert len(node._mapper.keyframes) == 2
    steps = node._mapper.steps
    sent = walk(node, range(2, 4))
    assert [status.status for status in sent["mapping/status"]] == ["ok", "ok"]
    assert node._mapper.steps == steps + 2
    assert sent["mapping/status"][-1].gaussians > before["params"].shape[1]
    saved(node)
    manifest = SessionFolder(folder).manifest()
    assert manifest["engine"]["name"] == second
    assert "kernels" in manifest["engine"]["version"]
    shown = CliRunner().invoke(app, ["session", "info", str(folder)]).output
    assert f"computed by {second} (" in " ".join(shown.split())
    table = json.loads(CliRunner().invoke(app, ["session", "info", str(folder), "--json"]).stdout)
    assert table["edge"]["engine"] == manifest["engine"]


def error_of(mapper, place):
    """Return the mean absolute error of a painting as the Gaussians in memory show it, of colours in [0, 1]."""
    image = np.clip(mapper.render(gallery.CAMERA, gallery.T_map_camera(place))[:3], 0.0, 1.0)
    return float(np.abs(image - gallery.painting(place).transpose(2, 0, 1) / 255.0).mean())


def budget_mb(room):
    """Return a budget of GPU memory for `room` Gaussians beside all that does not depend on their number."""
    node = make_node(None, **FEW)
    walk(node, range(1))
    engine = node._mapper.engine
    memory = engine.device_memory
    buffers = memory.fixed_bytes - engine._targets.budget_bytes
    return (buffers + room * memory.bytes_each) / 0.75 / 1e6  # a quarter is for the images of keyframes


@needs_compiler
def test_the_budget_of_gpu_memory_holds_over_gpu_memory_and_disk(tmp_path, compute_on):
    compute_on("cuda")
    most_mb = budget_mb(2400)
    node = make_node(tmp_path / "s", gpu_memory_mb=most_mb, session_every_s=1e6, **FEW)
    mapper, tier = node._mapper, node._session._checkpointer.disk_tier
    pager, engine = node._session._checkpointer._pager, node._mapper.engine
    for number in range(PLACES):
        status = walk(node, [number])["mapping/status"][-1]
        assert status.status == "ok"
        assert engine.device_memory.used_bytes <= most_mb * 1e6
        assert not pager.fault
        assert mapper.store.count <= mapper.max_in_memory
        for held in mapper.keyframes.values():
            assert len(pager._visible_blocks(mapper, held)) == 0
        assert mapper.store.paged_out_count == tier.count
    assert tier.count > 0.3 * status.gaussians
    assert status.gaussians == mapper.store.count + tier.count
    assert f"of {most_mb:.0f} MB of the GPU" in status.session
    assert f"{len(tier.blocks)} blocks on disk, {len(tier.blocks)} of them also in host memory" in node.detail

    # The blocks in host memory come back without the disk.
    seen = {p: mapper.paged_out.get(gallery.T0 + p * SECOND) for p in range(PLACES)}
    seen = {p: keyframe for p, keyframe in seen.items() if keyframe is not None}
    place = next(p for p in seen if len(pager._visible_blocks(mapper, seen[p])))
    numbers = pager._visible_blocks(mapper, seen[place])
    for number in numbers.tolist():
        block_file(SessionFolder(tmp_path / "s").blocks, number).rename(tmp_path / f"{number}")
    total, count, gone = mapper.store.count + tier.count, mapper.store.count, error_of(mapper, place)
    pager.load_visible(mapper, seen[place])
    assert tier.lost_count == 0
    assert mapper.store.count > count
    assert mapper.store.count + tier.count == total
    assert error_of(mapper, place) < 0.4 * gone

    # Whoever continues it without a budget has all of it.
    saved(node)
    compute_on("cpu")
    whole = make_node(tmp_path / "s", **FEW)
    assert whole._mapper.store.count == total
    assert len(whole._mapper.keyframes) == PLACES
    whole.close()


@needs_compiler
def test_both_budgets_hold_together(tmp_path, compute_on):
    """Host memory for the images of few keyframes: what they and the cache of blocks take is within it."""
    compute_on("cuda")
    gpu_mb = budget_mb(2400)
    node = make_node(tmp_path / "s", gpu_memory_mb=gpu_mb, memory_mb=402.0, session_every_s=1e6, **FEW)
    pager, mapper = node._session._checkpointer._pager, node._mapper
    for number in range(PLACES):
        walk(node, [number])
        assert pager._used(mapper) <= 402e6
        assert mapper.engine.device_memory.used_bytes <= gpu_mb * 1e6
    assert pager._disk_tier.cache.held_bytes > 0
    images = sum(map(image_bytes, mapper.keyframes.values()))
    assert images + pager._disk_tier.cache.held_bytes < 2e6
    handle(node, "tick", Tick(stamp_ns=gallery.T0 + 60 * SECOND, count=1))
    assert f"of 402 MB, {mapper.engine.device_memory.used_bytes / 1e6:.0f} of {gpu_mb:.0f} MB of the GPU" in (
        node._session.status_text()
    )
    node.close()


def test_a_cache_of_blocks_keeps_the_latest_within_its_limit():
    cache = BlockCache()
    cache.put(1, {"params": np.zeros(100, np.float32)})
    assert len(cache) == 0  # no limit was set: none is kept
    cache.limit(1000.0)
    for number in range(1, 4):
        cache.put(number, {"params": np.full(100, number, np.float32)})
    assert cache.get(1) is None
    assert cache.held_bytes == 800
    assert cache.get(3)["params"][0] == 3.0
    cache.put(4, {"params": np.zeros(1000, np.float32)})  # larger than the limit
    assert (len(cache), cache.get(4)) == (2, None)
    cache.remove(3)
    cache.remove(3)
    assert cache.held_bytes == 400
    cache.limit(0.0)
    assert cache.held_bytes == len(cache) == 0


def test_a_budget_of_gpu_memory_needs_a_session_and_a_gpu_engine(tmp_path):
    with pytest.raises(UserError, match=r"mapping\.gpu_memory_mb: .*give mapping\.session too"):
        make_node(None, gpu_memory_mb=1000.0)
    with pytest.raises(UserError, match=r'gpu_memory_mb: mapping\.engine = "cpu" uses no GPU'):
        make_node(tmp_path / "s", gpu_memory_mb=1000.0, engine="cpu")
