"""SOG and compressed PLY: by readers written from their specifications, and by PlayCanvas' own program."""

import io
import json
import os
import shutil
import subprocess
import zipfile

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from beamsplat.common.geometry.transforms import matrix_from_quat_wxyz
from beamsplat.common.mapfiles.compressed_ply import write_compressed_ply
from beamsplat.common.mapfiles.sog import write_sog
from beamsplat.common.mapfiles.y_up import R_ydown_map, R_yup_map

SH_C0 = 0.28209479177387814
COUNT = 5000
# The fewer Gaussians, the larger the chunks: in this house 256 are spread over 17 m2.
LIMIT_M = {"sog": 0.001, "compressed": 0.004}
ANGLE_DEG = {"sog": 1.12, "compressed": 0.28}  # half a step in all components: 4 sqrt(3) of it in radians


@pytest.fixture(scope="module")
def params():
    """float32 [14, 5000]: the walls of a house of 12 x 9 x 2.6 m, as a mapper leaves them."""
    rng = np.random.default_rng(11)
    out = np.zeros((14, COUNT), np.float32)
    low, high = np.array([-6.0, -4.0, 0.0]), np.array([6.0, 5.0, 2.6])
    out[0:3] = rng.uniform(low, high, (COUNT, 3)).T
    axis, side = rng.integers(0, 3, COUNT), rng.integers(0, 2, COUNT)
    out[axis, np.arange(COUNT)] = np.where(side, high[axis], low[axis])
    out[3:6] = rng.uniform(-6.0, -2.0, (3, COUNT))
    out[6:10] = rng.normal(size=(4, COUNT)) * rng.uniform(0.3, 2.0, COUNT)
    out[6:10, :4] = np.eye(4)  # one component alone
    out[10] = rng.uniform(-8.0, 8.0, COUNT)
    out[11:14] = rng.uniform(-0.05, 1.05, (3, COUNT))
    return out


@pytest.fixture(scope="module")
def files(params, tmp_path_factory):
    folder = tmp_path_factory.mktemp("playcanvas")
    write_sog(folder / "map.sog", params)
    write_compressed_ply(folder / "map.compressed.ply", params)
    return {"sog": folder / "map.sog", "compressed": folder / "map.compressed.ply"}


def quaternions(small, largest):
    """Unit quaternions wxyz [N, 4] of three components [N, 3] and the index of the one left out."""
    out = np.zeros((len(small), 4))
    for i in range(4):
        rows = largest == i
        out[np.ix_(rows, [k for k in range(4) if k != i])] = small[rows]
        out[rows, i] = np.sqrt(np.maximum(0.0, 1.0 - (small[rows] ** 2).sum(axis=1)))
    return out


def read_sog(path):
    """By https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, version 2."""
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        assert meta["version"] == 2

        def image(name, channels):
            picture = Image.open(io.BytesIO(archive.read(name)))
            assert picture.format == "WEBP"
            pixels = np.asarray(picture.convert("RGBA")).reshape(-1, 4)
            return pixels[: meta["count"], :channels].astype(int)

        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        below, above = (image(name, 3) for name in meta["means"]["files"])
        logs = low + (high - low) * ((above << 8) | below) / 65535.0
        quats = image(meta["quats"]["files"][0], 4)
        assert set(np.unique(quats[:, 3])) <= {252, 253, 254, 255}
        colours = image(meta["sh0"]["files"][0], 4)
        harmonic = np.array(meta["sh0"]["codebook"])[colours[:, :3]]
        return {
            "position": np.sign(logs) * np.expm1(np.abs(logs)),
            "step": np.exp(np.abs(logs)) * (high - low) / 65535.0,
            "log_scale": np.array(meta["scales"]["codebook"])[image(meta["scales"]["files"][0], 3)],
            "quat": quaternions((quats[:, :3] / 255.0 * 2.0 - 1.0) / 2.0**0.5, quats[:, 3] - 252),
            "colour": 0.5 + SH_C0 * harmonic, "opacity": colours[:, 3] / 255.0,
        }  # fmt: skip


def read_compressed(path):
    """By PlayCanvas' description of the format: chunks of 256 with bounds, four 32-bit words each."""
    ply = PlyData.read(path)
    chunk = {p.name: np.repeat(ply["chunk"][p.name].astype(float), 256) for p in ply["chunk"].properties}
    word = {p.name: ply["vertex"][p.name] for p in ply["vertex"].properties}
    count = ply["vertex"].count
    assert ply["chunk"].count == -(-count // 256)

    def unit(name, shifts, bits):
        columns = [((word[name] >> s) & ((1 << b) - 1)) / ((1 << b) - 1) for s, b in zip(shifts, bits)]
        return np.stack(columns, axis=1)

    def within(values, names):
        low, high = (np.stack([chunk[f"{end}_{n}"][:count] for n in names], axis=1) for end in ("min", "max"))
        return low * (1.0 - values) + high * values

    small = (unit("packed_rotation", (20, 10, 0), (10, 10, 10)) - 0.5) * 2.0**0.5
    colour = unit("packed_color", (24, 16, 8, 0), (8, 8, 8, 8))
    extent = np.stack([chunk[f"max_{n}"][:count] - chunk[f"min_{n}"][:count] for n in "xyz"], axis=1)
    return {
        "step": extent / [2047.0, 1023.0, 2047.0],
        "position": within(unit("packed_position", (21, 11, 0), (11, 10, 11)), ("x", "y", "z")),
        "log_scale": within(
            unit("packed_scale", (21, 11, 0), (11, 10, 11)), ("scale_x", "scale_y", "scale_z")
        ),
        "quat": quaternions(small, word["packed_rotation"] >> 30),
        "colour": within(colour[:, :3], ("r", "g", "b")), "opacity": colour[:, 3],
    }  # fmt: skip


READERS = {"sog": read_sog, "compressed": read_compressed}


def matched(params, positions):
    """Our Gaussians in the order of the file, by their colours and positions in the file's frame."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree((R_ydown_map @ params[:3]).T).query(positions)
    assert len(np.unique(index)) == len(index)  # each of them once
    return params[:, index], distance


@pytest.mark.parametrize("kind", READERS)
def test_values_as_the_specification_decodes_them(params, files, kind):
    """Positions to half a step of the format, which is what it can hold at best."""
    read = READERS[kind](files[kind])
    assert len(read["position"]) == COUNT
    true, distance = matched(params, read["position"])
    assert np.all(distance <= 0.5 * np.linalg.norm(read["step"], axis=1) * 1.001 + 1e-6)
    assert distance.max() < LIMIT_M[kind]
    np.testing.assert_allclose(read["colour"], true[11:14].T, atol=1.0 / 255.0)
    np.testing.assert_allclose(read["opacity"], 1.0 / (1.0 + np.exp(-true[10])), atol=1.0 / 255.0)
    np.testing.assert_allclose(np.exp(read["log_scale"]), np.exp(true[3:6].T), rtol=0.01)
    assert turn_deg(read["quat"], true).max() < ANGLE_DEG[kind]


def turn_deg(quat, true):
    """Angle between rotations in the file's frame and ours, turned into it."""
    R = np.array([matrix_from_quat_wxyz(q / np.linalg.norm(q)) for q in quat])
    true_R = np.array([matrix_from_quat_wxyz(q / np.linalg.norm(q)) for q in true[6:10].T.astype(float)])
    trace = (R.transpose(0, 2, 1) @ (R_ydown_map @ true_R)).trace(axis1=1, axis2=2)
    return np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def test_they_are_small(params, files):
    """Bytes per Gaussian: 68 in the 3DGS layout."""
    assert files["sog"].stat().st_size / COUNT < 18
    assert files["compressed"].stat().st_size / COUNT < 17


def test_the_same_map_gives_the_same_bytes(params, files, tmp_path):
    write_sog(tmp_path / "map.sog", params)
    assert (tmp_path / "map.sog").read_bytes() == files["sog"].read_bytes()


def test_an_empty_map_is_refused(tmp_path):
    for write in (write_sog, write_compressed_ply):
        with pytest.raises(ValueError, match="no Gaussians"):
            write(tmp_path / "map", np.zeros((14, 0), np.float32))


def test_one_gaussian_is_a_map_too(params, tmp_path):
    write_sog(tmp_path / "one.sog", params[:, :1])
    write_compressed_ply(tmp_path / "one.compressed.ply", params[:, :1])
    for read in (read_sog(tmp_path / "one.sog"), read_compressed(tmp_path / "one.compressed.ply")):
        np.testing.assert_allclose(read["position"][0], R_ydown_map @ params[:3, 0], atol=1e-5)


# --- PlayCanvas' own reader ---


@pytest.fixture(scope="module")
def splat_transform():
    """Its command line: node_modules/.bin in NODE_PATH, or on the PATH."""
    folders = [f"{p}/.bin" for p in os.environ.get("NODE_PATH", "").split(":") if p]
    program = shutil.which("splat-transform", path=os.pathsep.join([*folders, os.environ["PATH"]]))
    if program is None:
        pytest.skip(
            "needs PlayCanvas' reader: `npm install @playcanvas/splat-transform`, its folder in NODE_PATH"
        )

    def convert(source, target):
        subprocess.run([program, "--quiet", "--overwrite", "--gpu", "cpu", source, target], check=True)
        return target

    return convert


@pytest.mark.parametrize("kind", READERS)
def test_values_as_splat_transform_reads_them(params, files, splat_transform, kind, tmp_path):
    v = PlyData.read(splat_transform(files[kind], tmp_path / "read.ply"))["vertex"]
    assert v.count == COUNT
    true, distance = matched(params, np.stack([v[axis] for axis in "xyz"], axis=1))
    assert distance.max() < LIMIT_M[kind]
    colour = 0.5 + SH_C0 * np.stack([v[f"f_dc_{i}"] for i in range(3)], axis=1)
    np.testing.assert_allclose(colour, true[11:14].T, atol=1.0 / 255.0)
    opacity = 1.0 / (1.0 + np.exp(-v["opacity"].astype(float)))
    np.testing.assert_allclose(opacity, 1.0 / (1.0 + np.exp(-true[10])), atol=1.0 / 255.0)
    scale = np.exp(np.stack([v[f"scale_{i}"] for i in range(3)], axis=1))
    np.testing.assert_allclose(scale, np.exp(true[3:6].T), rtol=0.01)
    assert turn_deg(np.stack([v[f"rot_{i}"] for i in range(4)], axis=1), true).max() < ANGLE_DEG[kind]


def test_they_stand_upright_for_playcanvas(params, files, splat_transform, tmp_path):
    """Turned into glTF, which is y up, the map has the orientation of our own glTF files."""
    import trimesh
    from scipy.spatial import cKDTree

    for kind in READERS:
        scene = trimesh.load_scene(splat_transform(files[kind], tmp_path / f"{kind}.glb"))
        points = np.concatenate([np.asarray(part.vertices) for part in scene.dump()])
        assert cKDTree((R_yup_map @ params[:3]).T).query(points)[0].max() < LIMIT_M[kind]
