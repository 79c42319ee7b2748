"""The live mapper: keyframes in, chunks, renders and figures out; the same bytes each time; refusals; files."""

import hashlib
import math

import numpy as np
import pytest
from plyfile import PlyData

from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.common.mapfiles.store import transform_gaussians
from beamsplat.common.messages import Anchors, Keyframe, Tick
from beamsplat.common.messages.codec import encode
from beamsplat.common.messages.depth_codec import pack_depth, pack_mask, pack_sigma
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.services.keyframes.node import KeyframesConfig, KeyframesNode
from beamsplat.services.mapping.node import MappingConfig, MappingNode
from tests.services.mapping import room_drive as r


def run(tmp_path=None, jump_at=1000, **options):
    """(node, letters by topic, digest) of a short drive."""
    node = MappingNode(MappingConfig(save=tmp_path, half_steps=8, full_steps=6, tick_steps=5, **options))
    digest, letters = hashlib.sha256(), {}

    def on_message(letter):
        digest.update(letter.topic.encode() + encode(letter.message))
        letters.setdefault(letter.topic, []).append(letter.message)

    Lockstep(
        [r.RoomDrive(r.DriveConfig(pictures=14)), r.Localizer(r.LocalizerConfig(jump_at=jump_at)),
         r.Fusion(r.Fusion.Config()), KeyframesNode(KeyframesConfig(distance_m=0.15)), node],
        on_message,
    ).run()  # fmt: skip
    return node, letters, digest.hexdigest()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    return (*run(folder), folder)


def test_every_keyframe_is_answered_and_improves_the_map(drive):
    _, letters, _, _ = drive
    sent = [m.id for m in letters["keyframes/frame"]]
    assert len(sent) >= 6
    assert [m.id for m in letters["keyframes/ack"]] == sent
    assert all(m.status == "ok" for m in letters["keyframes/ack"])
    statuses = letters["mapping/status"]
    assert [s.keyframes for s in statuses] == list(range(1, len(sent) + 1))
    assert statuses[0].foretold_share == 0.0
    assert math.isnan(statuses[0].foretold_psnr_db)
    for status in statuses[2:]:
        assert status.foretold_share > 0.2  # opaque after a few steps only
        assert status.psnr_db > 21.0
        assert status.depth_error_m < 0.2  # of 4 m, after a hundred steps


def test_the_same_drive_gives_the_same_bytes_whatever_the_threads(drive):
    assert run(None)[2] == drive[2]
    assert run(None, threads=2)[2] == drive[2]
    assert run(None, seed=5)[2] != drive[2]


def test_chunks_make_up_the_map(drive):
    node, letters, _, _ = drive
    newest = {}
    for chunk in letters["mapping/chunk"]:
        assert chunk.revision > newest[chunk.anchor_id].revision if chunk.anchor_id in newest else True
        newest[chunk.anchor_id] = chunk
    assert set(newest) == {0, 1}
    store = node._mapper.store
    for anchor, chunk in newest.items():
        params = transform_gaussians(unpack(chunk.packed), chunk.T_map_anchor)
        assert params.shape[1] == chunk.count
        np.testing.assert_allclose(params[:3], store.chunk(anchor)[:3], atol=3e-4)
    assert sum(c.count for c in newest.values()) == store.count
    snapshot = list(node.on_query_snapshot({}))
    assert [(c.anchor_id, c.revision) for c in snapshot] == sorted((a, c.revision) for a, c in newest.items())


def test_the_preview_shows_what_the_camera_saw(drive):
    _, letters, _, _ = drive
    last = letters["mapping/preview"][-1]
    number = (last.stamp_ns - r.T0) // r.STEP
    rgb = r.shot(number)[0][::2, ::2].astype(float)
    shown = decode_rgb(last.render, "jpeg", r.WIDTH // 2, r.HEIGHT // 2).astype(float)
    assert np.corrcoef(rgb.ravel(), shown.ravel())[0, 1] > 0.9
    np.testing.assert_allclose(last.T_map_camera, r.T_map_body(number) @ r.T_BODY_CAMERA, atol=0.02)


def test_an_independent_reader_opens_the_ply_file(drive):
    node, letters, _, folder = drive
    vertices = PlyData.read(folder / "splats.ply")["vertex"]
    store = node._mapper.store
    assert vertices.count == store.count
    xyz = np.stack([vertices[axis] for axis in "xyz"])
    np.testing.assert_array_equal(xyz, store.params[:3, : store.count])
    opacity = 1.0 / (1.0 + np.exp(-vertices["opacity"].astype(float)))
    assert 0.2 < opacity.mean() <= 1.0
    rotation = np.stack([vertices[f"rot_{i}"] for i in range(4)])
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=0), 1.0, atol=1e-5)
    colour = 0.5 + 0.28209479177387814 * vertices["f_dc_0"]
    np.testing.assert_allclose(colour, store.params[11, : store.count], atol=1e-5)
    trajectory = read_tum(folder / "keyframes.tum")
    poses = letters["mapping/poses"][-1]
    assert len(trajectory) == len(poses.keyframe_ids) == len(node._mapper.keyframes)
    for stamp_ns, T in zip(poses.stamps_ns, poses.T_map_body):
        truth = r.T_map_body((stamp_ns - r.T0) // r.STEP)
        assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 0.02


def test_submaps_move_their_gaussians():
    """The pose graph moves submap 1 by a metre and ten degrees; -1 and 0 stay."""
    still, jumped = run(None)[1], run(None, jump_at=11)[1]
    moved = jumped["mapping/anchors"][-1]
    where = dict(zip(moved.anchor_ids.tolist(), moved.T_map_anchor))
    np.testing.assert_allclose(where[1], r.JUMP @ r.T_map_body(4), atol=1e-9)
    np.testing.assert_allclose(where[0], r.T_map_body(0), atol=1e-9)
    last = {c.anchor_id: c for c in jumped["mapping/chunk"]}[1]
    np.testing.assert_allclose(last.T_map_anchor, where[1], atol=1e-12)
    assert last.pose_revision == moved.pose_revision > 0
    final = jumped["mapping/status"][-1]
    assert final.keyframes == still["mapping/status"][-1].keyframes


def test_keyframes_at_the_odom_origin_move_with_the_oldest_submap():
    node = MappingNode(MappingConfig(half_steps=0, full_steps=0, mend_steps=0))
    node.configure()
    list(node.handle("keyframes/frame", keyframe(0, anchor_id=-1, T_map_anchor=np.eye(4))))
    before = node._mapper.store.params[:3, : node._mapper.store.count].copy()
    place = r.T_map_body(2)
    for number, T in enumerate((place, r.JUMP @ place)):
        anchors = Anchors(
            stamp_ns=number, anchor_ids=np.array([4]), T_map_anchor=T[None], optimisation=number
        )
        list(node.handle("localization/anchors", anchors))
    after = node._mapper.store.params[:3, : node._mapper.store.count]
    np.testing.assert_allclose(after, r.JUMP[:3, :3] @ before + r.JUMP[:3, 3:4], atol=1e-4)


# --- refusals, by hand ---


def keyframe(number, **change):
    rgb, depth = r.shot(number)
    fields = {
        "stamp_ns": r.T0 + number, "id": number, "encoding": "png", "picture": r.jpeg(rgb), "camera": r.CAMERA_MODEL,
        "anchor_id": 0, "T_anchor_body": r.T_map_body(number), "T_map_anchor": np.eye(4),
        "depth": pack_depth(depth), "sigma": pack_sigma(np.full_like(depth, 0.01)),
    }  # fmt: skip
    return Keyframe(**{**fields, **change})


@pytest.fixture(scope="module")
def node():
    node = MappingNode(MappingConfig(half_steps=4, full_steps=2))
    node.configure()
    for number in range(2):
        list(node.handle("keyframes/frame", keyframe(number)))
    return node


NAN = np.full((r.HEIGHT, r.WIDTH), np.nan, np.float32)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": pack_depth(NAN)}, "no pixel has a depth"),
        ({"mask": pack_mask(np.zeros((r.HEIGHT, r.WIDTH), bool))}, "the mask leaves no pixel"),
        ({"T_anchor_body": make_transform(np.eye(3), np.array([5e3, 0.0, 0.0]))}, "5000 m from its anchor"),
        ({"depth": np.arange(9, dtype=np.uint8)}, "depth: 9 bytes are too few"),
        (
            {"depth": pack_depth(NAN[:9, :9])},
            "depth: 2 bytes per pixel and 9x9 pixels, expected 2 and 160x120",
        ),
        ({"picture": np.zeros(0, np.uint8)}, "do not decode as png"),
        (
            {"mask": pack_mask(np.ones((7, 7), bool))},
            "mask: 1 bytes per pixel and 7x7 pixels, expected 1 and 160x120",
        ),
    ],
)
def test_invalid_keyframes_are_refused_with_a_reason_and_without_effect(node, change, words):
    store = node._mapper.store
    before, steps, refused = (
        store.params[:, : store.count].copy(),
        node._mapper.steps,
        len(node._intake.rejections),
    )
    out = dict(node.handle("keyframes/frame", keyframe(7, **change)))
    assert set(out) == {"keyframes/ack", "mapping/status"}
    assert out["keyframes/ack"].id == 7
    assert words in out["keyframes/ack"].status
    assert words in out["mapping/status"].status
    assert out["mapping/status"].refused == max(refused, 1)  # one that is refused again counts once
    assert words in node.detail
    assert node._mapper.steps == steps
    np.testing.assert_array_equal(store.params[:, : store.count], before)


def test_a_keyframe_sent_twice_is_acknowledged_twice_and_inserted_once(node):
    steps = node._mapper.steps
    out = list(node.handle("keyframes/frame", keyframe(1)))
    assert [topic for topic, _ in out] == ["keyframes/ack"]
    assert out[0][1].status == "ok"
    assert node._mapper.steps == steps


def test_keyframes_may_arrive_in_any_order(node):
    fresh = MappingNode(MappingConfig(half_steps=4, full_steps=2))
    fresh.configure()
    for number in (5, 0, 3):
        out = list(fresh.handle("keyframes/frame", keyframe(number)))
        assert out[0][1].status == "ok"
    assert list(fresh.drain())


def test_ticks_go_on_improving(node):
    before = node._mapper.steps
    out = dict(node.handle("tick", Tick(stamp_ns=r.T0, count=1)))
    while node.has_idle_work():
        assert list(node.handle_idle()) == []
    assert node._mapper.steps == before + node.config.tick_steps
    assert set(out) <= {"mapping/chunk"}


def test_without_keyframes_nothing_is_published():
    empty = MappingNode(MappingConfig())
    empty.configure()
    assert list(empty.handle("tick", Tick(stamp_ns=0, count=0))) == []
    assert list(empty.drain()) == []
    np.testing.assert_allclose(inverse(np.eye(4)), np.eye(4))
