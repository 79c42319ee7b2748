from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.rig import (
    Mount,
    RigFile,
    format_rig,
    load_rig,
    parse_rig,
    rotation_from_rpy,
    rpy_from_rotation,
)
from beamsplat.common.geometry.transforms import make_transform

RIG = """
assumed = ["the lidar's height was guessed"]

[camera]
width_px = 640
height_px = 480
fx_px = 530
fy_px = 530.0
cx_px = 319.5
cy_px = 239.5
distortion_model = "plumb_bob"
distortion = [0.1, 0.2, 0.0, 0.0, -0.5]

[camera.mount]
xyz_m = [0.1, 0.0, 0.45]
rpy_deg = [0.0, 2.0, 0.0]

[lidar.mount]
xyz_m = [0.0, 0.0, 0.18]
quat_xyzw = [0.0, 0.0, 0.0, 1.0]
"""


def test_rpy_of_a_camera_pitched_down_two_degrees():
    rig = parse_rig(RIG, "rig.toml").message(7, "rig.toml")
    expected = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=np.radians(2.0))
    assert np.allclose(rig.camera.T_body_camera, expected, atol=1e-12)
    view_body = rig.camera.T_body_camera[:3, :3] @ [0.0, 0.0, 1.0]
    assert view_body[2] == pytest.approx(-np.sin(np.radians(2.0)))
    assert np.allclose(rig.lidar.T_body_lidar, make_transform(np.eye(3), [0.0, 0.0, 0.18]))
    assert rig.camera.distortion == (0.1, 0.2, 0.0, 0.0, -0.5)
    assert rig.assumed == ("the lidar's height was guessed",)
    assert rig.stamp_ns == 7


def test_optical_quaternion_is_equivalent_to_rpy():
    quat = "quat_xyzw = [-0.5086500507968373, 0.5086500507968373, -0.4911976443595539, 0.4911976443595539]"
    rig = parse_rig(RIG.replace("rpy_deg = [0.0, 2.0, 0.0]", quat), "rig.toml")
    expected = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=np.radians(2.0))
    assert np.allclose(rig.camera.model().T_body_camera, expected, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(st.tuples(*[st.floats(-179, 179)] * 3))
def test_rpy_matches_urdf(degrees):
    R = rotation_from_rpy(*np.radians(degrees))
    assert np.allclose(R, Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), atol=1e-12)
    assert np.allclose(rotation_from_rpy(*rpy_from_rotation(R)), R, atol=1e-6)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_rpy_at_gimbal_lock(pitch):
    R = rotation_from_rpy(*np.radians([30.0, pitch, 50.0]))
    assert np.allclose(rotation_from_rpy(*rpy_from_rotation(R)), R, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 10**6),
    st.text(max_size=30),
    st.booleans(),
    st.booleans(),
)
def test_format_and_parse_round_trip(seed, source, with_camera, with_lidar):
    if not with_camera and not with_lidar:
        return
    rng = np.random.default_rng(seed)
    rig = parse_rig(RIG, "rig.toml").message(0, source)
    mounts = [make_transform(R, rng.uniform(-1, 1, 3)) for R in Rotation.random(2, rng=rng).as_matrix()]
    camera = rig.camera.model_copy(update={"T_body_camera": mounts[0]}) if with_camera else None
    lidar = rig.lidar.model_copy(update={"T_body_lidar": mounts[1]}) if with_lidar else None
    rig = rig.model_copy(update={"camera": camera, "lidar": lidar})
    again = parse_rig(format_rig(RigFile.of(rig), "header", {"camera": "K"}), "x").message(0, source)
    assert again.source == source
    if with_camera:
        assert np.allclose(again.camera.T_body_camera, mounts[0], atol=1e-7)
        assert again.camera.fx_px == 530.0
    if with_lidar:
        assert np.allclose(again.lidar.T_body_lidar, mounts[1], atol=1e-7)
    assert (again.camera is None, again.lidar is None) == (not with_camera, not with_lidar)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fx_px = 530", "fx_px = -530", ["camera.fx_px", "-530"]),
        ("fx_px = 530", "fx_px = nan", ["camera.fx_px"]),
        ("cx_px = 319.5", "cx_px = 800.0", ["camera", "800", "another image size"]),
        ("distortion = [0.1, 0.2, 0.0, 0.0, -0.5]", "distortion = [0.1]", ["plumb_bob", "got 1"]),
        ("width_px", "widht_px", ["widht_px", "unknown option"]),
        ("rpy_deg = [0.0, 2.0, 0.0]", "", ["camera.mount", "exactly one"]),
        ("rpy_deg = [0.0, 2.0, 0.0]", "rpy_deg = [0.0, 2.0]", ["camera.mount.rpy_deg"]),
        ("quat_xyzw = [0.0, 0.0, 0.0, 1.0]", "quat_xyzw = [1.0, 1.0, 0.0, 1.0]", ["unit quaternion"]),
        ("xyz_m = [0.1, 0.0, 0.45]", "xyz_m = [100.5, 0.0, 450.0]", ["camera.mount.xyz_m", "450"]),
        ("[camera]", "[camera", ["not a TOML file"]),
    ],
)
def test_errors_name_file_field_and_value(tmp_path, old, new, words):
    file = tmp_path / "rig.toml"
    assert old in RIG
    file.write_text(RIG.replace(old, new, 1))
    with pytest.raises(UserError) as caught:
        load_rig(file)
    for word in ["rig.toml", *words]:
        assert word in str(caught.value)


def test_an_empty_rig_and_a_missing_file(tmp_path):
    (tmp_path / "rig.toml").write_text("")
    with pytest.raises(UserError, match="neither"):
        load_rig(tmp_path / "rig.toml")
    with pytest.raises(UserError, match="beamsplat rig"):
        load_rig(tmp_path / "other.toml")


def test_the_size_of_the_file_is_limited(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text(RIG + "# calibrated in the yard\n" * 50_000)
    with pytest.raises(UserError, match=r"rig.toml: .*longer than 1000000 bytes"):
        load_rig(file)


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=60))
def test_arbitrary_text_raises_user_errors_only(text):
    with pytest.raises(UserError):
        parse_rig(text, "text")


def test_mount_of_transform_round_trip():
    T = make_transform(Rotation.random(rng=np.random.default_rng(1)).as_matrix(), [0.1, -0.2, 0.3])
    assert np.allclose(Mount.of(T).transform(np.eye(3)), T, atol=1e-12)
