"""The mapper on a synthetic room with known Gaussians: views it never saw, refusals, anchors, files."""

from dataclasses import replace

import numpy as np
import pytest

from beamsplat.common.geometry.transforms import inverse, make_transform, se3_exp, se3_log, so3_exp
from beamsplat.common.mapfiles.ply import FIELDS, SH_C0, read_ply_points, write_gaussian_ply
from beamsplat.common.mapfiles.scores import f_score, fused_surface, rgb_depth_alpha, score_view
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.layout import MEAN
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.mapper import FULL, HALF, Mapper
from beamsplat.services.mapping.settings import LearningRates, MapperSettings
from beamsplat.tools.bench.raster import synthetic_room
from tests.common.kernels import kernels_of

CAMERA = RasterCamera(110.0, 110.0, 79.5, 59.5, 160, 120)
SETTINGS = MapperSettings(half_iterations=10, full_iterations=5, stride_px=3)
NO_MOTION = LearningRates(
    mean_m=0.0, refined_mean_m=0.0, log_scale=0.0, quat=0.0, opacity_logit=0.0, colour=0.0
)


@pytest.fixture(scope="module")
def room():
    params, T_camera_map = synthetic_room(20_000)
    params[3:5] += 0.5
    params[10] = 3.0
    return params, inverse(T_camera_map)


def shot(room, T_map_camera):
    """What a camera with perfect depth sees of the room."""
    rasterizer = Rasterizer()
    render = rasterizer.render(room[0], 20_000, CAMERA, inverse(T_map_camera))
    rgb = (np.clip(render.image[:3].transpose(1, 2, 0), 0, 1) * 255 + 0.5).astype(np.uint8)
    depth = np.where(render.image[4] > 0.9, render.expected_depth(), np.nan).astype(np.float32)
    return rgb, depth


def view(room, number):
    """Poses along a short path: sideways steps and a turn."""
    return room[1] @ make_transform(so3_exp([0.0, 0.03 * number, 0.0]), np.array([0.08 * number, 0.0, 0.0]))


def keyframe(room, number, **change):
    T = view(room, number)
    rgb, depth = shot(room, T)
    return replace(
        RgbdKeyframe(number, rgb, CAMERA, T, depth, np.full(depth.shape, 0.01, np.float32)), **change
    )


def quality(mapper, room, T_map_camera):
    rgb, depth = shot(room, T_map_camera)
    return score_view(*rgb_depth_alpha(mapper.render(CAMERA, T_map_camera))[:2], rgb, depth)


@pytest.fixture(scope="module")
def mapped(room):
    mapper = Mapper(SETTINGS, seed=1)
    for number in range(5):
        assert mapper.add(keyframe(room, number), np.eye(4)).ok
        mapper.optimise()
    return mapper


def copy_of(mapper):
    """A second mapper with the same Gaussians and keyframes."""
    other = Mapper(mapper.settings, seed=2)
    for name in mapper.store._arrays():
        setattr(other.store, name, getattr(mapper.store, name).copy())
    other.store.count = mapper.store.count
    other.keyframes = {k: replace(v) for k, v in mapper.keyframes.items()}
    other.T_map_anchor = dict(mapper.T_map_anchor)
    other._newest = list(mapper._newest)
    return other


def test_held_out_views_are_close_to_the_truth(room, mapped):
    score = quality(mapped, room, view(room, 2.5))
    assert score.psnr_db > 23.0
    assert score.depth_l1_m < 0.10
    assert score.ssim > 0.8


def test_the_same_keyframes_give_the_same_bits(room, mapped):
    again = Mapper(SETTINGS, seed=1, threads=2)
    for number in range(5):
        again.add(keyframe(room, number), np.eye(4))
        again.optimise()
    assert again.store.count == mapped.store.count
    assert np.array_equal(
        again.store.params[:, : again.store.count], mapped.store.params[:, : mapped.store.count]
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth_m": np.full((120, 160), np.nan, np.float32)}, "no pixel has a depth"),
        ({"mask": np.zeros((120, 160), bool)}, "mask leaves no pixel"),
        ({"T_anchor_camera": make_transform(np.eye(3), np.array([1e6, 0.0, 0.0]))}, "from its anchor"),
        ({"T_anchor_camera": np.full((4, 4), np.nan)}, "rigid"),
        ({"rgb": np.zeros((120, 160, 3), np.float32)}, "image must be uint8"),
        ({"depth_m": np.ones((10, 10), np.float32)}, "depth and sigma"),
        ({"anchor": 7}, "the pose of anchor 7 is unknown"),
    ],
)
def test_invalid_keyframes_are_refused_without_effect(room, mapped, change, words):
    mapper = copy_of(mapped)
    before = mapper.store.params[:, : mapper.store.count].copy()
    outcome = mapper.add(keyframe(room, 4, id=99, **change), None)
    assert words in outcome.status
    assert 99 not in mapper.keyframes
    assert np.array_equal(mapper.store.params[:, : mapper.store.count], before)


def test_a_keyframe_is_taken_once(room, mapped):
    mapper = copy_of(mapped)
    assert mapper.add(keyframe(room, 3), np.eye(4)).inserted == 0
    assert mapper.store.count == mapped.store.count


def test_the_map_moves_with_its_anchor(room, mapped):
    """The camera and the Gaussians move together: the image does not change."""
    mapper = copy_of(mapped)
    jump = make_transform(so3_exp([0.0, 0.0, np.deg2rad(10.0)]), np.array([1.0, 0.0, 0.0]))
    before = rgb_depth_alpha(mapper.render(CAMERA, view(room, 2)))[0]
    assert mapper.move_anchors({0: jump}) == 1
    after = rgb_depth_alpha(mapper.render(CAMERA, jump @ view(room, 2)))[0]
    assert np.abs(after - before).mean() < 1e-4
    assert np.allclose(mapper.T_map_camera(mapper.keyframes[2]), jump @ view(room, 2))
    with pytest.raises(ValueError, match="rigid"):
        mapper.move_anchors({0: np.zeros((4, 4))})


def test_a_loop_closure_corrects_the_map(room):
    """Half of the keyframes are a metre and ten degrees off until the pose graph corrects them: after some
    steps the views between them are as good as in a map that never jumped.
    """
    jump = make_transform(so3_exp([0.0, 0.0, np.deg2rad(10.0)]), np.array([1.0, 0.0, 0.0]))
    scores = []
    for misplaced in (np.eye(4), jump):
        mapper = Mapper(SETTINGS, seed=1)
        for number in range(6):
            late = number >= 3
            assert mapper.add(keyframe(room, number, anchor=int(late)), misplaced if late else np.eye(4)).ok
            mapper.optimise()
        mapper.move_anchors({1: np.eye(4)})
        for number in (2, 4):
            assert np.allclose(mapper.T_map_camera(mapper.keyframes[number]), view(room, number))
        mapper.refine(60, HALF)
        scores.append(
            np.mean([quality(mapper, room, view(room, n)).psnr_db for n in (0.5, 1.5, 2.5, 3.5, 4.5)])
        )
    assert scores[0] > 22.0
    assert scores[1] > scores[0] - 0.5


def test_uncertain_depth_is_not_inserted_in_observed_free_space(room):
    """Doubtful depth half way to a wall that another keyframe sees well: nothing is inserted in free space."""
    mapper = Mapper(SETTINGS, seed=1)
    good = keyframe(room, 0)
    doubtful = replace(
        keyframe(room, 1), depth_m=0.5 * keyframe(room, 1).depth_m, sigma_m=0.4 * keyframe(room, 1).depth_m
    )
    assert mapper.add(good, np.eye(4)).ok
    assert mapper.add(doubtful, np.eye(4)).ok
    points = mapper.store.params[:3, : mapper.store.count]
    camera = inverse(view(room, 0))
    z = camera[2, :3] @ points + camera[2, 3]
    u = np.round((camera[0, :3] @ points + camera[0, 3]) / z * 110.0 + 79.5).astype(int)
    v = np.round((camera[1, :3] @ points + camera[1, 3]) / z * 110.0 + 59.5).astype(int)
    inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
    depth = good.depth_m[v[inside], u[inside]]
    assert np.nanmean(z[inside] < 0.7 * depth) < 0.15  # half of them without the check


def test_masked_pixels_have_no_effect(room):
    """A grey sheet hangs before half of the picture; with a mask the map does not learn its colour."""
    results = []
    for masked in (False, True):
        mapper = Mapper(SETTINGS, seed=1)
        mapper.add(keyframe(room, 0), np.eye(4))
        mapper.optimise()
        frame = keyframe(room, 0, id=1)
        rgb = frame.rgb.copy()
        rgb[:, 80:] = 128
        mask = np.ones((120, 160), bool)
        mask[:, 80:] = not masked
        mapper.add(replace(frame, rgb=rgb, mask=mask), np.eye(4))
        for _ in range(20):
            mapper.step(mapper.keyframes[1], FULL)
        results.append(quality(mapper, room, view(room, 0)).psnr_db)
    assert results[1] > results[0] + 3.0
    assert results[1] > 22.0


def test_old_keyframes_are_dropped_within_the_limit(room):
    mapper = Mapper(replace(SETTINGS, max_keyframes=4, half_iterations=1, full_iterations=0), seed=1)
    for number in range(8):
        assert mapper.add(keyframe(room, number), np.eye(4)).ok
        mapper.optimise()
    assert len(mapper.keyframes) == 4
    assert 7 in mapper.keyframes
    gone = next(n for n in range(8) if n not in mapper.keyframes)
    before = mapper.store.count
    assert mapper.add(keyframe(room, gone), np.eye(4)).inserted == 0  # sent again: it has been dealt with
    assert mapper.store.count == before


def test_pose_refinement_undoes_a_planted_error(room, mapped):
    mapper = copy_of(mapped)
    mapper.settings = replace(
        SETTINGS, refine_pose=True, rates=replace(NO_MOTION, pose_m=1e-3, pose_rad=1e-3)
    )  # the map is right; only the pose may move
    held = mapper.keyframes[2]
    held.pose_first, held.pose_second = np.zeros(6), np.zeros(6)
    error = se3_exp(np.array([0.02, -0.01, 0.015, 0.01, -0.008, 0.006]))
    held.T_anchor_camera = held.T_anchor_camera @ error
    for _ in range(120):
        mapper.step(held, FULL)
    left = se3_log(inverse(view(room, 2)) @ mapper.T_map_camera(held))
    assert np.linalg.norm(left[:3]) < 0.006
    assert np.linalg.norm(left[3:]) < 0.003
    assert np.linalg.norm(se3_log(held.delta)[:3]) <= mapper.settings.max_pose_m * np.sqrt(3)


def test_exposure_compensates_a_brighter_image(room, mapped):
    mapper = copy_of(mapped)
    mapper.settings = replace(
        SETTINGS, refine_exposure=True, ssim_every=1, rates=replace(NO_MOTION, exposure=5e-3)
    )
    held = mapper.keyframes[1]
    held.exposure, held.exposure_first, held.exposure_second = (
        np.zeros(6, np.float32),
        np.zeros(6),
        np.zeros(6),
    )
    level = replace(held.levels[HALF], rgb=(held.levels[HALF].rgb * 0.8).astype(np.uint8))
    held.levels = [held.levels[FULL], level]
    first = mapper.step(held, HALF)
    for _ in range(100):
        last = mapper.step(held, HALF)
    assert last < 0.5 * first
    assert np.all(held.exposure[:3] < -0.05)


def test_gaussians_in_front_of_a_trusted_surface_are_carved(room, mapped):
    mapper = copy_of(mapped)
    ahead = view(room, 2) @ np.array([0.0, 0.0, 0.6, 1.0])
    floater = mapper.store.params[:, :16].copy()
    floater[MEAN : MEAN + 3] = ahead[:3, None] + np.random.default_rng(0).normal(0, 0.02, (3, 16))
    floater[3:6] = np.log(0.01)
    before = mapper.store.count
    mapper.store.add(floater, 0)
    mapper.settings = replace(SETTINGS, carve_votes=2)
    for _ in range(2):
        mapper._prune(mapper.keyframes[2])
    # Gaps are closed when they are many; until then floaters are marked.
    left = mapper.store.carving_votes[before : mapper.store.count] < 2
    assert mapper.store.count < before or left.mean() < 0.2
    assert mapper.store.count >= before - 200


def test_gaussians_keep_their_anchor_when_arrays_grow():
    """More than fit: all arrays are replaced by larger ones while they are added."""
    store = GaussianStore(capacity=16)
    for anchor, count in ((7, 10), (8, 30), (9, 500), (7, 3000)):
        store.add(np.zeros((14, count), np.float32), anchor)
    expected = {7: 3010, 8: 30, 9: 500}
    assert {chunk.anchor: chunk.params.shape[1] for chunk in store.chunks()} == expected


def test_surface_of_the_map_is_that_of_the_room(room, mapped):
    views = [(CAMERA, view(room, n)) for n in range(5)]
    truth = room[0][:3, :20_000].T.astype(float)
    points = fused_surface(lambda c, T: rgb_depth_alpha(mapped.render(c, T)), views)
    scores = f_score(points, truth)
    assert scores["accuracy_m"] < 0.10  # the truth itself is a point every 7 cm
    assert f_score(truth, truth)["fscore_5cm"] == 1.0
    assert f_score(np.zeros((0, 3)), truth)["fscore_5cm"] == 0.0


def test_ply_is_what_inria_writes(tmp_path, mapped):
    params = mapped.store.params[:, : mapped.store.count]
    write_gaussian_ply(tmp_path / "map.ply", params)
    blob = (tmp_path / "map.ply").read_bytes()
    header, body = blob.split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in header.split(b"\n") if line.startswith(b"property")]
    assert names == list(FIELDS)
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names))
    assert len(rows) == params.shape[1]
    column = {name: rows[:, i] for i, name in enumerate(names)}
    assert np.allclose(0.5 + SH_C0 * column["f_dc_1"], params[12], atol=1e-6)
    assert np.array_equal(column["scale_2"], params[5])
    assert np.array_equal(column["opacity"], params[10])
    assert np.allclose(np.linalg.norm(rows[:, 13:17], axis=1), 1.0, atol=1e-5)
    assert np.array_equal(read_ply_points(tmp_path / "map.ply"), params[:3].T.astype(float))


def test_chunk_versions_show_what_has_changed(room, mapped):
    mapper = copy_of(mapped)
    mapper.store._events = {0: 1}
    known = mapper.store.versions()
    assert mapper.store.chunks(known) == []
    assert mapper.store.chunks()[0].params.shape == (14, mapper.store.count)
    before = mapper.store.params[:, : mapper.store.count].copy()
    mapper.add(keyframe(room, 6, anchor=5), make_transform(so3_exp([0, 0, 0.3]), np.array([0.4, 0.0, 0.0])))
    assert [chunk.anchor for chunk in mapper.store.chunks(known)] == [5]
    assert np.array_equal(mapper.store.params[:, : before.shape[1]], before)  # all of anchor 0
    known = mapper.store.versions()
    mapper.step(mapper.keyframes[2], HALF)
    assert 0 in [chunk.anchor for chunk in mapper.store.chunks(known)]
    known = mapper.store.versions()
    assert mapper.move_anchors({5: np.eye(4)}) == 1
    assert mapper.store.chunks(known) == []  # in the frame of the anchor, nothing has changed


def test_warm_compiles_all_kernels_of_mapping():
    warmed, missing = kernels_of(
        warm="from beamsplat.services.mapping.warm import warm; warm()",
        use="""
            import numpy as np
            from beamsplat.common.raster.camera import RasterCamera
            from beamsplat.services.mapping.keyframe import RgbdKeyframe
            from beamsplat.services.mapping.mapper import Mapper
            from beamsplat.services.mapping.settings import LearningRates, MapperSettings

            rng, mapper = np.random.default_rng(0), Mapper(MapperSettings(ssim_every=1), seed=1, threads=2)
            for number in range(3):
                depth_m = rng.uniform(1.9, 2.1, (120, 160)).astype(np.float32)
                T = np.eye(4)
                T[0, 3] = 0.1 * number
                keyframe = RgbdKeyframe(
                    number, rng.integers(0, 255, (120, 160, 3)).astype(np.uint8),
                    RasterCamera(110.0, 110.0, 79.5, 59.5, 160, 120), T, depth_m,
                    np.full((120, 160), 0.01, np.float32), mask=depth_m > 1.95,
                )
                assert mapper.add(keyframe, np.eye(4)).ok
                mapper.optimise()
            mapper.store.chunks()
        """,
    )
    assert len(warmed) >= 5
    assert missing == []
