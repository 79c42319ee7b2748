"""Merge of two maps of one room: the worse of two duplicate surfaces is removed, all other surfaces are kept."""

import numpy as np
import pytest

from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.services.mapping.messages import decode_keyframe
from beamsplat.tools.sessions.deduplicate import without_duplicates
from beamsplat.tools.sessions.edit import with_gaussians
from tests.services.mapping.session import gallery
from tests.services.mapping.session.maps import handle, make_node


@pytest.fixture(scope="module")
def galleries(tmp_path_factory):
    """(arrays of pictures 0 to 3 seen well, of 2 to 5 seen badly and a hand's breadth nearer, an opener)."""
    root, out = tmp_path_factory.mktemp("galleries"), []
    for name, places, steps in (("good", range(4), 30), ("bad", range(2, 6), 0)):
        node = make_node(root / name, half_steps=steps, full_steps=0)
        for place in places:
            handle(node, "keyframes/frame", gallery.message(place), {})
        list(node.drain())
        node.close()
        out.append(SessionFolder(root / name).read_state())
    opener = make_node()
    return *out, lambda id: decode_keyframe(
        gallery.message((id - gallery.T0) // 10**9), opener._intake.undistorter
    )


def joined(a, b):
    """Both maps as one state whose keyframes are those of a; the flags of b's Gaussians."""
    out = dict(a)
    for key in a:
        if key.startswith("store_") and key != "store_events":
            out[key] = np.concatenate([a[key], b[key]], axis=-1)
    out["store_events"] = np.concatenate([a["store_events"], b["store_events"]])
    return out, np.arange(out["store_params"].shape[1]) >= a["store_params"].shape[1]


def place_of(arrays):
    """Which picture each Gaussian belongs to."""
    return np.round(arrays["store_params"][1] / 3.0).astype(int)


def test_the_worse_of_two_duplicates_is_removed_and_other_surfaces_are_kept(galleries):
    good, bad, opened = galleries
    both, second = joined(good, bad)
    stay = without_duplicates(both, second, opened)
    places = place_of(both)
    alone_good, alone_bad = ~second & (places < 2), second & (places > 3)
    assert stay[alone_good].all()
    assert stay[alone_bad].all()
    shared_good, shared_bad = (mask & np.isin(places, (2, 3)) for mask in (~second, second))
    assert stay[shared_good].mean() > stay[shared_bad].mean() + 0.3
    assert with_gaussians(both, stay)["store_params"].shape[1] == stay.sum()


def test_the_order_of_the_maps_does_not_matter(galleries):
    good, bad, opened = galleries
    both, second = joined(good, bad)
    flipped, first = without_duplicates(both, second, opened), without_duplicates(both, ~second, opened)
    np.testing.assert_array_equal(flipped, first)


def test_keyframes_that_cannot_be_decoded_are_skipped(galleries):
    good, bad, _ = galleries
    both, second = joined(good, bad)

    def broken(id):
        raise ValueError("gone")

    assert without_duplicates(both, second, broken).all()
