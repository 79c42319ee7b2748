"""Gaussians beyond the budget lie on the disk: what was seen looks the same when it comes back, and nothing
is lost.
"""

import shutil

import numpy as np
import pytest
from plyfile import PlyData

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse, se2_to_se3
from beamsplat.common.mapfiles.blocks import arrays_of_blocks, block_file, blocks_of, with_blocks
from beamsplat.common.mapfiles.ply import read_ply_points
from beamsplat.common.mapfiles.session import EDGE_MANIFEST, SessionFolder
from beamsplat.common.mapfiles.state import store_of
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.messages import Anchors
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.services.mapping.chunks import disk_params
from beamsplat.services.mapping.keyframe import MAX_DEPTH_M, RgbdKeyframe, visible_range_m
from beamsplat.services.mapping.preview import render_view
from beamsplat.services.mapping.session.budgets import PROCESS_MB
from beamsplat.services.mapping.session.disk_tier import CELL_M, groups_of, spheres_of
from beamsplat.services.mapping.session.frustum import frustum_intersects
from tests.services.mapping.session import gallery
from tests.services.mapping.session.maps import SECOND, handle, insert_waiting, make_node

BUDGET_MB = PROCESS_MB + 6.0
PLACES = 40


def walk(node, numbers, sent=None):
    for number in numbers:
        handle(node, "keyframes/frame", gallery.message(number, PLACES), {} if sent is None else sent)
    return node


def make(folder, **options):
    return make_node(folder, **{"memory_mb": BUDGET_MB, "half_steps": 2, "full_steps": 2, **options})


def rows(store):
    """Return all arrays of the Gaussians, one row each, sorted."""
    state = store.state()
    parts = [state[n].reshape(-1, store.count).astype(np.float64) for n in state if n != "events"]
    table = np.concatenate(parts).T
    return table[np.lexsort(table.T)]


def picture(mapper, place):
    return np.clip(mapper.render(gallery.CAMERA, gallery.T_map_camera(place))[:3], 0.0, 1.0)


def psnr_db(a, b):
    return -10.0 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12))


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """A session of a walk past all pictures, saved at its end."""
    folder = tmp_path_factory.mktemp("gallery") / "s"
    node = walk(make(folder, session_every_s=10.0), range(PLACES))
    list(node.drain())
    node.close()
    return folder


@pytest.fixture
def walked(once, tmp_path):
    """(folder, a node that has walked past all pictures)."""
    shutil.copytree(once, tmp_path / "s")
    node = make(tmp_path / "s", session_every_s=10.0)
    yield tmp_path / "s", node
    node.close()


def test_the_budget_holds_and_the_status_counts_memory_and_disk(tmp_path):
    """Twice along the gallery: never over the budget, and what a keyframe in memory sees is in memory."""
    node = make(tmp_path / "s")
    pager, disk_tier, mapper, sent = (
        node._session._checkpointer._pager,
        node._session._checkpointer.disk_tier,
        node._mapper,
        {},
    )
    for number in range(2 * PLACES):
        walk(node, [number], sent)
        assert pager._used(mapper) <= BUDGET_MB * 1e6
        assert not pager.fault
        for held in mapper.keyframes.values():
            assert len(pager._visible_blocks(mapper, held)) == 0
        assert mapper.store.paged_out_count == disk_tier.count
        assert len(mapper.keyframes) + len(mapper.paged_out) == number + 1
    status = sent["mapping/status"][-1]
    assert disk_tier.count > 0.3 * status.gaussians
    assert status.gaussians == mapper.store.count + disk_tier.count
    assert (
        f"{mapper.store.count} of {status.gaussians} Gaussians; {len(disk_tier.blocks)} blocks"
        in status.session
    )
    assert f"of {BUDGET_MB:.0f} MB" in node.detail
    node.close()


def test_all_keyframes_are_paged_in_again_over_time(walked):
    """Keyframes have their turns, those whose surroundings were on the disk too: each visit brings another
    place.
    """
    _, node = walked
    ever, pager = set(node._mapper.keyframes), node._session._checkpointer._pager
    before = len(ever)
    for _ in range(320):
        node._session._checkpointer.page(node._mapper)
        ever |= set(node._mapper.keyframes)
        assert pager._used(node._mapper) <= BUDGET_MB * 1e6
    assert len(ever) > before + 8
    assert min(ever) < gallery.T0 + 15 * SECOND


def test_paged_out_gaussians_render_the_same_after_page_in(walked):
    """The first places have left; a view brings them back as they were when they left: 60 dB, in fact the
    same bits.
    """
    _, node = walked
    mapper, checkpointer = node._mapper, node._session._checkpointer
    assert mapper.store.count < 0.8 * (mapper.store.count + checkpointer.disk_tier.count)
    before, away = {}, [place for place in range(12) if gallery.T0 + place * SECOND in mapper.paged_out]
    away = [
        place
        for place in away
        if len(checkpointer._pager._visible_blocks(mapper, mapper.paged_out[gallery.T0 + place * SECOND]))
    ]
    assert len(away) > 3
    for place in away[:3]:  # they do not see each other
        held = mapper.paged_out[gallery.T0 + place * SECOND]
        seen = gallery.painting(place).transpose(2, 0, 1) / 255.0
        gone_db = psnr_db(picture(mapper, place), seen)
        checkpointer.load_visible(mapper, held)
        before[place] = picture(mapper, place)
        assert psnr_db(before[place], seen) > gone_db + 8.0
    whole = rows(mapper.store)
    groups = groups_of(mapper.store, mapper.T_map_anchor)
    checkpointer.disk_tier.page_out(mapper.store, groups, mapper.T_map_anchor)
    assert mapper.store.count < 0.05 * len(whole)
    checkpointer._pager._where = None
    for place, image in before.items():
        checkpointer.load_visible(mapper, mapper.paged_out[gallery.T0 + place * SECOND])
        assert psnr_db(image, picture(mapper, place)) >= 60.0
    checkpointer.disk_tier.page_in(mapper.store, list(checkpointer.disk_tier.blocks), mapper.T_map_anchor)
    stored = {tuple(row) for row in rows(mapper.store)}
    assert {tuple(row) for row in whole} <= stored


def test_a_render_of_any_pose_includes_what_is_on_disk(walked):
    """All Gaussians leave: each painting is rendered as before, and nothing comes back into memory."""
    _, node = walked
    mapper, disk_tier = node._mapper, node._session._checkpointer.disk_tier
    disk_tier.page_in(mapper.store, list(disk_tier.blocks), mapper.T_map_anchor)
    cameras = {place: gallery.T_map_camera(place) for place in (0, 17, 39)}
    before = {place: render_view(mapper, T, gallery.CAMERA) for place, T in cameras.items()}
    for place, view in before.items():
        assert psnr_db(view.rgb / 255.0, gallery.painting(place) / 255.0) > 18.0
    disk_tier.page_out(mapper.store, groups_of(mapper.store, mapper.T_map_anchor), mapper.T_map_anchor)
    kept = mapper.store.count
    for place, T in cameras.items():
        view = render_view(mapper, T, gallery.CAMERA)
        assert view.left_out == 0
        # Not more: many Gaussians have one depth, and which of them is drawn first depends on their order.
        assert psnr_db(view.rgb / 255.0, before[place].rgb / 255.0) > 30.0
    assert mapper.store.count == kept


def test_what_cannot_be_read_for_a_render_is_counted(walked):
    folder, node = walked
    mapper, disk_tier = node._mapper, node._session._checkpointer.disk_tier
    disk_tier.page_out(mapper.store, groups_of(mapper.store, mapper.T_map_anchor), mapper.T_map_anchor)
    T, camera = gallery.T_map_camera(3), gallery.CAMERA
    parts, left_out = disk_tier.read_visible(camera, T, mapper.T_map_anchor, 10**9)
    in_view = sum(part.shape[1] for part in parts)
    assert in_view > 100
    assert left_out == 0
    few, left_out = disk_tier.read_visible(camera, T, mapper.T_map_anchor, in_view // 2)
    assert sum(part.shape[1] for part in few) + left_out == in_view
    for block in disk_tier.blocks.values():
        block_file(SessionFolder(folder).blocks, block.number).write_bytes(b"damaged")
    assert render_view(mapper, T, camera).left_out == in_view


def test_anchors_move_gaussians_on_disk(walked):
    """The first submap moves by half a metre and ten degrees while its Gaussians are on disk."""
    _, node = walked
    mapper, disk_tier = node._mapper, node._session._checkpointer.disk_tier
    assert mapper.store.paged_out[0][0] > 0.8 * sum(mapper.store.anchor[: mapper.store.count] == 0)
    whole = [mapper.store.chunk(0), *disk_params(mapper, 0)]
    before = np.concatenate(whole, axis=1)
    move = se2_to_se3(np.array([0.5, 0.2, np.deg2rad(10.0)]))
    version = mapper.store.versions()[0]
    places = np.stack([move @ mapper.T_map_anchor[0]])
    handle(
        node,
        "localization/anchors",
        Anchors(stamp_ns=gallery.T0, anchor_ids=np.array([0]), T_map_anchor=places),
        {},
    )
    assert mapper.store.versions()[0] == version  # in their own frame they are the same
    disk_tier.page_in(
        mapper.store, [n for n, b in disk_tier.blocks.items() if b.anchor == 0], mapper.T_map_anchor
    )
    after, expected = mapper.store.chunk(0), transform_gaussians(before, move)
    order, expected_order = np.lexsort(after[11:14]), np.lexsort(expected[11:14])
    np.testing.assert_allclose(after[MEAN:SCALE, order], expected[MEAN:SCALE, expected_order], atol=1e-5)


def test_chunks_and_the_final_file_include_gaussians_on_disk(tmp_path):
    node, sent = make(tmp_path / "s", save=tmp_path / "out"), {}
    walk(node, range(PLACES), sent)
    chunks = {c.anchor_id: c for c in node.on_query_snapshot({})}
    store = node._mapper.store
    total = store.count + store.paged_out_count
    assert sum(c.count for c in chunks.values()) == total > store.count
    points = transform_gaussians(unpack(chunks[0].packed), chunks[0].T_map_anchor)[MEAN:SCALE]
    assert len(points[0]) == sum(store.anchor[: store.count] == 0) + store.paged_out[0][0]
    assert points[1].min() < 0.5 < 8.5 < points[1].max() < 11.0  # four pictures, three metres apart
    assert chunks == chunks | {
        c.anchor_id: c for c in sent["mapping/chunk"] if c.revision == chunks[c.anchor_id].revision
    }
    for output in node.drain():
        sent.setdefault(output[0], []).append(output[1])
    assert len(read_ply_points(tmp_path / "out" / "splats.ply")) == total
    node.close()


def test_paging_changes_no_version(walked):
    _, node = walked
    mapper, disk_tier = node._mapper, node._session._checkpointer.disk_tier
    versions = mapper.store.versions()
    disk_tier.page_in(mapper.store, list(disk_tier.blocks), mapper.T_map_anchor)
    assert mapper.store.versions() == versions
    disk_tier.page_out(mapper.store, groups_of(mapper.store, mapper.T_map_anchor), mapper.T_map_anchor)
    assert mapper.store.versions() == versions


# --- sessions ---


def test_a_checkpoint_includes_gaussians_on_disk_and_resumes_with_or_without_a_budget(walked):
    folder, node = walked
    list(node.drain())
    node.close()
    session = SessionFolder(folder)
    assert session.manifest()["version"] == 2
    assert (
        session.manifest()["gaussians"]
        == node._mapper.store.count + node._session._checkpointer.disk_tier.count
    )
    again = make(folder)
    assert again._mapper.store.count == node._mapper.store.count
    assert again._mapper.store.paged_out == node._mapper.store.paged_out
    again.close()
    disk_tier, mapper = node._session._checkpointer.disk_tier, node._mapper
    disk_tier.page_in(mapper.store, list(disk_tier.blocks), mapper.T_map_anchor)
    expected = rows(mapper.store)
    np.testing.assert_array_equal(rows(store_of(session.read_state())), expected)
    free = make(folder, memory_mb=None, session_every_s=1.0)
    np.testing.assert_array_equal(rows(free._mapper.store), expected)
    list(free.drain())
    free.close()
    assert session.manifest()["version"] == 1
    assert session.block_numbers() == []
    np.testing.assert_array_equal(rows(store_of(session.read_state())), expected)


def test_a_killed_mapper_finds_all_blocks_of_its_checkpoint(tmp_path):
    """Blocks are written and read after the checkpoint; the files of those that it lists still exist."""
    node = walk(make(tmp_path / "s", session_every_s=25.0), range(PLACES))
    node.close()  # no drain: as if killed
    session = SessionFolder(tmp_path / "s")
    named = {block.number for block in blocks_of(session.read_state(whole=False))}
    assert named
    assert named <= set(session.block_numbers())
    assert store_of(session.read_state()).count == session.manifest()["gaussians"]
    again = insert_waiting(make(tmp_path / "s", session_every_s=2.0))
    assert len(again._mapper.keyframes) + len(again._mapper.paged_out) == PLACES
    walk(again, range(PLACES, PLACES + 6))
    list(again.drain())
    assert set(session.block_numbers()) == set(again._session._checkpointer.disk_tier.blocks)
    again.close()


def test_the_same_walk_gives_the_same_bytes(tmp_path):
    nodes = [walk(make(tmp_path / name), range(PLACES + 10)) for name in "ab"]
    a, b = (node._mapper for node in nodes)
    assert a.store.paged_out == b.store.paged_out != {}
    for name in a.store._arrays():
        x, y = (getattr(m.store, name)[..., : m.store.count] for m in (a, b))
        np.testing.assert_array_equal(x, y)
    files = [sorted((tmp_path / name).rglob("*.block")) for name in "ab"]
    assert [f.read_bytes() for f in files[0]] == [f.read_bytes() for f in files[1]]
    for node in nodes:
        node.close()


# --- faults ---


def test_a_budget_that_the_current_view_exceeds_is_reported(tmp_path, caplog):
    node, sent = make(tmp_path / "s", memory_mb=PROCESS_MB + 1.0), {}
    walk(node, range(1), sent)
    first = node._mapper.store.count
    walk(node, range(1, 12), sent)
    assert node._mapper.store.count <= first  # no insertion without room
    assert sent["mapping/status"][-1].session.startswith(
        "MEMORY BUDGET EXCEEDED: what the newest keyframes observe takes "
    )
    assert "MEMORY BUDGET EXCEEDED" in node.detail
    assert "the memory budget is exceeded" in caplog.text
    node.close()


def test_gaussians_that_cannot_be_written_stay_in_memory_and_this_is_reported(tmp_path, monkeypatch):
    node = walk(make(tmp_path / "s", session_every_s=1e6), range(8))
    (tmp_path / "s" / "edge" / "gaussians").rmdir()
    sent = {}
    walk(node, range(8, PLACES), sent)
    assert node._mapper.store.paged_out_count == 0
    assert "Gaussians cannot be written to disk: No such file" in sent["mapping/status"][-1].session
    (tmp_path / "s" / "edge" / "gaussians").mkdir()
    walk(node, range(PLACES, PLACES + 3), sent)
    assert node._mapper.store.paged_out_count > 0
    assert "MEMORY BUDGET EXCEEDED" not in sent["mapping/status"][-1].session
    node.close()


@pytest.mark.parametrize("harm", ["cut", "gone", "altered", "empty"])
def test_a_broken_block_loses_only_its_gaussians_and_is_reported(walked, harm, caplog):
    _, node = walked
    mapper, disk_tier = node._mapper, node._session._checkpointer.disk_tier
    block = next(b for b in disk_tier.blocks.values() if b.anchor == 0)
    path = block_file(disk_tier._folder.blocks, block.number)
    blob = bytearray(path.read_bytes())
    blob[len(blob) // 2] ^= 0xFF
    {"cut": lambda: path.write_bytes(path.read_bytes()[:-40]), "gone": path.unlink,
     "altered": lambda: path.write_bytes(blob), "empty": lambda: path.write_bytes(b"")}[harm]()  # fmt: skip
    total, version = mapper.store.count + disk_tier.count, mapper.store.versions()[0]
    disk_tier.page_in(mapper.store, list(disk_tier.blocks), mapper.T_map_anchor)
    assert disk_tier.lost_count == block.count
    assert mapper.store.count == total - block.count
    assert mapper.store.versions()[0] > version
    assert mapper.store.paged_out == {}
    assert path.name in caplog.text
    assert f"{block.count} Gaussians lost" in node._session._checkpointer.status_text(mapper)
    arrays = {"anchor_id": np.array([0]), "anchor_T_map": np.eye(4)[None], **arrays_of_blocks([block])}
    with pytest.raises(UserError, match=path.name):
        with_blocks(disk_tier._folder.blocks, arrays)


def test_a_manifest_of_a_newer_program_is_refused(walked):
    folder, node = walked
    list(node.drain())
    path = folder / "edge" / EDGE_MANIFEST
    path.write_text(path.read_text().replace('"version": 2', '"version": 3'))
    with pytest.raises(UserError, match="version 3, this program reads 1 to 2"):
        SessionFolder(folder).read_state()


# --- visibility ---


def test_spheres_in_the_image_intersect_the_frustum_and_distant_ones_do_not():
    """Points of a sphere that fall into the picture make the sphere seen; ten radii off its pyramid it is
    not.
    """
    chance = np.random.default_rng(4)
    T_map_camera = gallery.T_map_camera(3)
    centres, radii = chance.uniform(-12, 12, (4000, 3)), chance.uniform(0.05, 1.5, 4000)
    on = chance.normal(size=(4000, 200, 3))
    points = centres[:, None] + on / np.linalg.norm(on, axis=2, keepdims=True) * radii[:, None, None]
    c, inward = gallery.CAMERA, inverse(T_map_camera)
    x, y, z = np.moveaxis(points @ inward[:3, :3].T + inward[:3, 3], 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = x / z * c.fx_px + c.cx_px, y / z * c.fy_px + c.cy_px
    inside = (
        (z > 0.1) & (z < 6.0) & (u > -0.5) & (v > -0.5) & (u < c.width_px - 0.5) & (v < c.height_px - 0.5)
    )
    seen = frustum_intersects(c, T_map_camera, 6.0, centres, radii)
    assert seen[inside.any(axis=1)].all()
    assert 60 < seen.sum() < 400
    behind = (centres - T_map_camera[:3, 3]) @ T_map_camera[:3, 2] < -radii
    assert not seen[behind].any()
    assert frustum_intersects(c, T_map_camera, MAX_DEPTH_M, centres, radii).sum() > seen.sum()


def test_a_sphere_is_seen_unless_it_is_behind_the_depths_of_all_tiles_that_it_covers():
    """Points of a sphere that are nearer than the depth of their tile make it seen; behind a wall that fills
    the image nothing is.
    """
    chance = np.random.default_rng(5)
    c, T_map_camera = gallery.CAMERA, gallery.T_map_camera(3)
    reach_m = chance.uniform(1.0, 12.0, (6, 8))
    centres, radii = chance.uniform(-12, 12, (4000, 3)), chance.uniform(0.05, 1.5, 4000)
    on = chance.normal(size=(4000, 200, 3))
    points = centres[:, None] + on / np.linalg.norm(on, axis=2, keepdims=True) * radii[:, None, None]
    inward = inverse(T_map_camera)
    x, y, z = np.moveaxis(points @ inward[:3, :3].T + inward[:3, 3], 2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = x / z * c.fx_px + c.cx_px, y / z * c.fy_px + c.cy_px
    inside = (z > 0.1) & (u > -0.5) & (v > -0.5) & (u < c.width_px - 0.5) & (v < c.height_px - 0.5)
    row = np.clip((np.where(inside, v, 0.0) + 0.5) / c.height_px * 6, 0, 5).astype(int)
    column = np.clip((np.where(inside, u, 0.0) + 0.5) / c.width_px * 8, 0, 7).astype(int)
    inside &= z < reach_m[row, column]
    seen = frustum_intersects(c, T_map_camera, reach_m, centres, radii)
    assert seen[inside.any(axis=1)].all()
    whole = frustum_intersects(c, T_map_camera, 12.0, centres, radii)
    assert 30 < seen.sum() < 0.8 * whole.sum()
    assert not (seen & ~whole).any()
    depth_m = (centres - T_map_camera[:3, 3]) @ T_map_camera[:3, 2]
    wall = frustum_intersects(c, T_map_camera, np.full((6, 8), 3.0), centres, radii)
    assert not wall[depth_m - radii > 3.0].any()


def test_the_visible_range_is_that_of_each_tile_and_far_where_a_doorway_has_no_depth():
    shape = (gallery.CAMERA.height_px, gallery.CAMERA.width_px)
    depth_m = np.full(shape, 2.0, np.float32)
    depth_m[:, : shape[1] // 2] = 5.0
    depth_m[-shape[0] // 6 :, -shape[1] // 8 :] = np.nan
    frame = RgbdKeyframe(
        0,
        np.zeros((*shape, 3), np.uint8),
        gallery.CAMERA,
        np.eye(4),
        depth_m,
        np.full(shape, 0.1, np.float32),
    )
    reach_m = visible_range_m(frame)
    np.testing.assert_allclose(reach_m[:, :4], 6.0, atol=1e-6)
    np.testing.assert_allclose(reach_m[:5, 4:], 2.7, atol=1e-6)
    assert reach_m[5, 7] >= 20.0


def test_groups_contain_all_gaussians_of_a_cell_and_their_spheres_the_rendered_extents(walked):
    _, node = walked
    store, places = node._mapper.store, node._mapper.T_map_anchor
    groups = groups_of(store, places)
    members = np.sort(np.concatenate([g.members for g in groups]))
    size = np.exp(store.params[SCALE : SCALE + 3, : store.count].max(axis=0))
    np.testing.assert_array_equal(members, np.flatnonzero(3.4 * size < CELL_M))
    for group, centre, radius in zip(groups, *spheres_of(groups, places)[1:]):
        off = (
            np.linalg.norm(store.params[MEAN:SCALE, group.members].T - centre, axis=1)
            + 3.4 * size[group.members]
        )
        assert off.max() <= radius + 1e-4
        assert np.ptp(store.params[MEAN:SCALE, group.members], axis=1).max() <= CELL_M + 1e-4


def test_spherical_harmonics_leave_and_return_with_their_gaussians(tmp_path):
    out = tmp_path / "out"
    node = walk(make(tmp_path / "s", sh_degree=1, save=out, session_every_s=1e6), range(20))
    mapper, tier = node._mapper, node._session._checkpointer.disk_tier
    total = mapper.store.count + tier.count
    assert tier.count > 0
    list(node.drain())
    node.close()
    vertices = PlyData.read(out / "splats.ply")["vertex"]
    assert vertices.count == total
    assert np.abs(vertices["f_rest_8"]).max() > 0.0
    store = store_of(SessionFolder(tmp_path / "s").read_state())
    assert (store.degree, store.count) == (1, total)
    np.testing.assert_array_equal(np.sort(vertices["f_rest_2"]), np.sort(store.harmonics[2, :total]))
    plain = make(tmp_path / "s", sh_degree=0)  # whoever continues it without harmonics leaves them out
    assert plain._mapper.store.count + plain._session._checkpointer.disk_tier.count == total
    walk(plain, [20])
    list(plain.drain())
    plain.close()
    assert store_of(SessionFolder(tmp_path / "s").read_state()).degree == 0
