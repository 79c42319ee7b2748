"""`beamsplat session edit` and `undo`: what is removed, what stays, and what comes back, to the bit."""

import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.tools.sessions.edit import summary_of, with_anchors
from beamsplat.tools.sessions.selection import floaters, in_polygon
from tests.services.mapping.session.maps import feed, make_node
from tests.services.mapping.session.test_session_cli import run


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("edit") / "room"
    node = make_node(folder, half_steps=4, full_steps=2)
    feed(node, range(5))
    list(node.drain())
    node.close()
    return folder


@pytest.fixture
def session(drive, tmp_path):
    return shutil.copytree(drive, tmp_path / "map")


def state(session):
    return SessionFolder(session).read_state()


def sorted_rows(arrays):
    """All arrays of the Gaussians, one row each, sorted."""
    names = [n for n in sorted(arrays) if n.startswith("store_") and n != "store_events"]
    count = arrays["store_params"].shape[1]
    table = np.concatenate([arrays[n].reshape(-1, count).astype(np.float64) for n in names]).T
    return table[np.lexsort(table.T)]


def test_a_polygon_removes_what_is_inside_between_the_heights_and_undo_brings_it_back(session):
    before = state(session)
    x, y, z = before["store_params"][:3]
    middle = float(np.median(x)), float(np.median(y)), float(np.median(z))
    corners = [(middle[0], y.min() - 1), (x.max() + 1, y.min() - 1), (x.max() + 1, middle[1]), middle[:2]]
    text = " ".join(f"{a:.6f},{b:.6f}" for a, b in corners)
    inside = (x > middle[0]) & (y < middle[1]) & (z >= middle[2])
    told = run("edit", session, "--remove", text, "--low-m", middle[2])
    after = state(session)
    assert f"{int(inside.sum())} of {len(x)} Gaussians removed" in told
    assert 0 < inside.sum() < len(x)
    np.testing.assert_array_equal(after["store_params"], before["store_params"][:, ~inside])
    run("undo", session)
    np.testing.assert_array_equal(sorted_rows(state(session)), sorted_rows(before))
    versions = dict(state(session)["store_events"].tolist())
    assert all(versions[anchor] > events for anchor, events in after["store_events"].tolist())
    with pytest.raises(UserError, match="no edit to be undone"):
        run("undo", session)


def test_edits_are_undone_in_reverse_order_and_keep_is_the_opposite_of_remove(session):
    whole = sorted_rows(state(session))
    x = state(session)["store_params"][0]
    box = f"{np.median(x):.6f},-90 90,-90 90,90 {np.median(x):.6f},90"
    run("edit", session, "--keep", box)
    right = sorted_rows(state(session))
    assert abs(len(right) - 0.5 * len(whole)) <= 1
    run("edit", session, "--high-m", 0.5)
    assert len(sorted_rows(state(session))) < len(right)
    run("undo", session)
    np.testing.assert_array_equal(sorted_rows(state(session)), right)
    run("undo", session)
    np.testing.assert_array_equal(sorted_rows(state(session)), whole)


def test_what_comes_back_moves_with_its_anchor(session):
    """Undone after a loop closure has moved an anchor: as if the edit had never been."""
    before = state(session)
    anchor = int(before["store_anchor"][0])
    T = dict(zip(before["anchor_id"].tolist(), before["anchor_T_map"]))[anchor]
    moved = {anchor: se2_to_se3(np.array([0.3, -0.2, 0.4])) @ T}
    run("edit", session, "--low-m", np.median(before["store_params"][2]))
    folder = SessionFolder(session)
    folder.lock()
    arrays = with_anchors(state(session), moved)
    folder.write_state(arrays, summary_of(arrays))
    folder.unlock()
    run("undo", session)
    want = sorted_rows(with_anchors(before, moved))
    np.testing.assert_allclose(sorted_rows(state(session))[:, :3], want[:, :3], atol=1e-5)


def test_an_edit_that_was_interrupted_before_the_state_was_written_puts_nothing_back_twice(session):
    before = sorted_rows(state(session))
    whole = shutil.copytree(session, session.with_name("whole"))
    run("edit", session, "--low-m", 1.0)
    shutil.copytree(session / "edge" / "edits", whole / "edge" / "edits")
    run("undo", whole)
    np.testing.assert_array_equal(sorted_rows(state(whole)), before)


def test_floaters_are_removed_and_surfaces_stay(session):
    arrays = state(session)
    store = {key: a.copy() for key, a in arrays.items()}
    store["store_params"][:3, :7] = [[40.0], [40.0], [1.5]] + 0.01 * np.arange(7)
    folder = SessionFolder(session)
    folder.lock()
    folder.write_state(store, summary_of(store))
    folder.unlock()
    assert "would be removed" in run("edit", session, "--floaters", 8, "--dry-run")
    assert state(session)["store_params"].shape == arrays["store_params"].shape
    run("edit", session, "--floaters", 8)
    left = state(session)["store_params"]
    assert left[0].max() < 30.0
    assert left.shape[1] > 0.97 * arrays["store_params"].shape[1]


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ((), "nothing to be removed"),
        (("--keep", "0,0 1,1"), "at least three corners"),
        (("--remove", "0,0 1,x 2,2"), "at least three corners"),
        (("--remove", "0,0 1,nan 2,2"), "at least three corners"),
        (("--keep", "900,900 901,900 900,901"), "nothing would be left"),
    ],
)
def test_bad_words_are_refused_and_the_map_stays(session, words, match):
    before = sorted_rows(state(session))
    with pytest.raises(UserError, match=match):
        run("edit", session, *words)
    np.testing.assert_array_equal(sorted_rows(state(session)), before)


@settings(max_examples=60, deadline=None)
@given(st.integers(3, 9), st.integers(0, 2**31))
def test_points_of_a_convex_polygon_are_those_left_of_all_edges(count, seed):
    chance = np.random.default_rng(seed)
    angle = np.sort(chance.uniform(0.0, 2.0 * np.pi, count))
    corners = np.stack([3.0 * np.cos(angle), 2.0 * np.sin(angle)], axis=1)
    points = chance.uniform(-4.0, 4.0, (200, 2))
    edges = np.roll(corners, -1, axis=0) - corners
    to = points[:, None] - corners
    cross = edges[:, 0] * to[..., 1] - edges[:, 1] * to[..., 0]
    sure = np.abs(cross).min(axis=1) > 1e-9
    np.testing.assert_array_equal(in_polygon(points, corners)[sure], (cross > 0).all(axis=1)[sure])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_groups_farther_apart_than_two_cells_are_told_apart(seed):
    chance = np.random.default_rng(seed)
    params = np.zeros((14, 110), np.float32)
    dense = np.tile(np.linspace(0.0, 0.3, 100), (3, 1))
    params[:3, :100] = chance.uniform(-5.0, 5.0, (3, 1)) + dense
    far = params[:3, :100].max(axis=1) + 0.25
    params[:3, 100:] = far[:, None] + chance.uniform(0.0, 0.02, (3, 10))
    found = floaters(params, 11)
    assert found[100:].all()
    assert not found[:100].any()
