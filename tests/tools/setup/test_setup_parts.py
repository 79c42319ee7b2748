"""The parts of setup: terminal output, printed board, intrinsics, the lidar's mount."""

import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest
from rich.console import Console

from beamsplat.common.geometry.rig import parse_rig
from beamsplat.common.geometry.transforms import inverse, se3_to_se2, transform_points
from beamsplat.common.messages import Scan
from beamsplat.tools.setup.board_calibration import LidarBoardCalibration
from beamsplat.tools.setup.chessboard import DEFAULT_CHESSBOARD, Chessboard, chessboard_pdf
from beamsplat.tools.setup.discovery import NoAnswer, camera_devices, find_lidar, lidar_devices
from beamsplat.tools.setup.files import MeasuredMount, camera_section, rig_text, robot_text
from beamsplat.tools.setup.intrinsics import IntrinsicsCalibration
from beamsplat.tools.setup.terminal import image_text, scan_text
from tests.tools.setup.emulated_desk import (
    DISTORTION,
    SIZE,
    SQUARE_M,
    T_BODY_CAMERA,
    T_BODY_LIDAR,
    Desk,
    K,
    boards_before_the_lidar,
    picture,
    views,
)


@pytest.fixture(scope="module")
def lens():
    calibration = IntrinsicsCalibration(DEFAULT_CHESSBOARD)
    for T in views(14):
        calibration.add(picture(T))
    return calibration.solve()


def test_the_intrinsics_are_estimated_with_their_errors(lens):
    assert lens.views >= 10
    assert lens.rms_px < 0.15
    assert lens.is_good
    found = lens.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    np.testing.assert_allclose(found, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], atol=3.0)
    assert np.abs(found[:2] - K[[0, 1], [0, 1]]).max() < 4.0 * lens.focal_sigma_px
    # Compare projections over the whole image, except for a rotation of the camera.
    rays = np.array([[x, y, 1.0] for x in (-0.45, 0.0, 0.45) for y in (-0.35, 0.0, 0.35)])
    lenses = ((K, DISTORTION), (lens.K, lens.distortion))
    uv = [cv2.projectPoints(rays, np.zeros(3), np.zeros(3), *pair)[0] for pair in lenses]
    off = uv[0] - uv[1]
    assert np.abs(off - off.mean(axis=0)).max() < 1.5
    assert np.abs(off.mean(axis=0)).max() < 2.0


def test_similar_views_and_views_without_a_board_are_rejected():
    calibration = IntrinsicsCalibration(DEFAULT_CHESSBOARD)
    first = picture(views(1)[0])
    assert calibration.add(np.full_like(first, 120)) == "no board"
    assert calibration.add(first) == "taken"
    assert calibration.add(first) == "too alike"
    assert calibration.missing()
    with pytest.raises(ValueError, match="1 views of the board are too few"):
        calibration.solve()


def test_a_board_that_is_not_flat_is_rejected():
    """The corners of a bent board do not fit any pinhole camera."""
    calibration = IntrinsicsCalibration(DEFAULT_CHESSBOARD)
    calibration.add(picture(views(1)[0]))
    grid = np.zeros((88, 3))
    grid[:, :2] = np.mgrid[:11, :8].T.reshape(-1, 2) * SQUARE_M
    grid[:, 2] = 0.01 * np.sin(grid[:, 0] * 30.0)
    ends = [transform_points(T, grid) for T in views(8)]
    calibration.views = [
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, DISTORTION)[0]
        .reshape(-1, 2)
        .astype(np.float32)
        for points in ends
    ]
    lens = calibration.solve()
    assert lens.rms_px > 1.0
    assert not lens.is_good


def test_the_printed_board_is_true_to_the_millimetre(tmp_path):
    if shutil.which("pdftoppm") is None:
        pytest.skip("needs pdftoppm: apt-get install poppler-utils")
    (tmp_path / "b.pdf").write_bytes(chessboard_pdf())
    subprocess.run(["pdftoppm", "-r", "254", "-gray", tmp_path / "b.pdf", tmp_path / "b"], check=True)
    (page,) = tmp_path.glob("b*.pgm")
    grey = cv2.imread(str(page), cv2.IMREAD_GRAYSCALE)
    assert np.abs(np.array(grey.shape) - [2100, 2970]).max() <= 1, "A4 at 10 dots a millimetre"
    found, uv = cv2.findChessboardCornersSB(grey, DEFAULT_CHESSBOARD.corners)
    assert found
    uv = uv.reshape(8, 11, 2)
    sides = np.concatenate([np.diff(uv, axis=0).reshape(-1, 2), np.diff(uv, axis=1).reshape(-1, 2)])
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), 200.0, atol=1.5)


def test_the_pdf_has_a_valid_object_table():
    data = chessboard_pdf()
    table = int(re.search(rb"startxref\n(\d+)", data)[1])
    assert data[table:].startswith(b"xref\n0 5")
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", data), start=1):
        assert data[int(offset) :].startswith(b"%d 0 obj" % number)
    with pytest.raises(ValueError, match="do not fit on A4"):
        chessboard_pdf(Chessboard((11, 8), 0.03))


def test_the_lidar_mount_is_estimated_from_boards(lens):
    """Start 2 cm and 3 degrees off, with a camera that looks down: the result is within its own errors."""
    desk = Desk(1)
    boards = LidarBoardCalibration(camera_section(lens, T_BODY_CAMERA).model(), DEFAULT_CHESSBOARD)
    angle = np.radians(np.arange(-180.0, 180.0, 0.8))
    noise = np.random.default_rng(2)
    for T in boards_before_the_lidar(6):
        desk.T_body_board = T
        ranges = desk.range_m(angle) + noise.normal(0.0, 0.003, len(angle))
        scan = Scan(stamp_ns=1, angle_min_rad=float(angle[0]), angle_increment_rad=float(np.radians(0.8)),
                    time_increment_s=0.0, scan_time_s=0.1, range_min_m=0.1, range_max_m=12.0,
                    ranges_m=ranges.astype(np.float32))  # fmt: skip
        grey = picture(inverse(T_BODY_CAMERA) @ T)
        assert "accepted" in boards.add(grey, scan, grey)
    found = boards.solve(MeasuredMount(0.03, 0.0, 0.18).T_body_lidar())
    assert found.is_good, found.summary
    error = se3_to_se2(found.T_body_lidar) - se3_to_se2(T_BODY_LIDAR)
    assert np.abs(error[:2]).max() < 0.01
    assert abs(error[2]) < np.radians(0.6)
    assert found.T_body_lidar[2, 3] == pytest.approx(0.18, abs=1e-9)
    assert found.T_body_lidar[2, 2] == pytest.approx(1.0, abs=1e-9), "level"
    moved = picture(inverse(T_BODY_CAMERA) @ boards_before_the_lidar(6)[3])
    assert boards.add(grey, scan, moved) == "rejected: the board moved, repeat"
    assert "not completely in the image" in boards.add(np.full_like(grey, 9), scan, grey)


def test_images_and_scans_as_text():
    bgr = np.zeros((40, 80, 3), np.uint8)
    bgr[:, 40:] = (0, 0, 255)
    text = image_text(bgr, 20)
    assert [len(line) for line in text.plain.splitlines()] == [20] * 5
    console = Console(color_system="truecolor", force_terminal=True, width=80, file=None, record=True)
    with console.capture() as captured:
        console.print(text)
    assert "38;2;255;0;0" in captured.get(), "red, not blue"
    drawn = scan_text(np.array([[1.9, 0.0], [0.0, 1.9], [-1.0, 0.0]]), 40).plain.splitlines()
    assert "from the centre to the edge: 2 m" in drawn[-1]
    rows = [i for i, line in enumerate(drawn) if "·" in line]
    here = next(i for i, line in enumerate(drawn) if "^" in line)
    assert rows[0] < here < rows[-1], "ahead is up, behind is down"
    assert drawn[here].index("·") < drawn[here].index("^"), "left is left"


def test_the_files_can_be_read_by_the_nodes(lens):
    text = rig_text(camera_section(lens, T_BODY_CAMERA), T_BODY_LIDAR, (), "note")
    rig = parse_rig(text, "rig.toml")
    np.testing.assert_allclose(rig.camera.model().T_body_camera, T_BODY_CAMERA, atol=1e-6)
    np.testing.assert_allclose(rig.lidar.model().T_body_lidar, T_BODY_LIDAR, atol=1e-6)
    assert (rig.camera.width_px, rig.camera.height_px) == SIZE
    without = parse_rig(rig_text(None, T_BODY_LIDAR, (), ""), "rig.toml")
    assert without.camera is None
    text = robot_text("r", "rig.toml", None, {"kind": "ldrobot", "device": "/dev/ttyUSB0"})
    assert 'kind = "none"' in text
    assert "[nodes.fusion]" not in text


def test_devices_are_listed_by_their_stable_names(tmp_path):
    for name in ("video0", "video1", "ttyUSB0", "ttyACM1", "ttyS0"):
        (tmp_path / name).touch()
    (tmp_path / "serial/by-id").mkdir(parents=True)
    (tmp_path / "serial/by-id/usb-lidar").symlink_to(tmp_path / "ttyUSB0")
    assert camera_devices(tmp_path) == [str(tmp_path / "video0"), str(tmp_path / "video1")]
    assert lidar_devices(tmp_path) == [str(tmp_path / "ttyACM1"), str(tmp_path / "serial/by-id/usb-lidar")]
    silent = find_lidar(str(tmp_path / "nothing"), ("ldrobot",))
    assert isinstance(silent, NoAnswer)
    assert "No such file" in silent.status
