"""Adapters on graphs with the exact contracts of their networks, and what they say about wrong ones."""

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.onnx_model import OnnxModel, available_providers, to_hw
from beamsplat.services.depth.depth_anything import network_input_size
from beamsplat.services.depth.fastdepth import network_crop
from beamsplat.services.depth.source import DepthInput, make_source
from beamsplat.services.depth.unidepth import letterbox_layout, network_rays

pytest.importorskip("onnx", reason="needs the package onnx, which builds the graphs")
from tests.services.depth import graphs

CAMERA = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)


def _view(camera=CAMERA, image=None):
    if image is None:
        ramp = np.linspace(10, 240, camera.width_px)[None].repeat(camera.height_px, 0)
        image = np.repeat(ramp[..., None], 3, axis=2).astype(np.uint8)
    return DepthInput(1, image, camera)


def test_fastdepth_gets_rgb_in_0_1_of_its_own_view(tmp_path):
    graphs.channel_mean(tmp_path / "net.onnx", factor=8.0)
    estimate = make_source("fastdepth", {"model": tmp_path / "net.onnx"}).estimate(_view())
    assert estimate.ok
    assert estimate.kind == "metric"
    u0, v0, u1, v1, factor = network_crop(CAMERA)
    assert factor == 1.0
    assert abs(u1 - u0 - 530 / 0.889) <= 1.0
    assert abs(v1 - v0 - 530 / 1.187) <= 1.0
    inside = estimate.values[v0 + 5 : v1 - 5, u0 + 5 : u1 - 5]
    truth = 8.0 * _view().image_rgb[v0 + 5 : v1 - 5, u0 + 5 : u1 - 5, 0] / 255.0
    assert np.nanmax(np.abs(inside - truth)) < 0.05
    assert np.isnan(estimate.values[:v0]).all()
    assert np.isnan(estimate.values[:, :u0]).all()


def test_a_narrow_lens_shows_the_network_less_and_the_depth_is_scaled():
    narrow = Pinhole(900.0, 900.0, 319.5, 239.5, 640, 480)
    u0, v0, u1, v1, factor = network_crop(narrow)
    assert (u0, v0, u1, v1) == (0, 0, 640, 480)
    assert factor == pytest.approx(900.0 / 640.0 / 0.889)


@pytest.mark.parametrize("value", [0.0, np.nan, 2.0])
def test_a_network_that_returns_rubbish_is_not_believed(tmp_path, value):
    graphs.constant_depth(tmp_path / "net.onnx", value)
    assert not make_source("fastdepth", {"model": tmp_path / "net.onnx"}).estimate(_view()).ok


@pytest.mark.parametrize("rank", [3, 4])
def test_depth_anything_takes_whatever_names_the_export_chose(tmp_path, rank):
    graphs.channel_mean(tmp_path / "net.onnx", "pixel_values", "predicted_depth", rank=rank)
    estimate = make_source("depth_anything", {"model": tmp_path / "net.onnx", "input_px": 126}).estimate(
        _view()
    )
    assert estimate.kind == "disparity"
    image = _view().image_rgb / 255.0
    truth = np.mean((image - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225], axis=2)
    assert estimate.values.shape == (480, 640)
    assert np.median(np.abs(estimate.values - truth)) < 0.01
    assert np.abs(estimate.values - truth)[:, 4:-4].max() < 0.06


@pytest.mark.parametrize(
    ("size", "input_px", "expected"),
    [
        ((480, 640), 518, (518, 686)),
        ((480, 640), 252, (252, 336)),
        ((720, 1280), 252, (252, 448)),
        ((640, 480), 196, (266, 196)),
    ],
)
def test_network_size_follows_the_reference(size, input_px, expected):
    side = network_input_size(*size, input_px)
    assert side == expected
    assert side[0] % 14 == side[1] % 14 == 0


def test_a_fixed_graph_is_fed_its_own_size(tmp_path):
    graphs.channel_mean(tmp_path / "net.onnx", "image", "depth", side=(140, 182), factor=2.0)
    metric = make_source("depth_anything_metric", {"model": tmp_path / "net.onnx"})
    estimate = metric.estimate(_view())
    assert estimate.kind == "metric"
    assert not np.nanmin(estimate.values) <= 0.0
    graphs.channel_mean(tmp_path / "odd.onnx", "image", "depth", side=(140, 180))
    with pytest.raises(UserError, match="multiple of 14"):
        make_source("depth_anything_metric", {"model": tmp_path / "odd.onnx"})


@pytest.mark.parametrize("shape", [(480, 640), (300, 700)])
def test_unidepth_depth_is_z_and_rays_are_those_of_the_camera(tmp_path, shape):
    camera = Pinhole(500.0, 510.0, shape[1] / 2 - 7.0, shape[0] / 2 + 3.0, shape[1], shape[0])
    graphs.unidepth(tmp_path / "net.onnx", side=(140, 182))
    estimate = make_source("unidepth", {"model": tmp_path / "net.onnx"}).estimate(_view(camera))
    rays = camera.ray_grid()
    truth = 3.0 / np.linalg.norm(rays, axis=2)  # points 3 m away: z = 3 cos
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(estimate.values - truth)[inner].max() < 0.01
    assert np.allclose(estimate.confidence, 0.8)


def test_unidepth_rays_have_centres_at_half_integers():
    camera = Pinhole(500.0, 500.0, 319.5, 239.5, 640, 480)
    side = (240, 320)
    rays = network_rays(camera, letterbox_layout(480, 640, side), side)[0]
    assert np.allclose(np.linalg.norm(rays, axis=0), 1.0, atol=1e-6)
    direction = rays / rays[2]
    # The pixel (0, 0) of the network covers ours at (0.5, 0.5): the average of four.
    assert np.allclose(direction[:2, 0, 0], [(0.5 - 319.5) / 500.0, (0.5 - 239.5) / 500.0], atol=1e-6)


def test_wrong_graphs_are_refused_with_file_and_reason(tmp_path):
    good = graphs.channel_mean(tmp_path / "net.onnx")
    with pytest.raises(UserError, match="rgbs"):
        make_source("unidepth", {"model": good})
    two = graphs.unidepth(tmp_path / "two.onnx")
    with pytest.raises(UserError, match="takes 2 inputs"):
        make_source("fastdepth", {"model": two})
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(UserError, match=r"text\.onnx: not an ONNX graph"):
        OnnxModel(tmp_path / "text.onnx")
    with pytest.raises(UserError, match="BEAMSPLAT_MODELS"):
        make_source("fastdepth", {"model": tmp_path / "absent.onnx"})
    with pytest.raises(UserError, match="there is no depth source"):
        make_source("unknown")
    with pytest.raises(UserError, match="unexpected keyword"):
        make_source("stixel", {"colour": 3})


def test_channels_last_is_named_as_such(tmp_path):
    from onnx import helper

    nodes = [helper.make_node("ReduceMean", ["image"], ["depth"], axes=[3], keepdims=0)]
    graphs.save(tmp_path / "net.onnx", nodes, [("image", (None, 224, 224, 3))], [("depth", (None, 224, 224))])
    with pytest.raises(UserError, match="channels last"):
        OnnxModel(tmp_path / "net.onnx").image_input()


def test_a_graph_that_refuses_its_input_says_what_it_got(tmp_path):
    model = OnnxModel(graphs.channel_mean(tmp_path / "net.onnx", side=(64, 64)))
    with pytest.raises(UserError, match=r"\[1, 3, 32, 32\]"):
        model.run(np.zeros((1, 3, 32, 32), np.float32))
    assert model.run(np.ones((1, 3, 64, 64), np.float64))[0].shape == (1, 1, 64, 64)


def test_maps_come_in_three_ranks():
    for shape in ((1, 1, 4, 5), (1, 4, 5), (4, 5)):
        assert to_hw(np.zeros(shape), "net").shape == (4, 5)
    with pytest.raises(UserError, match="H x W"):
        to_hw(np.zeros((1, 2, 4, 5)), "net")


def test_the_cpu_is_always_the_last_resort():
    assert available_providers()[-1] == "CPUExecutionProvider"


def test_the_network_at_hand_answers_at_its_known_error(shared_dir, monkeypatch):
    """FastDepth on real images of a kitchen: AbsRel 0.24 as probed elsewhere on these weights."""
    import cv2

    from beamsplat.services.depth.recorded import read_depth
    from beamsplat.services.replay.options import SourceOptions
    from beamsplat.services.replay.source import open_source
    from beamsplat.tools.evaluation.depth_replay import truth_depth_files

    monkeypatch.setenv("BEAMSPLAT_MODELS", str(shared_dir / "models"))
    source = make_source("fastdepth")
    camera = Pinhole(526.4, 526.4, 317.2, 237.2, 640, 480)
    files = truth_depth_files(shared_dir / "data" / "redkitchen")
    bag = open_source(shared_dir / "data" / "redkitchen", SourceOptions())
    errors = []
    for _, topic, message in bag.messages():
        if topic != "camera/image" or message.stamp_ns not in list(files)[::10]:
            continue
        rgb = cv2.cvtColor(cv2.imdecode(message.data, 1), cv2.COLOR_BGR2RGB)
        z = source.estimate(DepthInput(message.stamp_ns, rgb, camera)).values
        truth = read_depth(files[message.stamp_ns])
        ok = np.isfinite(truth) & np.isfinite(z)
        errors.append(np.mean(np.abs(z - truth)[ok] / truth[ok]))
    bag.close()
    assert len(errors) == 5
    assert 0.15 < np.mean(errors) < 0.33
