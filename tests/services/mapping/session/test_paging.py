"""The memory budget of the mapper: keyframes are paged out and in without loss."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import keyframe_views
from beamsplat.common.messages import Tick
from beamsplat.services.mapping.session.budgets import PROCESS_MB, check_budget
from beamsplat.services.mapping.session.disk_tier import DiskTier
from beamsplat.services.mapping.session.paging import (
    Pager,
    image_bytes,
    without_images,
)
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, feed, handle, make_node, message

# A keyframe of 160x120 takes 140 kB with both its sizes; rendering keeps 4 MB.
BUDGET_MB = PROCESS_MB + 10.0


def used(node):
    """Bytes in the mapper's memory, counted independently of the pager: images, Gaussians twice, workspaces."""
    mapper = node._mapper
    store = mapper.store
    gaussians = 2 * sum(getattr(store, n)[..., : store.count].nbytes for n in store._arrays())
    images = sum(map(image_bytes, mapper.keyframes.values()))
    return PROCESS_MB * 1e6 + gaussians + images + mapper.workspace_bytes


@pytest.fixture(scope="module")
def paged(tmp_path_factory):
    """(folder, node after a drive there and back, status messages)."""
    folder = tmp_path_factory.mktemp("paged") / "s"
    node, sent = make_node(folder, memory_mb=BUDGET_MB, session_every_s=4.0, half_steps=1, full_steps=1), {}
    for lap in range(2):
        for number in range(12):
            stamp_ns = r.T0 + (lap * 12 + number) * SECOND
            handle(node, "keyframes/frame", message(number, stamp_ns), sent)
            assert used(node) <= BUDGET_MB * 1e6
            assert len(node._mapper.keyframes) + len(node._mapper.paged_out) == lap * 12 + number + 1
    return folder, node, sent


def test_the_budget_holds_lap_after_lap_and_the_status_counts_paged_out_keyframes(paged):
    _, node, sent = paged
    assert len(node._mapper.paged_out) > 5
    assert f"in memory {len(node._mapper.keyframes)} of 24 keyframes" in node.detail
    statuses = sent["mapping/status"]
    assert [s.keyframes for s in statuses] == list(range(1, 25))
    assert statuses[-1].gaussians == node._mapper.store.count


def test_paged_out_keyframes_are_paged_in_by_turns(paged):
    _, node, _ = paged
    ever = set(node._mapper.keyframes)
    for count in range(48):
        handle(node, "tick", Tick(stamp_ns=r.T0 + 24 * SECOND, count=count), {})
        assert used(node) <= BUDGET_MB * 1e6
        ever |= set(node._mapper.keyframes)
    assert len(ever) == 24
    assert len(node._mapper.keyframes) + len(node._mapper.paged_out) == 24


def test_a_checkpoint_includes_paged_out_keyframes_and_resumes_with_or_without_a_budget(paged, tmp_path):
    folder, node, _ = paged
    sent = {}
    for output in node.drain():
        sent.setdefault(output[0], []).append(output[1])
    assert len(sent["mapping/poses"][-1].keyframe_ids) == 24
    paged_out = {id: held.delta for id, held in node._mapper.paged_out.items()}
    node.close()
    arrays = SessionFolder(folder).read_state()
    assert len(keyframe_views(arrays)) == 24
    again = make_node(folder, memory_mb=BUDGET_MB)
    assert set(again._mapper.paged_out) == set(paged_out)
    for id, delta in paged_out.items():
        np.testing.assert_array_equal(again._mapper.paged_out[id].delta, delta)
    assert list(again._mapper.keyframes) == list(node._mapper.keyframes)
    again.close()
    free = make_node(folder)
    assert len(free._mapper.keyframes) == 24
    free._mapper.refine(5)
    free.close()


def test_the_same_drive_pages_the_same_keyframes(tmp_path):
    nodes = [
        make_node(tmp_path / name, memory_mb=BUDGET_MB - 2.5, half_steps=1, full_steps=1) for name in "ab"
    ]
    for node in nodes:
        feed(node, range(12))
        node.close()
    a, b = nodes
    assert list(a._mapper.paged_out) == list(b._mapper.paged_out)
    assert a._mapper.paged_out
    count = a._mapper.store.count
    np.testing.assert_array_equal(a._mapper.store.params[:, :count], b._mapper.store.params[:, :count])


def test_keyframes_that_cannot_be_read_again_stay_in_memory_or_are_reported(tmp_path, caplog):
    node = make_node(tmp_path / "s", half_steps=0, full_steps=0)
    feed(node, range(12))
    mapper, pager = node._mapper, Pager(0.0, 0, DiskTier(SessionFolder(tmp_path / "s")))
    pager.page(mapper, lambda id: None, lambda id: False)
    assert len(mapper.keyframes) == 12
    pager.page(mapper, lambda id: None, lambda id: True)
    assert len(mapper.keyframes) == 8

    def broken(id):
        raise UserError("the disk is gone")

    pager.page(mapper, broken, lambda id: True)
    assert pager.lost_count == 1
    assert "the disk is gone" in caplog.text
    held = next(iter(mapper.keyframes.values()))
    assert image_bytes(without_images(held)) == 0 < image_bytes(held)
    assert without_images(held).camera == held.levels[0].camera
    node.close()


def test_a_budget_needs_a_disk_and_room_for_the_process(tmp_path):
    with pytest.raises(UserError, match=r"mapping\.memory_mb: .*give mapping\.session too"):
        make_node(None, memory_mb=1000.0)
    with pytest.raises(UserError, match=r"memory_mb = 100: the process itself takes"):
        make_node(tmp_path / "s", memory_mb=100.0)
    check_budget(PROCESS_MB + 1.0, tmp_path)
