"""Parts of the benchmarks: datasets with ground truth, depth priors, the synthetic room, names of the figures."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.tools.bench.depth_priors import find_prior
from beamsplat.tools.bench.fused_prior import DynamicObjectMasks, FusedDepthPrior
from beamsplat.tools.bench.mapping import (
    HELD_OUT_AT,
    HELD_OUT_EVERY,
    MapBenchSettings,
    make_keyframe,
    run_bench,
)
from beamsplat.tools.bench.raster import bench_raster, synthetic_room
from beamsplat.tools.evaluation.dataset import load_dataset


@pytest.fixture(scope="module")
def house(shared_dir):
    return load_dataset(shared_dir / "data" / "house_a")


def test_dataset_has_the_data_that_the_figures_need(house):
    assert len(house.posed_images) == 883
    assert len(house.offpath_views) == 40
    assert house.seconds == pytest.approx(88.2, abs=0.1)
    assert house.image(0).shape == (480, 640, 3)
    assert house.true_depth(8) is not None
    assert house.true_depth(HELD_OUT_AT) is None
    assert all(view.image_file.is_file() and view.depth_file.is_file() for view in house.offpath_views)


def test_stixel_prior_is_accurate_where_its_sigma_is_small(house):
    """Against true depth: a few centimetres at the median; a large sigma marks the upper parts of walls."""
    trusted, guessed = [], []
    for index in range(0, 883, 160):
        depth, sigma = find_prior("stixel")(house, index)
        error = np.abs(depth - house.true_depth(index))
        trusted.append(np.nanmedian(error[sigma < 0.05]))
        guessed.append(np.nanmean(error[sigma > 0.2]))
    assert np.median(trusted) < 0.03
    assert np.mean(guessed) > 3.0 * np.median(trusted)


def test_errors_of_the_fused_prior_agree_with_its_sigma(house):
    """Against true depth: two thirds of the trusted pixels are within two sigma."""
    prior = FusedDepthPrior("stixel")
    assert prior(house, 8) is not None
    depth, sigma = prior(house, 16)
    error, trusted = np.abs(depth - house.true_depth(16)), sigma < 0.03 * depth
    assert np.isfinite(depth).mean() > 0.7
    assert np.nanmedian(error[trusted]) < 0.03
    assert np.nanmean(error[trusted] < 2.0 * sigma[trusted]) > 0.66


def test_masks_of_dynamic_objects_are_almost_empty_in_a_static_house(house):
    masks, hidden = DynamicObjectMasks(), []
    for index in range(0, 60, 10):
        mask = masks(house, index, house.true_depth(0))
        hidden.append(0.0 if mask is None else 1.0 - mask.mean())
    assert np.mean(hidden) < 0.05


def test_keyframes_have_the_beams_at_their_time(house):
    frame = make_keyframe(house, 16, find_prior("truth")(house, 16))
    assert frame.fault() is None
    assert len(frame.beams_uvz) > 50
    u, v, z = frame.beams_uvz.T
    truth = house.true_depth(16)[np.round(v).astype(int), np.round(u).astype(int)]
    assert np.nanmedian(np.abs(truth - z)) < 0.03


def test_missing_ground_truth_is_named(tmp_path):
    with pytest.raises(UserError, match="groundtruth"):
        load_dataset(tmp_path)
    with pytest.raises(UserError, match="stixel"):
        find_prior("guess")


@pytest.mark.slow
def test_bench_map_shows_no_scored_view_to_the_mapper(shared_dir, monkeypatch):
    """A short drive has all fixed figures; images i % 8 == 2 never become keyframes."""
    import beamsplat.tools.bench.mapping as module

    taken = []

    def short(path):
        recording = load_dataset(path)
        recording.posed_images = recording.posed_images[:60]
        recording.offpath_views = recording.offpath_views[:2]
        return recording

    real = make_keyframe
    monkeypatch.setattr(module, "load_dataset", short)
    monkeypatch.setattr(module, "make_keyframe", lambda r, i, g: (taken.append(i), real(r, i, g))[1])
    result = run_bench(shared_dir / "data" / "house_a", MapBenchSettings(refine_s=1.0))
    assert all(i % HELD_OUT_EVERY != HELD_OUT_AT for i in taken)
    wanted = {
        "psnr_offpath_db",
        "psnr_heldout_db",
        "ssim_offpath",
        "depth_l1_offpath_m",
        "fscore_5cm",
        "gaussians",
    }
    assert wanted <= set(result["online"])
    assert wanted <= set(result["refined"])
    assert {"wall_s", "data_s", "peak_rss_mb", "keyframes"} <= set(result)


def test_synthetic_room_fills_the_image():
    params, T = synthetic_room(20_000)
    render = Rasterizer().render(params, 20_000, RasterCamera(288.0, 288.0, 159.5, 119.5, 320, 240), T)
    assert render.image[4].mean() > 0.5
    assert np.allclose(np.linalg.norm(params[6:10, :20_000], axis=0), 1.0, atol=1e-5)


def test_bench_raster_has_the_fixed_figures():
    cases = bench_raster(1000, 3)["cases"]
    for case in cases:
        assert {"gaussians", "width", "height", "backend", "threads", "forward_ms", "total_ms"} <= set(case)
    kinds = {(case["backend"], case["threads"], case["width"]) for case in cases}
    assert {("cpu", 1, 320), ("cpu", 2, 320), ("cpu", 2, 640), ("reference", 1, 320)} <= kinds
