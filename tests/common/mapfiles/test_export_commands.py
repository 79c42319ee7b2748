"""`beamsplat export` and `beamsplat render` on a session of the synthetic room."""

import json
import shutil
import struct
import zipfile

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from plyfile import PlyData
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.trajectory import Trajectory, write_tum
from beamsplat.common.geometry.transforms import inverse, make_transform
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import keyframe_views, store_of
from beamsplat.common.mapfiles.video import (
    interpolate_path,
    look_at,
    orbit_poses,
    trajectory_poses,
    write_video,
)
from beamsplat.common.mapfiles.y_up import R_yup_map
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.cli.main import app
from tests.services.localization.world import RayCastLidar, SimulatedDrive
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import feed, make_node


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "room"
    node = make_node(folder, half_steps=12, full_steps=8)
    feed(node, range(8))
    list(node.drain())
    node.close()
    return folder


def run(*words):
    """The command's output; its UserError is raised here."""
    result = CliRunner().invoke(app, list(map(str, words)))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


def test_every_format_is_written_where_it_is_asked_for(session, tmp_path):
    params = SessionFolder(session).read_state()["store_params"]
    formats = {"ply": "a.ply", "gltf": "b.glb", "spz": "c.spz", "points": "d.ply", "sog": "e.sog",
               "compressed-ply": "f.ply", "las": "g.las", "octomap": "h.bt",
               "usd": "i.usda"}  # fmt: skip
    for to, name in formats.items():
        assert str(tmp_path / name) in run("export", session, "--to", to, "--out", tmp_path / name)
    assert PlyData.read(tmp_path / "a.ply")["vertex"].count == params.shape[1]
    (cloud,) = trimesh.load_scene(tmp_path / "b.glb").dump()
    np.testing.assert_allclose(cloud.vertices[:, 1], params[2], atol=1e-3)
    assert (tmp_path / "c.spz").stat().st_size < 0.3 * (tmp_path / "a.ply").stat().st_size
    points = PlyData.read(tmp_path / "d.ply")["vertex"]
    assert points.count > 1000
    with zipfile.ZipFile(tmp_path / "e.sog") as sog:
        assert json.loads(sog.read("meta.json"))["count"] == params.shape[1]
    assert PlyData.read(tmp_path / "f.ply")["vertex"].count == params.shape[1]
    las = (tmp_path / "g.las").read_bytes()
    assert struct.unpack_from("<I", las, 107) == (points.count,)
    xyz = np.frombuffer(las, np.uint8, offset=227).reshape(-1, 26)[:, :12].copy().view("<i4") * 1e-4
    np.testing.assert_allclose(xyz, np.stack([points[axis] for axis in "xyz"], axis=1), atol=1e-4)
    assert "def ParticleField3DGaussianSplat" in (tmp_path / "i.usda").read_text()
    assert (tmp_path / "h.bt").read_bytes().startswith(b"# Octomap OcTree binary file\n")


def test_points_and_mesh_match_the_surface_of_the_room(session, tmp_path):
    """Against the exact depth of a keyframe's view."""
    run("export", session, "--to", "points", "--out", tmp_path / "points.ply")
    run("export", session, "--to", "mesh", "--voxel-m", "0.06", "--out", tmp_path / "mesh.ply")
    T_camera_map = inverse(r.T_map_body(3) @ r.T_BODY_CAMERA)
    for name in ("points.ply", "mesh.ply"):
        read = trimesh.load(tmp_path / name, process=False)
        p = np.asarray(read.vertices) @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
        p = p[p[:, 2] > 0.3]
        u = np.round(r.FOCAL * p[:, 0] / p[:, 2] + 79.5).astype(int)
        v = np.round(r.FOCAL * p[:, 1] / p[:, 2] + 59.5).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < r.WIDTH) & (v < r.HEIGHT)
        off = p[inside, 2] - r.shot(3)[1][v[inside], u[inside]]
        assert inside.sum() > 500
        assert np.nanmedian(np.abs(off)) < 0.15  # of 4 m, after a hundred steps
    assert len(read.faces) > 1000


def test_a_textured_mesh_shows_the_image_of_a_keyframe(session, tmp_path):
    told = run(
        "export", session, "--to", "textured-mesh", "--voxel-m", "0.06", "--out", tmp_path / "room.glb"
    )
    assert "% of them with the texture" in told
    (mesh,) = trimesh.load_scene(tmp_path / "room.glb").dump()
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    uv = mesh.visual.uv[mesh.faces].mean(axis=1)
    row, column = (1.0 - uv[:, 1]) * picture.shape[0] - 0.5, uv[:, 0] * picture.shape[1] - 0.5
    colours = picture[np.round(row).astype(int), np.round(column).astype(int)].astype(float)
    T_camera_map = inverse(r.T_map_body(3) @ r.T_BODY_CAMERA)
    p = mesh.triangles_center @ R_yup_map @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    near = p[:, 2] > 0.3
    u = np.round(r.FOCAL * p[near, 0] / p[near, 2] + 79.5).astype(int)
    v = np.round(r.FOCAL * p[near, 1] / p[near, 2] + 59.5).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < r.WIDTH) & (v < r.HEIGHT)
    rgb, depth = r.shot(3)
    seen = np.abs(p[near][inside, 2] - depth[v[inside], u[inside]]) < 0.15
    off = np.abs(colours[near][inside] - rgb[v[inside], u[inside]])[seen]
    assert seen.sum() > 500
    assert np.median(off) < 12  # of 255: the surface is some centimetres off after a hundred steps


def test_an_export_while_a_mapper_saves_is_of_one_checkpoint(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    node = make_node(tmp_path / "s", session_every_s=1.0)
    for number in (8, 9):
        feed(node, [number])
        run("export", tmp_path / "s", "--to", "ply", "--out", tmp_path / "now.ply")
        count = SessionFolder(tmp_path / "s").manifest()["gaussians"]
        assert PlyData.read(tmp_path / "now.ply")["vertex"].count == count
    node.close()


def served(folder, name):
    """Occupancy int [rows from below, columns] by map_server's rules for trinary maps, and the YAML."""
    table = yaml.safe_load((folder / f"{name}.yaml").read_text())
    assert set(table) == {"image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"}
    assert table["mode"] == "trinary"
    assert table["negate"] == 0
    assert len(table["origin"]) == 3
    pixels = cv2.imread(str(folder / table["image"]), cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint8
    shade = (255.0 - pixels[::-1].astype(float)) / 255.0
    occupied, free = shade > table["occupied_thresh"], shade < table["free_thresh"]
    return np.where(occupied, 100, np.where(free, 0, -1)), table


def test_nav2_without_a_robot_half_is_the_camera_layer(session, tmp_path):
    assert "no lidar layer" in run("export", session, "--to", "nav2", "--out", tmp_path / "nav2")
    values, table = served(tmp_path / "nav2", "map")
    assert table["resolution"] == 0.05
    assert (values == 100).sum() > 20
    np.testing.assert_array_equal(values, served(tmp_path / "nav2", "camera")[0])


@pytest.mark.slow
def test_nav2_layers_are_aligned(session, tmp_path):
    """The lidar map of a flat and the camera layer of the room, on the same cells."""
    shutil.copytree(session, tmp_path / "s")
    lidar, path, slam = RayCastLidar(), SimulatedDrive(), LidarSlam(LidarSlamSettings(), np.eye(4))
    angle_min, increment, dt, least, most = lidar.arguments()
    for number in range(60):
        slam.add_scan(number * 10**8, lidar.scan(path, number * 0.1), angle_min, increment, dt, least, most)
    slam.finish()
    slam.save(tmp_path / "s" / "robot")
    run("export", tmp_path / "s", "--to", "nav2")
    (both, a), (wall, b), (seen, c) = (served(tmp_path / "s" / "nav2", n) for n in ("map", "lidar", "camera"))
    assert a["origin"] == b["origin"] == c["origin"]
    assert both.shape == wall.shape == seen.shape
    assert np.all(both[wall == 100] == 100)
    assert np.all(both[seen == 100] == 100)
    assert np.all(both[(wall == 0) & (seen != 100)] == 0)
    assert (wall == 100).sum() > 100
    assert (seen == 100).sum() > 20


def test_wrong_arguments_are_answered_with_valid_ones(session, tmp_path):
    with pytest.raises(UserError, match="choose one of ply, compressed-ply, gltf, spz"):
        run("export", session, "--to", "obj")
    with pytest.raises(UserError, match=r"ending in \.glb"):
        run("export", session, "--to", "gltf", "--out", tmp_path / "map.gltf")
    with pytest.raises(UserError, match=r"million voxels of 0\.005 m are too many"):
        run("export", session, "--to", "mesh", "--voxel-m", "0.005", "--out", tmp_path / "m.ply")
    with pytest.raises(UserError, match=r"ends in \.mp4 or \.png"):
        run("render", session, "--path", "drive", "--out", tmp_path / "film.gif")
    with pytest.raises(UserError, match="cannot be read as a TUM trajectory"):
        run("render", session, "--path", tmp_path / "nothing", "--out", tmp_path / "film.mp4")
    with pytest.raises(UserError, match="a session is a folder"):
        run("export", tmp_path, "--to", "ply")


# --- images and videos ---


def test_renders_along_the_drive_match_the_keyframes(session, tmp_path):
    out = tmp_path / "frames" / "drive.png"
    assert "3 images of 160x120" in run(
        "render", session, "--path", "drive", "--seconds", "1", "--fps", "3", "--out", out
    )
    first = cv2.imread(str(out.with_name("drive-0001.png")))[..., ::-1].astype(float)
    assert np.corrcoef(first.ravel(), r.shot(0)[0].astype(float).ravel())[0, 1] > 0.8


def test_a_video_has_the_requested_images(session, tmp_path):
    run("render", session, "--path", "orbit", "--seconds", "0.5", "--fps", "10", "--width", "96",
        "--out", tmp_path / "orbit.mp4")  # fmt: skip
    video = cv2.VideoCapture(str(tmp_path / "orbit.mp4"))
    frames = []
    while (frame := video.read())[0]:
        frames.append(frame[1])
    assert len(frames) == 5
    assert frames[0].shape == (72, 96, 3)
    assert np.abs(frames[0].astype(float) - frames[2]).mean() > 1.0
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)


def test_a_path_of_body_poses_is_followed_with_the_robots_camera(session, tmp_path):
    stamps = np.array([0, 10**9])
    write_tum(tmp_path / "path.tum", Trajectory(stamps, np.stack([r.T_map_body(2), r.T_map_body(2)])))
    run(
        "render",
        session,
        "--path",
        tmp_path / "path.tum",
        "--seconds",
        "0.1",
        "--fps",
        "10",
        "--out",
        tmp_path / "p.png",
    )
    arrays = SessionFolder(session).read_state()
    store = store_of(arrays)
    T_camera_map = inverse(r.T_map_body(2) @ r.T_BODY_CAMERA)
    image = Rasterizer().render(store.params, store.count, r.CAMERA, T_camera_map).image[:3]
    shown = cv2.imread(str(tmp_path / "p.png"))[..., ::-1].transpose(2, 0, 1) / 255.0
    np.testing.assert_allclose(shown, np.clip(image, 0, 1), atol=2 / 255)


def test_camera_paths_look_at_their_target(session):
    """Upright: x right, y down, z forward; an orbit looks at the map from outside and above."""
    T = look_at(np.array([0.0, -2.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(T[:3, :3] @ [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ [0.0, 1.0, 0.0], [0.0, 0.0, -1.0], atol=1e-12)
    assert np.isfinite(look_at(np.array([0.0, 0.0, 5.0]), np.zeros(3))).all()
    arrays = SessionFolder(session).read_state()
    store, views = store_of(arrays), keyframe_views(arrays)
    poses = orbit_poses(store, 0.4, 6)
    middle = np.median(store.params[:3, : store.count], axis=1)
    for T in poses:
        p = inverse(T)[:3, :3] @ middle + inverse(T)[:3, 3]
        assert p[2] > 0.0
        assert abs(p[0] / p[2]) < 0.5
        assert T[2, 3] > middle[2]
    path = interpolate_path([view.T_map_camera for view in views], 15)
    np.testing.assert_allclose(path[0], views[0].T_map_camera, atol=1e-9)
    np.testing.assert_allclose(path[-1], views[-1].T_map_camera, atol=1e-9)
    assert len(interpolate_path([np.eye(4)], 3)) == 3
    track = Trajectory(
        np.array([0, 10]), np.stack([np.eye(4), make_transform(np.eye(3), np.array([1.0, 0, 0]))])
    )
    assert [T[0, 3] for T in trajectory_poses(track, np.eye(4), 3)] == pytest.approx([0.0, 0.5, 1.0])


def test_one_image_is_one_file(tmp_path):
    written = write_video(tmp_path / "one.png", [np.zeros((8, 8, 3), np.uint8)], 1.0, 1)
    assert written == [tmp_path / "one.png"]
    assert cv2.imread(str(written[0])).shape == (8, 8, 3)
