"""A desk with a chessboard as an emulated camera and an emulated lidar see it."""

import functools

import cv2
import numpy as np

from beamsplat.common.geometry.frames import R_body_camera_level, camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import inverse, make_transform, so3_exp, transform_points
from tests.services.camera.test_camera import EmulatedCamera
from tests.services.lidar.devices import Ld19, room_range_m

SIZE = (480, 360)
K = np.array([[392.0, 0.0, 243.5], [0.0, 390.0, 176.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
T_BODY_CAMERA = camera_mount(0.10, 0.0, 0.30, pitch_down_rad=np.radians(5.0))
T_BODY_LIDAR = lidar_mount(0.05, 0.02, 0.18, yaw_left_rad=np.radians(3.0))
CORNERS, SQUARE_M = (11, 8), 0.020
PAPER_M = np.array([0.297, 0.210])
_CENTRE_M = 0.5 * SQUARE_M * np.array([CORNERS[0] - 1, CORNERS[1] - 1, 0.0])


def board_at(position, right_rad=0.0, up_rad=0.0, roll_rad=0.0, base=None):
    """Return `T_x_board` of a board with its centre at `position`, rotated relative to facing the viewer."""
    R = (np.eye(3) if base is None else base) @ so3_exp(np.array([up_rad, right_rad, roll_rad]))
    return make_transform(R, np.asarray(position) - R @ _CENTRE_M)


@functools.cache
def _rays():
    """Return float64 [4 H W, 3]: four rays per pixel, row by row."""
    step = (np.arange(2) - 0.5) / 2.0
    u, v = ((np.arange(n)[:, None] + step).ravel() for n in SIZE)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    return np.concatenate(
        [cv2.undistortPoints(uv, K, DISTORTION).reshape(-1, 2), np.ones((len(uv), 1))], axis=1
    )


def picture(T_camera_board):
    """Render the board as a grey image by intersecting each pixel's rays with the paper."""
    T = inverse(T_camera_board)
    origin, directions = T[:3, 3], _rays() @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        on = origin[:2] + directions[:, :2] * (-origin[2] / directions[:, 2])[:, None]
    cell = np.floor(on / SQUARE_M).astype(int) + 1
    squares = np.all((cell >= 0) & (cell <= np.array(CORNERS)), axis=1)
    paper = np.all(np.abs(on - _CENTRE_M[:2]) < PAPER_M / 2, axis=1)
    grey = np.where(squares & (cell.sum(axis=1) % 2 == 0), 30.0, 225.0)
    grey = np.where(paper, grey, 110.0)
    return np.round(grey.reshape(SIZE[1], 2, SIZE[0], 2).mean(axis=(1, 3))).astype(np.uint8)


def views(count, seed=1):
    """Return `T_camera_board` of tilted boards all over the image, each completely visible."""
    rng, found = np.random.default_rng(seed), []
    ends = np.array([[x, y, 0.0] for x in (-1, CORNERS[0]) for y in (-1, CORNERS[1])]) * SQUARE_M
    while len(found) < count:
        away = rng.uniform(0.33, 0.6)
        T = board_at([rng.uniform(-0.5, 0.5) * away, rng.uniform(-0.4, 0.4) * away, away],
                     rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(-0.3, 0.3))  # fmt: skip
        uv = cv2.projectPoints(transform_points(T, ends), np.zeros(3), np.zeros(3), K, DISTORTION)[0].reshape(
            -1, 2
        )
        if np.all((uv > 8) & (uv < np.array(SIZE) - 8)):
            found.append(T)
    return found


def boards_before_the_lidar(count):
    """Return `T_body_board` of boards that the beams cross, turned to the left and to the right."""
    turns = np.radians(np.linspace(-30.0, 30.0, count))
    sides = np.linspace(-0.12, 0.12, count)[::-1]
    return [
        board_at([0.75 + 0.04 * (i % 3), sides[i], 0.20], right_rad=turn, base=R_body_camera_level)
        for i, turn in enumerate(turns)
    ]


class Desk:
    """What camera and lidar see: the views in turn, or one board for both."""

    def __init__(self, count, boards=()):
        """Render all images beforehand, since emulators run in real time."""
        self._views = [_jpeg(picture(T)) for T in views(count)]
        self._boards = [(T, _jpeg(picture(inverse(T_BODY_CAMERA) @ T))) for T in boards]
        self._shown = 0
        self.T_body_board = None
        self._still = b""

    def hold(self, number):
        """Show one of the boards to both sensors."""
        self.T_body_board, self._still = self._boards[number]

    def jpeg(self):
        if self.T_body_board is not None:
            return self._still
        self._shown += 1
        return self._views[self._shown % len(self._views)]

    def range_m(self, angle_rad):
        """Return ranges to the walls, or to the board in front of them."""
        walls = room_range_m(angle_rad)
        if self.T_body_board is None:
            return walls
        T = inverse(self.T_body_board) @ T_BODY_LIDAR
        directions = (
            np.stack([np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad)], axis=-1) @ T[:3, :3].T
        )
        with np.errstate(divide="ignore"):
            ranges = -T[2, 3] / directions[:, 2]
        on = T[:3, 3] + directions * ranges[:, None]
        hit = (ranges > 0) & np.all(np.abs(on[:, :2] - _CENTRE_M[:2]) < PAPER_M / 2, axis=1)
        return np.where(hit & (ranges < walls), ranges, walls)


def _jpeg(grey):
    return cv2.imencode(".jpg", cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])[
        1
    ].tobytes()


class DeskLidar(Ld19):
    """An LD19 at five revolutions per second, which it supports: half the load of ten."""

    point_hz, speed_deg_s = 2250.0, 1800.0

    def __init__(self, desk):
        super().__init__()
        self._desk = desk

    def range_m(self, angle_rad):
        return self._desk.range_m(angle_rad)


class DeskCamera(EmulatedCamera):
    def __init__(self, desk):
        super().__init__()
        self.rate_hz = 5.0
        self.damage = lambda data: desk.jpeg()
