"""Depth Anything 3: graphs with the shapes and names of its exports, relative and metric."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.services.depth.source import DepthInput, make_source

pytest.importorskip("onnx", reason="needs the package onnx, which builds the graphs")
from tests.services.depth import graphs

CAMERA = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)


def _view():
    ramp = np.linspace(10, 240, CAMERA.width_px)[None].repeat(CAMERA.height_px, 0)
    return DepthInput(1, np.repeat(ramp[..., None], 3, axis=2).astype(np.uint8), CAMERA)


def _network_depth(image):
    """The depth that the graph makes of an image: the mean of the normalised channels + 3."""
    return 3.0 + np.mean((image / 255.0 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225], axis=2)


@pytest.mark.parametrize("views", [True, False])
@pytest.mark.parametrize("side", [(None, None), (504, 504)])
def test_small_models_give_relative_depth(tmp_path, views, side):
    """Views as a fifth dimension or not; a fixed square input is padded, not stretched."""
    graphs.depth_anything_3(tmp_path / "net.onnx", side=side, views=views)
    estimate = make_source("depth_anything_3", {"model": tmp_path / "net.onnx"}).estimate(_view())
    assert estimate.ok
    assert estimate.kind == "relative"
    error = np.abs(estimate.values - _network_depth(_view().image_rgb))
    assert np.median(error) < 0.01
    assert error[:, 6:-6].max() < 0.06
    assert np.allclose(estimate.confidence, 0.75, atol=1e-3)


@pytest.mark.parametrize("side", [(None, None), (280, 504)])
def test_the_metric_model_uses_the_focal_length_at_its_input(tmp_path, side):
    graphs.depth_anything_3(
        tmp_path / "net.onnx", side=side, views=False, names=("depth", "unused"), sky=True
    )
    estimate = make_source("depth_anything_3_metric", {"model": tmp_path / "net.onnx"}).estimate(_view())
    assert estimate.kind == "metric"
    assert estimate.confidence is None
    raw = _network_depth(_view().image_rgb)
    focal_px = 530.0 * ((252 if side[0] is None else 280) / 480)
    known = np.isfinite(estimate.values)
    assert np.median(np.abs(estimate.values - raw * focal_px / 300.0)[known]) < 0.01
    assert not known[raw > 4.7].any()  # sky
    assert known[raw < 4.3].all()


def test_other_graphs_are_refused(tmp_path):
    graphs.depth_anything_3(tmp_path / "odd.onnx", side=(500, 504))
    with pytest.raises(UserError, match="500 px is not a multiple of 14"):
        make_source("depth_anything_3", {"model": tmp_path / "odd.onnx"})
    graphs.depth_anything_3(tmp_path / "other.onnx", names=("normals", "confidence"))
    with pytest.raises(UserError, match="'predicted_depth' or 'depth'"):
        make_source("depth_anything_3", {"model": tmp_path / "other.onnx"})
    graphs.unidepth(tmp_path / "two.onnx")
    with pytest.raises(UserError, match="takes 2 inputs"):
        make_source("depth_anything_3", {"model": tmp_path / "two.onnx"})
    graphs.depth_anything_3(tmp_path / "net.onnx")
    with pytest.raises(UserError, match="input_px = 7"):
        make_source("depth_anything_3", {"model": tmp_path / "net.onnx", "input_px": 7})
