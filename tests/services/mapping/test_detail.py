"""Level of detail: what merging preserves, its error from a distance, and when viewers get more detail."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.common.mapfiles.detail import FINEST_CELL_M, detail_cell_m, merge_by_cell
from beamsplat.common.mapfiles.scores import psnr_db
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.messages import MapState
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.chunks import ChunkCensus, ChunkFeed, Viewpoint, chunk_snapshot
from beamsplat.services.mapping.mapper import Mapper
from beamsplat.services.mapping.messages import joined_state, state_messages
from beamsplat.services.mapping.queries import viewpoint_of
from beamsplat.services.mapping.settings import MapperSettings


def wall(count=60_000, seed=0):
    """Discs of 6 mm on a wall of 4 x 3 m that stands 1 m off the origin; two colours, in stripes of 40 cm."""
    random = np.random.default_rng(seed)
    params = np.zeros((14, count), np.float32)
    params[MEAN:SCALE] = np.stack(
        [random.uniform(-2, 2, count), random.uniform(-1.5, 1.5, count), np.ones(count)]
    )
    params[SCALE:QUAT] = np.log(np.array([0.006, 0.006, 0.001]))[:, None]
    params[QUAT] = 1.0
    params[OPACITY] = 3.0
    striped = np.floor(params[MEAN] / 0.4) % 2 == 0
    params[COLOUR:] = np.where(striped, np.array([[0.8], [0.3], [0.2]]), np.array([[0.2], [0.4], [0.7]]))
    return params


CAMERA = RasterCamera(280.0, 280.0, 159.5, 119.5, 320, 240)


def seen(params, distance_m):
    rasterizer, store = Rasterizer(1), GaussianStore()
    store.add(params, 0)
    back = make_transform(np.eye(3), np.array([0.0, 0.0, 1.0 - distance_m]))
    image = rasterizer.render(store.params, store.count, CAMERA, inverse(back)).image
    return np.clip(image[:3], 0.0, 1.0).copy()


def test_no_cell_no_change():
    params = wall(100)
    assert merge_by_cell(params, 0.0) is params
    assert merge_by_cell(params, 0.001) is params  # all are larger than that


@given(st.integers(0, 50), st.sampled_from([0.05, 0.1, 0.4]))
@settings(max_examples=20, deadline=None)
def test_merged_gaussians_keep_place_colour_and_plane(seed, cell_m):
    params = wall(3000, seed)
    merged = merge_by_cell(params, cell_m)
    assert merged.shape[1] < params.shape[1]
    assert np.all(np.isfinite(merged))
    cells = {tuple(c) for c in np.floor(params[MEAN:SCALE].T.astype(float) / cell_m).astype(int)}
    assert merged.shape[1] == len(cells)
    assert np.abs(merged[MEAN + 2] - 1.0).max() < 1e-4  # on the wall, m
    np.testing.assert_allclose(np.linalg.norm(merged[QUAT:OPACITY], axis=0), 1.0, atol=1e-5)
    assert np.exp(merged[SCALE:QUAT]).min(axis=0).max() < 0.002  # as thin
    low, high = params[COLOUR:].min(axis=1), params[COLOUR:].max(axis=1)
    assert np.all(merged[COLOUR:] >= low[:, None] - 1e-5)
    assert np.all(merged[COLOUR:] <= high[:, None] + 1e-5)


def test_gaussians_larger_than_a_cell_are_not_merged():
    params = wall(500)
    params[SCALE:QUAT, :3] = np.log(0.5)
    np.testing.assert_array_equal(merge_by_cell(params, 0.1)[:, :3], params[:, :3])


@pytest.mark.parametrize("distance_m", [12.0, 24.0])
def test_a_pixels_worth_of_detail_costs_little_where_it_cannot_be_seen(distance_m):
    params = wall()
    cell_m = detail_cell_m(distance_m, 280.0, 1.0)
    merged = merge_by_cell(params, cell_m)
    assert merged.shape[1] < 0.3 * params.shape[1]
    assert psnr_db(seen(params, distance_m), seen(merged, distance_m)) > 30.0


def test_cells_grow_by_twos_with_the_distance():
    assert detail_cell_m(5.0, 280.0, 1.0) == 0.0  # 18 mm
    assert detail_cell_m(5.7, 280.0, 1.0) == FINEST_CELL_M
    assert detail_cell_m(11.3, 280.0, 1.0) == 2 * FINEST_CELL_M
    assert detail_cell_m(11.3, 280.0, 2.0) == 4 * FINEST_CELL_M


def test_a_distant_chunk_is_coarse_and_complete_for_a_near_viewpoint():
    mapper, feed = Mapper(MapperSettings(), seed=0, threads=1), ChunkFeed()
    mapper.T_map_anchor[3] = make_transform(np.eye(3), np.array([2.0, 0.0, 0.0]))
    mapper.store.add(wall(20_000), 3)
    far, near = (Viewpoint(np.array([0.0, 0.0, z]), 280.0, 1.0) for z in (-30.0, 0.0))

    def take(viewpoint, anchor=3):
        return feed.take_update(ChunkCensus(mapper, viewpoint), anchor)

    def oldest_due(viewpoint):
        return feed.oldest_due(ChunkCensus(mapper, viewpoint))

    first = take(far)
    assert first.cell_m == 0.08
    assert first.params.shape[1] < 0.2 * 20_000
    assert first.params[MEAN].mean() == pytest.approx(-2.0, abs=0.1)  # in the anchor's frame
    assert take(far) is None  # nothing new
    assert oldest_due(far) is None
    assert oldest_due(near) == 3
    assert take(near).params.shape[1] == 20_000
    assert take(far) is None  # detail is kept when the viewpoint moves away
    assert oldest_due(far) is None
    mapper.move_anchors({3: make_transform(np.eye(3), np.array([2.0, 0.1, 0.0]))})
    assert oldest_due(far) is None  # viewers move the chunk with its anchor
    mapper.store.add(wall(10), 3)
    assert oldest_due(far) == 3  # but a new version comes as it is seen from there
    assert take(far).cell_m == 0.08
    assert take(None).cell_m == 0.0
    assert dict(chunk_snapshot(mapper, far))[3].cell_m == 0.08
    assert take(None, anchor=99) is None


def test_one_census_finds_what_a_search_per_anchor_finds():
    rng = np.random.default_rng(3)
    mapper = Mapper(MapperSettings(), seed=0, threads=1)
    for anchor in (5, -1, 2, 5, 9, 2):
        params = wall(400)
        params[MEAN:SCALE] += rng.normal(0.0, 4.0, (3, 1)).astype(np.float32)
        mapper.T_map_anchor[anchor] = np.eye(4)
        mapper.store.add(params, anchor)
    store, at_m = mapper.store, np.array([1.0, 2.0, 3.0])
    store.steps[: store.count] = rng.integers(0, 50, store.count)
    store.keep(rng.random(store.count) < 0.8)
    census = ChunkCensus(mapper, Viewpoint(at_m, 280.0, 1.0))
    events = {5: 3, -1: 2, 2: 3, 9: 2}  # insertions and one removal
    for anchor, number in events.items():
        mine = store.anchor[: store.count] == anchor
        assert census.versions[anchor] == (number << 40) + int(store.steps[: store.count][mine].sum())
        np.testing.assert_array_equal(
            census.update(anchor, 0.0).params, store.params[:, : store.count][:, mine]
        )
        means = store.params[MEAN : MEAN + 3, : store.count][:, mine].T
        nearest_m = np.linalg.norm(means - at_m, axis=1).min()
        assert census.cell_m(anchor) == detail_cell_m(nearest_m, 280.0, 1.0)


def test_a_query_may_contain_a_viewpoint():
    assert viewpoint_of({}) is None
    viewpoint = viewpoint_of({"from": "1,2,3", "focal_px": "300"})
    assert viewpoint.at_map_m.tolist() == [1.0, 2.0, 3.0]
    assert (viewpoint.focal_px, viewpoint.error_px) == (300.0, 1.0)
    for wrong in ({"from": "1,2"}, {"from": "1,2,3"}, {"from": "a,b,c", "focal_px": "3"}):
        with pytest.raises(UserError, match="snapshot: "):
            viewpoint_of(wrong)


def test_a_state_in_pieces_is_complete_or_refused():
    arrays = {"a": np.arange(3_000_000), "b": np.eye(3)}
    pieces = list(state_messages(arrays))
    assert len(pieces) > 4
    again = joined_state(pieces[::-1])
    for name in arrays:
        np.testing.assert_array_equal(again[name], arrays[name])
    with pytest.raises(UserError, match="try again"):
        joined_state(pieces[1:])
    for data in (b"", b"PK\x03\x04" + b"x" * 90, pieces[0].data.tobytes()):
        wrong = MapState(stamp_ns=0, first=0, total=len(data), data=np.frombuffer(data, np.uint8))
        with pytest.raises(UserError, match="cannot be read"):
            joined_state([wrong])
