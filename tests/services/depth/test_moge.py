"""MoGe-2: the shift of its point map, solved from the focal length and the beams, and its exact contract."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.beams import NO_BEAMS, Beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.services.depth.moge import centred_crop, solve_shift
from beamsplat.services.depth.source import DepthInput, make_source, uses_beams

pytest.importorskip("onnx", reason="needs the package onnx, which builds the graphs")
from tests.services.depth import graphs

CAMERA = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.45)


def _true_z(camera, T_body_camera=T_BODY_CAMERA):
    """Optical z (m) [H, W] of a corridor: floor, a wall 3 m ahead at the left and 5 m at the right."""
    rays = camera.ray_grid()
    wall = np.where(rays[..., 0] < 0.1, 3.0, 5.0)
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 1] > 0.0, T_body_camera[2, 3] / rays[..., 1], np.inf)
    return np.minimum(wall, floor)


def _network_points(camera, crop, shift, factor, rng=None):
    """What MoGe returns for the corridor: true points / factor, moved by -shift along z."""
    seen = Pinhole(
        crop.focal_px, crop.focal_px, crop.width_px / 2 - 0.5, crop.height_px / 2 - 0.5, crop.width_px,
        crop.height_px,
    )  # fmt: skip
    z = _true_z(seen)
    points = seen.ray_grid() * z[..., None] / factor
    if rng is not None:  # errors of a few per cent, each alike over some pixels
        coarse = rng.normal(0.0, 0.03, (6, 8))
        points *= np.exp(np.kron(coarse, np.ones((crop.height_px // 6 + 1, crop.width_px // 8 + 1))))[
            : crop.height_px, : crop.width_px, None
        ]
    points[..., 2] -= shift
    return points.astype(np.float32), z


def _beams(camera, T_body_camera=T_BODY_CAMERA, row_z=0.18, count=90):
    """Returns of the walls at the height of a lidar, with 1 cm of noise."""
    rng = np.random.default_rng(4)
    x = np.linspace(-0.55, 0.55, count)
    z = np.where(x < 0.1, 3.0, 5.0) + rng.normal(0.0, 0.01, count)
    points_camera = np.stack([x * z, np.full(count, T_body_camera[2, 3] - row_z), z], axis=1)
    points = transform_points(T_body_camera, points_camera)
    return Beams(points, np.arange(count), np.full(count, 0.01))


@given(st.floats(-0.5, 3.0), st.floats(0.3, 4.0), st.booleans())
def test_the_shift_is_found_from_the_focal_length_alone(shift, factor, noisy):
    crop = centred_crop(CAMERA, 60_000)
    points, z = _network_points(CAMERA, crop, shift, factor, np.random.default_rng(1) if noisy else None)
    valid = np.ones(z.shape, bool)
    found, scale = solve_shift(points, valid, crop, factor, np.zeros((0, 2)), np.zeros(0))
    assert scale == pytest.approx(factor, rel=1e-6)
    depth = scale * (points[..., 2] + found)
    assert np.mean(np.abs(depth - z) / z) < (0.05 if noisy else 1e-3)


def test_beams_correct_a_metric_scale_that_is_20_per_cent_wrong():
    crop = centred_crop(CAMERA, 60_000)
    points, z = _network_points(CAMERA, crop, 0.6, 1.7)
    from beamsplat.common.geometry.beams import project_beams

    uv, l_m, _ = project_beams(_beams(CAMERA), CAMERA, T_BODY_CAMERA)
    assert len(l_m) > 40
    valid = np.ones(z.shape, bool)
    shift, factor = solve_shift(points, valid, crop, 1.7 * 1.2, uv, l_m)
    error = np.abs(factor * (points[..., 2] + shift) - z) / z
    assert factor == pytest.approx(1.7, rel=0.04)
    assert error.mean() < 0.04
    outliers = l_m.copy()
    outliers[:8] = 0.4  # a chair leg
    shift, factor = solve_shift(points, valid, crop, 1.7 * 1.2, uv, outliers)
    assert factor == pytest.approx(1.7, rel=0.06)


def test_the_crop_is_centred_on_the_principal_point_and_has_square_pixels():
    camera = Pinhole(520.0, 540.0, 305.5, 251.5, 640, 480)
    crop = centred_crop(camera, 1200 * 196)
    assert crop.left_px == 0
    assert crop.right_px == pytest.approx(612, abs=1)
    assert crop.bottom_px == 480
    assert (crop.top_px + crop.bottom_px) / 2 == pytest.approx(camera.cy_px + 0.5, abs=0.5)
    fx = camera.fx_px * crop.width_px / (crop.right_px - crop.left_px)
    fy = camera.fy_px * crop.height_px / (crop.bottom_px - crop.top_px)
    assert fx == pytest.approx(crop.focal_px)
    assert fy == pytest.approx(fx, rel=5e-3)
    assert crop.width_px * crop.height_px == pytest.approx(1200 * 196, rel=0.02)
    square = centred_crop(camera, 0, (518, 518))
    assert (square.width_px, square.height_px) == (518, 518)
    assert square.right_px - square.left_px == pytest.approx(
        (square.bottom_px - square.top_px) * 520 / 540, abs=1.5
    )
    with pytest.raises(UserError, match="principal point"):
        centred_crop(Pinhole(520.0, 520.0, 2.0, 240.0, 640, 480), 1000)


def _image(camera):
    """The image from which the test's graph makes the point map of the corridor, in units of 1.25 m."""
    rays, z = camera.ray_grid(), _true_z(camera)
    image = np.stack([(rays[..., 0] + 1.0) / 2.0, (rays[..., 1] + 1.0) / 2.0, z / 1.25 / 8.0], axis=-1)
    return np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8), z


@pytest.mark.parametrize(("tokens", "side"), [(True, (None, None)), (False, (210, 280))])
@pytest.mark.parametrize("with_beams", [True, False])
def test_the_exact_contract_gives_metric_depth(tmp_path, tokens, side, with_beams):
    image, z = _image(CAMERA)
    image[:40, :, 2] = 0  # the mask excludes it
    graphs.moge(tmp_path / "net.onnx", side=side, tokens=tokens)
    source = make_source("moge", {"model": tmp_path / "net.onnx", "tokens": 400})
    assert uses_beams("moge", source)
    view = DepthInput(1, image, CAMERA, T_BODY_CAMERA, _beams(CAMERA) if with_beams else NO_BEAMS)
    estimate = source.estimate(view)
    assert estimate.ok, estimate.status
    assert estimate.kind == "metric"
    assert estimate.values.shape == (480, 640)
    assert np.isnan(estimate.values[:36]).all()
    known = np.isfinite(estimate.values)
    assert known[44:].mean() > 0.95
    error = np.abs(estimate.values - z)[known] / z[known]
    assert np.median(error) < 0.03  # 8 bits of the image are 3 cm
    assert np.mean(error) < 0.05


def test_the_number_of_tokens_arrives_as_a_number_and_sets_the_size(tmp_path):
    image, z = _image(CAMERA)
    graphs.moge(tmp_path / "net.onnx", seen=True)
    source = make_source("moge", {"model": tmp_path / "net.onnx", "tokens": 1250})  # metric_scale = 1.25
    values = source.estimate(DepthInput(1, image, CAMERA)).values
    assert np.nanmedian(np.abs(values - z) / z) < 0.03


@pytest.mark.parametrize("missing", ["points", "mask", "metric_scale"])
def test_a_graph_of_another_network_is_refused(tmp_path, missing):
    names = tuple(name for name in ("points", "mask", "metric_scale") if name != missing)
    graphs.moge(tmp_path / "net.onnx", outputs=names)
    with pytest.raises(UserError, match=f"net.onnx: has no output '{missing}'"):
        make_source("moge", {"model": tmp_path / "net.onnx"})


def test_wrong_inputs_and_options_are_named(tmp_path):
    graphs.channel_mean(tmp_path / "other.onnx", "pixel_values")
    with pytest.raises(UserError, match="num_tokens"):
        make_source("moge", {"model": tmp_path / "other.onnx"})
    graphs.moge(tmp_path / "net.onnx", tokens=False)
    with pytest.raises(UserError, match="dynamic"):
        make_source("moge", {"model": tmp_path / "net.onnx"})
    graphs.moge(tmp_path / "good.onnx")
    with pytest.raises(UserError, match="tokens = 5"):
        make_source("moge", {"model": tmp_path / "good.onnx", "tokens": 5})


def test_an_image_that_the_mask_excludes_is_refused(tmp_path):
    graphs.moge(tmp_path / "net.onnx")
    source = make_source("moge", {"model": tmp_path / "net.onnx", "tokens": 400})
    estimate = source.estimate(DepthInput(1, np.zeros((480, 640, 3), np.uint8), CAMERA))
    assert "mask" in estimate.status
    assert np.isnan(estimate.values).all()


def test_the_mount_has_no_effect_on_depth_without_beams(tmp_path):
    image, _ = _image(CAMERA)
    graphs.moge(tmp_path / "net.onnx")
    source = make_source("moge", {"model": tmp_path / "net.onnx", "tokens": 400})
    first = source.estimate(DepthInput(1, image, CAMERA, np.eye(4))).values
    other = source.estimate(DepthInput(1, image, CAMERA, inverse(T_BODY_CAMERA))).values
    np.testing.assert_array_equal(first, other)
