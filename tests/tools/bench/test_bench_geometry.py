"""`bench geometry`: which maps it makes, what of a drive it scores, and what depth buys a short one."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.geometry import (
    EstimatePrior,
    GeometryBenchSettings,
    cases_of,
    part_of,
    run_geometry,
    without_beams,
)
from beamsplat.tools.evaluation.dataset import load_dataset


@pytest.fixture(scope="module")
def house(shared_dir):
    return load_dataset(shared_dir / "data" / "house_a")


def test_the_maps_differ_in_the_weights_of_depth_alone():
    cases = list(cases_of(GeometryBenchSettings(weights=(0.0, 0.3), without_beams="fastdepth")))
    assert [case.depth_weight for case in cases] == [0.0, 0.3, 0.15, 0.15]
    assert [case.lidar_weight > 0.0 for case in cases] == [False, True, False, False]
    assert [case.beams for case in cases] == [True, True, True, False]
    for weights in ((), (-0.1,), (np.nan,)):
        with pytest.raises(UserError, match="--weight"):
            list(cases_of(GeometryBenchSettings(weights=weights)))


def test_a_part_of_a_drive_is_scored_at_the_views_that_it_comes_near_to(house):
    part = part_of(house, 20.0)
    assert 195 <= len(part.posed_images) <= 202
    assert 2 <= len(part.offpath_views) < len(house.offpath_views)
    positions = np.array([image.T_map_camera[:3, 3] for image in part.posed_images])
    for view in part.offpath_views:
        assert np.linalg.norm(positions - view.T_map_camera[:3, 3], axis=1).min() < 0.7
    assert len(part_of(house, None).posed_images) == len(house.posed_images)
    assert all(len(image.beams) == 0 for image in without_beams(part).posed_images)
    assert any(len(image.beams) for image in part.posed_images)


def test_a_source_that_needs_beams_cannot_map_without_them(house, shared_dir, monkeypatch):
    with pytest.raises(UserError, match="--without-beams stixel"):
        EstimatePrior("stixel")
    monkeypatch.setenv("BEAMSPLAT_MODELS", str(shared_dir / "models"))
    depth, sigma = EstimatePrior("fastdepth")(house, 8)
    known = np.isfinite(depth)
    assert 0.3 < known.mean() < 1.0
    assert np.median((sigma / depth)[known]) > 0.2  # an estimate that nothing has checked


@pytest.mark.slow
def test_depth_in_the_loss_improves_the_geometry(shared_dir, monkeypatch):
    """12 s of a drive: without depth in the loss, the surface moves away from where it was inserted."""
    bench = GeometryBenchSettings(weights=(0.0, 0.15), seconds=12.0, prior="stixel")
    result = run_geometry(shared_dir / "data" / "house_a", bench)
    appearance, both, no_beams_term = result["cases"]
    assert both["depth_l1_offpath_m"] < appearance["depth_l1_offpath_m"]
    for row in (appearance, both, no_beams_term):
        assert row["psnr_offpath_db"] > 10.0
        assert row["gaussians"] > 1000
        assert "fscore_5cm" not in row
    assert json.loads(json.dumps(result)) == result


def test_the_command_names_a_wrong_folder(tmp_path):
    from beamsplat.tools.cli.main import app

    with pytest.raises(UserError, match=r"groundtruth"):
        CliRunner().invoke(
            app, ["bench", "geometry", str(tmp_path), "--weight", "0.1"], catch_exceptions=False
        )
