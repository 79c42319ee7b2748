"""Splat files read by programs that are not ours: positions to a millimetre, colours to 1/255, axes, units."""

import json
import os
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from plyfile import PlyData

from beamsplat.common.geometry.transforms import matrix_from_quat_wxyz, matrix_from_quat_xyzw
from beamsplat.common.mapfiles.gltf import write_gltf
from beamsplat.common.mapfiles.ply import write_gaussian_ply
from beamsplat.common.mapfiles.spz import write_spz
from beamsplat.common.mapfiles.y_up import QUAT_XYZW, R_yup_map

EXTENSION = "KHR_gaussian_splatting"
SH_C0 = 0.28209479177387814


@pytest.fixture(scope="module")
def params():
    """float32 [14, 500]: positions over 60 m, unnormalised quaternions of either sign, colours a bit outside."""
    rng = np.random.default_rng(5)
    out = np.zeros((14, 500), np.float32)
    out[0:3] = rng.uniform(-30.0, 30.0, (3, 500))
    out[3:6] = rng.uniform(-6.0, 0.0, (3, 500))
    out[6:10] = rng.normal(size=(4, 500)) * rng.uniform(0.3, 2.0, 500)
    out[6:10, :4] = np.eye(4)  # one component alone, and all alike
    out[6:10, 4] = 0.5
    out[10] = rng.uniform(-4.0, 6.0, 500)
    out[11:14] = rng.uniform(-0.05, 1.05, (3, 500))
    return out


def covariance(R, scale):
    """[N, 3, 3]: what a Gaussian looks like, whatever the order of its axes or the sign of its quaternion."""
    return R @ (scale[:, :, None] ** 2 * np.eye(3)) @ R.transpose(0, 2, 1)


def true_covariance(params):
    R = np.array([matrix_from_quat_wxyz(q / np.linalg.norm(q)) for q in params[6:10].T.astype(float)])
    return covariance(R, np.exp(params[3:6].T.astype(float)))


def opacity_of(params):
    return 1.0 / (1.0 + np.exp(-params[10].astype(float)))


def test_ply_as_plyfile_reads_it(params, tmp_path):
    write_gaussian_ply(tmp_path / "map.ply", params)
    v = PlyData.read(tmp_path / "map.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([v[axis] for axis in "xyz"]), params[:3])
    quat = np.stack([v[f"rot_{i}"] for i in range(4)], axis=1).astype(float)
    scale = np.exp(np.stack([v[f"scale_{i}"] for i in range(3)], axis=1).astype(float))
    shape = covariance(np.array([matrix_from_quat_wxyz(q) for q in quat]), scale)
    np.testing.assert_allclose(shape, true_covariance(params), rtol=1e-4, atol=1e-6)
    colour = 0.5 + SH_C0 * np.stack([v[f"f_dc_{i}"] for i in range(3)])
    np.testing.assert_allclose(colour, params[11:14], atol=1e-5)


@pytest.mark.slow
def test_spz_as_gsply_reads_it(params, tmp_path):
    """The reader gives the file's own axes: y up."""
    gsply = pytest.importorskip("gsply", reason="needs gsply, a reader of SPZ: pip install gsply")
    write_spz(tmp_path / "map.spz", params)
    read = gsply.read_spz(tmp_path / "map.spz")
    np.testing.assert_allclose(read.means, (R_yup_map @ params[:3]).T, atol=1e-3)
    np.testing.assert_allclose(0.5 + SH_C0 * read.sh0, params[11:14].T, atol=1.0 / 255.0)
    opacity = 1.0 / (1.0 + np.exp(-np.asarray(read.opacities, float).reshape(-1)))
    np.testing.assert_allclose(opacity, opacity_of(params), atol=1.0 / 255.0)
    scale = np.exp(np.asarray(read.scales, float))
    np.testing.assert_allclose(scale, np.exp(params[3:6].T), rtol=0.033)  # a sixteenth of a nat, halved
    R = np.array([matrix_from_quat_wxyz(q / np.linalg.norm(q)) for q in np.asarray(read.quats, float)])
    true_R = np.array([matrix_from_quat_wxyz(q / np.linalg.norm(q)) for q in params[6:10].T.astype(float)])
    turn = (R.transpose(0, 2, 1) @ (R_yup_map @ true_R)).trace(axis1=1, axis2=2)
    assert np.degrees(np.arccos(np.clip((turn - 1.0) / 2.0, -1.0, 1.0))).max() < 0.5


def test_spz_says_what_it_cannot_hold(params, tmp_path):
    far = params.copy()
    far[0, 3] = 3000.0
    with pytest.raises(ValueError, match="3000 m from the origin, SPZ allows 2047"):
        write_spz(tmp_path / "map.spz", far)
    assert not list(tmp_path.iterdir())


# --- glTF ---


def document(path):
    """The JSON of a GLB, read by hand."""
    blob = Path(path).read_bytes()
    magic, version, total = struct.unpack_from("<4sII", blob)
    assert (magic, version, total) == (b"glTF", 2, len(blob))
    length, kind = struct.unpack_from("<I4s", blob, 12)
    assert kind == b"JSON"
    return json.loads(blob[20 : 20 + length]), blob[20 + length + 8 :]


@pytest.fixture(scope="module")
def glb(params, tmp_path_factory):
    path = tmp_path_factory.mktemp("gltf") / "map.glb"
    write_gltf(path, params)
    return path


def attribute(glb, name):
    table, body = document(glb)
    primitive = table["meshes"][0]["primitives"][0]
    accessor = table["accessors"][primitive["attributes"][name]]
    view = table["bufferViews"][accessor["bufferView"]]
    dtype = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    rows = np.frombuffer(body, dtype, accessor["count"] * width, view["byteOffset"])
    return accessor, rows.reshape(-1, width).astype(float)


def test_gltf_stands_upright_in_metres_as_trimesh_reads_it(params, glb):
    """With the node's turn: our z is glTF's y."""
    scene = trimesh.load_scene(glb)
    (cloud,) = scene.dump()
    np.testing.assert_allclose(cloud.vertices[:, 1], params[2], atol=1e-3)
    np.testing.assert_allclose(cloud.vertices, (R_yup_map @ params[:3]).T, atol=1e-3)
    np.testing.assert_allclose(matrix_from_quat_xyzw(np.array(QUAT_XYZW)), R_yup_map, atol=1e-12)
    assert np.linalg.det(R_yup_map) == pytest.approx(1.0)


def test_gltf_keeps_the_rules_of_the_ratified_extension(params, glb):
    """Its table of attributes, its ranges, its required properties."""
    table, _ = document(glb)
    primitive = table["meshes"][0]["primitives"][0]
    assert table["extensionsUsed"] == [EXTENSION]
    assert primitive["mode"] == 0
    extension = primitive["extensions"][EXTENSION]
    assert extension["kernel"] == "ellipse"
    assert extension["colorSpace"] == "srgb_rec709_display"
    types = {"ROTATION": "VEC4", "SCALE": "VEC3", "OPACITY": "SCALAR", "SH_DEGREE_0_COEF_0": "VEC3"}
    values = {}
    for name, kind in types.items():
        accessor, values[name] = attribute(glb, f"{EXTENSION}:{name}")
        assert (accessor["type"], accessor["componentType"], accessor["count"]) == (kind, 5126, 500)
    np.testing.assert_allclose(np.linalg.norm(values["ROTATION"], axis=1), 1.0, atol=1e-6)
    assert values["SCALE"].min() > 0.0
    np.testing.assert_allclose(values["OPACITY"][:, 0], opacity_of(params), atol=1e-6)
    R = np.array([matrix_from_quat_xyzw(q / np.linalg.norm(q)) for q in values["ROTATION"]])
    np.testing.assert_allclose(covariance(R, values["SCALE"]), true_covariance(params), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(0.5 + SH_C0 * values["SH_DEGREE_0_COEF_0"], params[11:14].T, atol=1e-5)
    _, fallback = attribute(glb, "COLOR_0")  # linear, as glTF's vertex colours are: encoded it is ours again
    linear = fallback[:, :3] / 65535.0
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb, np.clip(params[11:14].T, 0.0, 1.0), atol=1.0 / 255.0)
    np.testing.assert_allclose(fallback[:, 3] / 65535.0, opacity_of(params), atol=1e-4)


VALIDATE = """
const validator = require('gltf-validator'); const fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then((report) => console.log(JSON.stringify(report)));
"""


def validated(path):
    """Khronos' validator's report."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs Node.js for Khronos' glTF validator")
    probe = subprocess.run(
        [node, "-e", "require.resolve('gltf-validator')"], capture_output=True, check=False
    )
    if probe.returncode:
        pytest.skip("needs Khronos' glTF validator: `npm install gltf-validator`, its folder in NODE_PATH")
    done = subprocess.run(
        [node, "-e", VALIDATE, str(path)], capture_output=True, text=True, check=True, env=os.environ
    )
    return json.loads(done.stdout)


def test_khronos_validator_finds_nothing_but_the_extension_it_does_not_know(glb):
    messages = validated(glb)["issues"]["messages"]
    for message in messages:
        assert message["code"] in ("UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"), message
        assert EXTENSION in message["pointer"] or message["pointer"] == "/extensionsUsed/0"


def test_without_the_extension_the_same_file_is_valid_points(glb, tmp_path):
    """What viewers see that do not know it; attributes of one's own start with an underscore."""
    table, body = document(glb)
    primitive = table["meshes"][0]["primitives"][0]
    del table["extensionsUsed"], primitive["extensions"]
    primitive["attributes"] = {
        name.replace(f"{EXTENSION}:", "_"): number for name, number in primitive["attributes"].items()
    }
    head = json.dumps(table).encode()
    head += b" " * (-len(head) % 4)
    blob = b"glTF" + struct.pack("<II", 2, 28 + len(head) + len(body))
    blob += struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(body), b"BIN\0") + body
    (tmp_path / "plain.glb").write_bytes(blob)
    report = validated(tmp_path / "plain.glb")
    assert report["issues"]["messages"] == []
    assert report["info"]["totalVertexCount"] == 500


def test_an_empty_map_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no Gaussians"):
        write_gltf(tmp_path / "map.glb", np.zeros((14, 0), np.float32))
