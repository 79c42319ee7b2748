"""Data sets for nerfstudio and COLMAP, of a session, as other programs read them."""

import io
import json
import shutil

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.messages import CameraModel
from beamsplat.common.messages.depth_codec import pack_mask
from beamsplat.tools.cli.main import app
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import handle, make_node, message

KEYFRAMES = 6
HIDDEN = np.s_[20:50, 10:40]  # rows, columns of a dynamic object in keyframe 2
JPEG, TURNED = 3, 5  # these are JPEG; the second one has an orientation in its EXIF data
DISTORTED = 4  # this keyframe comes from a lens with pincushion distortion
LENS = CameraModel(
    width_px=r.WIDTH, height_px=r.HEIGHT, fx_px=r.FOCAL, fy_px=r.FOCAL, cx_px=79.5, cy_px=59.5,
    distortion_model="plumb_bob", distortion=(0.15, 0.02, 0.0, 0.0, 0.0), T_body_camera=r.T_BODY_CAMERA,
)  # fmt: skip


def beams(depth):
    """A beam in every 16th column of the row of a horizontal lidar, with the true depth."""
    columns = np.arange(0, r.WIDTH, 16)
    z = depth[60, columns]
    rows = np.stack([columns, np.full(len(columns), 60.0), z, np.full(len(columns), 0.01)], axis=1)
    return rows[np.isfinite(z)].astype(np.float32)


def distorted(rgb):
    """The image of the room through `LENS`."""
    rays = Pinhole.of(LENS).ray_grid()
    u, v = (rays[..., i] * r.FOCAL + c for i, c in ((0, 79.5), (1, 59.5)))
    return cv2.remap(rgb, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)


def jpeg(rgb, orientation):
    image, file, exif = Image.fromarray(rgb), io.BytesIO(), Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    image.save(file, "JPEG", quality=97, subsampling=0, exif=exif.tobytes() if orientation else b"")
    return np.frombuffer(file.getvalue(), np.uint8)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset") / "room"
    node = make_node(folder)
    for number in range(KEYFRAMES):
        rgb, depth = r.shot(number)
        change = {"beams": beams(depth)}
        if number == 2:
            mask = np.ones(depth.shape, bool)
            mask[HIDDEN] = False
            change["mask"] = pack_mask(mask)
        if number in (JPEG, TURNED):
            change |= {"encoding": "jpeg", "picture": jpeg(rgb, 6 if number == TURNED else None)}
        if number == DISTORTED:
            change |= {"camera": LENS, "picture": r.jpeg(distorted(rgb))}
        handle(node, "keyframes/frame", message(number, **change))
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


@pytest.fixture(scope="module")
def folders(session, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    text = run("export", session, "--to", "nerfstudio", "--out", out / "ns")
    assert f"{KEYFRAMES} images with depth" in text
    run("export", session, "--to", "colmap", "--out", out / "bin")
    run("export", session, "--to", "colmap", "--text", "--out", out / "txt")
    return out


def refined(session):
    """T_map_camera [4, 4] of each keyframe by the session's arrays, in the order of time."""
    a = SessionFolder(session).read_state()
    T_map_anchor = dict(zip(a["anchor_id"].tolist(), a["anchor_T_map"]))
    rows = np.argsort(a["keyframe_id"])
    return [
        T_map_anchor[int(a["keyframe_anchor"][i])] @ a["keyframe_T_anchor_camera"][i] @ a["keyframe_delta"][i]
        for i in rows
    ]


class NerfstudioReader:
    """Reads a data set strictly by https://docs.nerf.studio/quickstart/data_conventions.html.

    Cameras look along -z with y up; the centre of the first pixel is (0.5, 0.5), as in nerfstudio's
    `Cameras.get_image_coords`; depth is in millimetres along the optical axis.
    """

    def __init__(self, folder):
        self.folder = folder
        self.table = json.loads((folder / "transforms.json").read_text())
        assert self.table["camera_model"] == "OPENCV"
        assert not any(self.table[name] for name in ("k1", "k2", "p1", "p2"))
        for key in ("file_path", "depth_file_path", "mask_path"):
            given = [key in frame for frame in self.table["frames"]]
            assert all(given) or not any(given)  # nerfstudio's parser demands it
        # Its parser sorts by file name.
        assert self.table["frames"] == sorted(self.table["frames"], key=lambda frame: frame["file_path"])
        assert "applied_transform" not in self.table  # the points are in the same frame as the cameras

    def image(self, frame):
        pixels = np.asarray(Image.open(self.folder / frame["file_path"]).convert("RGB"))
        assert pixels.shape == (self.of(frame, "h"), self.of(frame, "w"), 3)
        return pixels

    def depth_m(self, frame):
        image = Image.open(self.folder / frame["depth_file_path"])
        assert image.mode == "I;16"
        return np.asarray(image).astype(float) * 1e-3

    def mask(self, frame):
        image = Image.open(self.folder / frame["mask_path"])
        assert image.mode == "L"
        return np.asarray(image) > 127

    def of(self, frame, name):
        return frame.get(name, self.table.get(name))

    def points_of(self, frame):
        """World points [H, W, 3] of the depth map."""
        depth = self.depth_m(frame)
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
        x = (u - self.of(frame, "cx")) / self.of(frame, "fl_x")
        y = (v - self.of(frame, "cy")) / self.of(frame, "fl_y")
        T = np.array(frame["transform_matrix"])
        return np.stack([x * depth, -y * depth, -depth], axis=-1) @ T[:3, :3].T + T[:3, 3]


@pytest.fixture(scope="module")
def ns(folders):
    return NerfstudioReader(folders / "ns")


def test_nerfstudio_poses_are_the_refined_ones(session, ns):
    assert len(ns.table["frames"]) == KEYFRAMES
    for number, (frame, T_map_camera) in enumerate(zip(ns.table["frames"], refined(session))):
        T = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(T, T_map_camera, atol=1e-12)
        true = r.T_map_body(number) @ r.T_BODY_CAMERA
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.01  # the mapper has refined them a little
        assert np.trace(T[:3, :3].T @ true[:3, :3]) > 1.0 + 2.0 * np.cos(np.radians(0.5))
        assert frame["stamp_ns"] == r.T0 + number * 10**9


def test_nerfstudio_depth_maps_and_images_are_those_of_the_keyframes(ns):
    for number in range(KEYFRAMES):
        frame = ns.table["frames"][number]
        rgb, depth = r.shot(number)
        known = np.isfinite(depth)
        np.testing.assert_array_equal(ns.depth_m(frame) > 0.0, known)
        np.testing.assert_allclose(ns.depth_m(frame)[known], depth[known], atol=0.0006)
        if number not in (DISTORTED, JPEG, TURNED):
            np.testing.assert_array_equal(ns.image(frame), rgb)


def test_a_jpeg_is_copied_unless_readers_would_turn_it(ns):
    plain, turned = (ns.table["frames"][number] for number in (JPEG, TURNED))
    data = (ns.folder / plain["file_path"]).read_bytes()
    assert plain["file_path"].endswith(".jpg")
    assert data == jpeg(r.shot(JPEG)[0], None).tobytes()
    assert turned["file_path"].endswith(".png")
    original = np.asarray(Image.open(io.BytesIO(jpeg(r.shot(TURNED)[0], 6).tobytes())))
    assert np.abs(ns.image(turned).astype(int) - original).max() <= 1


def test_a_distorted_image_becomes_a_pinhole_image_and_its_margin_is_masked(ns):
    frame = ns.table["frames"][DISTORTED]
    mask, rgb = ns.mask(frame), r.shot(DISTORTED)[0]
    off = np.abs(ns.image(frame).astype(float) - rgb)[mask]
    assert off.mean() < 4.0  # of 255: two interpolations
    raw = np.abs(distorted(rgb).astype(float) - rgb)[mask]
    assert off.mean() < 0.5 * raw.mean()
    assert not mask[0, 0]
    assert not mask[-1, -1]
    assert mask[20:-20, 20:-20].all()


def test_pixels_of_dynamic_objects_are_masked(ns):
    mask = ns.mask(ns.table["frames"][2])
    assert not mask[HIDDEN].any()
    assert mask.sum() == mask.size - 900
    assert ns.mask(ns.table["frames"][0]).all()


def test_nerfstudio_points_lie_on_the_depth_maps(ns):
    cloud = trimesh.load(ns.folder / ns.table["ply_file_path"])
    points = np.asarray(cloud.vertices)
    colours = np.asarray(cloud.colors)[:, :3].astype(int)
    assert len(points) > 40
    surface, shown = [], []
    for frame in ns.table["frames"]:
        surface.append(ns.points_of(frame)[60, ::16])
        shown.append(ns.image(frame)[60, ::16])
    surface, shown = np.concatenate(surface), np.concatenate(shown).astype(int)
    gap = np.linalg.norm(points[:, None] - surface[None], axis=2)
    nearest = gap.argmin(axis=1)
    assert gap.min(axis=1).max() < 0.001
    assert np.abs(colours - shown[nearest]).max() <= 1
    # One per cell of 2 cm, and every beam has one nearby.
    cells = np.floor(points / 0.02).astype(int)
    assert len(np.unique(cells, axis=0)) >= 0.98 * len(points)  # the file has float32


# --- COLMAP ---


@pytest.fixture(scope="module", params=["bin", "txt"])
def model(request, folders):
    pycolmap = pytest.importorskip("pycolmap", reason="needs COLMAP's own reader: pip install pycolmap")
    folder = folders / request.param
    assert {path.suffix for path in (folder / "sparse" / "0").iterdir()} == {f".{request.param}"}
    return pycolmap.Reconstruction(folder / "sparse" / "0"), folder


def pose_of(image):
    """T_camera_map [3, 4]; a method since COLMAP 3.12."""
    pose = image.cam_from_world
    return (pose() if callable(pose) else pose).matrix()


def test_colmap_reads_cameras_and_refined_poses(session, model):
    reconstruction, folder = model
    assert len(reconstruction.images) == KEYFRAMES
    (camera,) = reconstruction.cameras.values()  # after undistortion both lenses are the same pinhole
    assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", r.WIDTH, r.HEIGHT)
    np.testing.assert_allclose(camera.params, [r.FOCAL, r.FOCAL, 80.0, 60.0])
    images = sorted(reconstruction.images.values(), key=lambda image: image.name)
    for image, T_map_camera in zip(images, refined(session)):
        T = np.vstack([pose_of(image), [0, 0, 0, 1]])
        np.testing.assert_allclose(T @ T_map_camera, np.eye(4), atol=1e-9)
        assert Image.open(folder / "images" / image.name).size == (r.WIDTH, r.HEIGHT)


def test_colmap_points_project_to_their_pixels_at_their_depth_and_colour(model):
    reconstruction, folder = model
    (camera,) = reconstruction.cameras.values()
    assert len(reconstruction.points3D) > 40
    for id, point in reconstruction.points3D.items():
        (element,) = point.track.elements
        image = reconstruction.images[element.image_id]
        pixel = image.points2D[element.point2D_idx]
        assert pixel.point3D_id == id
        seen = pose_of(image) @ [*point.xyz, 1.0]
        np.testing.assert_allclose(camera.img_from_cam(seen), pixel.xy, atol=1e-6)
        column, row = (int(np.floor(value)) for value in pixel.xy)
        name = image.name.rpartition(".")[0]
        depth_mm = np.asarray(Image.open(folder / "depths" / f"{name}.png"))[row, column]
        assert seen[2] == pytest.approx(depth_mm * 1e-3, abs=0.001)
        shown = np.asarray(Image.open(folder / "images" / image.name).convert("RGB"))[row, column]
        assert np.abs(point.color.astype(int) - shown.astype(int)).max() <= 1


def test_colmap_finds_masks_by_the_name_of_the_image(folders):
    """COLMAP's option `--ImageReader.mask_path` expects IMAGE.png, for example a.jpg.png."""
    images = sorted(path.name for path in (folders / "bin" / "images").iterdir())
    assert sorted(path.name for path in (folders / "bin" / "masks").iterdir()) == [f"{i}.png" for i in images]


# --- faults ---


def test_a_damaged_keyframe_is_left_out_and_named(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    folder = SessionFolder(tmp_path / "s")
    ids = folder.keyframe_ids()
    (folder.keyframes / f"{ids[1]}.kf").write_bytes(b"BSKF")
    result = CliRunner().invoke(
        app, ["export", str(tmp_path / "s"), "--to", "colmap", "--out", str(tmp_path / "o")]
    )
    assert result.exit_code == 0
    assert f"{KEYFRAMES - 1} images" in result.output
    assert f"left out: keyframe {ids[1]}" in result.output
    for id in ids:
        (folder.keyframes / f"{id}.kf").unlink()
    with pytest.raises(UserError, match=r"has no keyframe with an image; keyframe .* cannot be read"):
        run("export", tmp_path / "s", "--to", "nerfstudio", "--out", tmp_path / "p")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["o", "s"]  # nothing half done


def test_an_existing_folder_and_a_running_system_are_refused(session, folders, tmp_path):
    with pytest.raises(UserError, match="exists already; remove it"):
        run("export", session, "--to", "nerfstudio", "--out", folders / "ns")
    (tmp_path / "robot.toml").write_text("")
    with pytest.raises(UserError, match="needs the images of a saved session"):
        run("export", tmp_path / "robot.toml", "--to", "colmap", "--out", tmp_path / "o")


def test_nerfstudios_own_loader_sees_the_room_where_it_is(session, folders):
    """Its rays through the pixels of an image end on the surface, at the depth of its depth map.

    The loader needs none of the large packages of nerfstudio: `pip install --no-deps nerfstudio jaxtyping
    wadler_lindig tyro docstring_parser typeguard viser msgspec websockets tensorboard absl-py torchvision`.
    """
    parser = pytest.importorskip(
        "nerfstudio.data.dataparsers.nerfstudio_dataparser", reason="needs nerfstudio: pip install nerfstudio"
    )
    torch = pytest.importorskip("torch")
    from nerfstudio.data.utils.data_utils import get_depth_image_from_path

    config = parser.NerfstudioDataParserConfig(
        data=folders / "ns",
        center_method="none",
        auto_scale_poses=False,
        load_3D_points=False,
        eval_mode="all",
    )
    read = config.setup().get_dataparser_outputs(split="train")
    assert len(read.image_filenames) == len(read.mask_filenames) == KEYFRAMES
    assert read.dataparser_scale == 1.0
    np.testing.assert_allclose(np.asarray(read.dataparser_transform), np.eye(4)[:3], atol=1e-6)
    coordinates = read.cameras.get_image_coords()[[30, 60, 90]][:, [20, 80, 140]].reshape(-1, 2)
    for number, T_map_camera in enumerate(refined(session)):
        depth = get_depth_image_from_path(
            filepath=read.metadata["depth_filenames"][number], height=r.HEIGHT, width=r.WIDTH,
            scale_factor=read.metadata["depth_unit_scale_factor"],
        )[[30, 60, 90]][:, [20, 80, 140]].reshape(-1, 1)  # fmt: skip
        indices = torch.full((len(coordinates), 1), number)
        rays = read.cameras.generate_rays(camera_indices=indices, coords=coordinates)
        seen = (rays.origins + rays.directions * rays.metadata["directions_norm"] * depth).numpy()
        true_z = r.shot(number)[1][[30, 60, 90]][:, [20, 80, 140]].ravel()
        u, v = np.tile([20.0, 80.0, 140.0], 3), np.repeat([30.0, 60.0, 90.0], 3)
        camera = np.stack([(u - 79.5) / r.FOCAL, (v - 59.5) / r.FOCAL, np.ones(9)], axis=1) * true_z[:, None]
        true = camera @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
        known = np.isfinite(true_z)
        assert known.sum() > 5
        np.testing.assert_allclose(seen[known], true[known], atol=0.001)
