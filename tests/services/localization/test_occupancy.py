import cv2
import numpy as np

from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.dynamic_objects import contradicts_free_space, grow_along_beams
from beamsplat.services.localization.lidar2d.occupancy import (
    CountGrid,
    OccupancyGrid,
    render_occupancy,
    save_nav2,
)
from beamsplat.services.localization.lidar2d.surfel_kernels import cast_rays


def counts(shape=(20, 30)):
    hits, misses = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    hits[5, 3:25] = 10
    misses[6:15, 3:25] = 10
    return hits, misses


def test_walls_and_floor_are_at_the_right_place():
    hits, misses = counts()
    pose = np.array([2.0, 1.0, np.pi / 2])
    grid = render_occupancy([(CountGrid(hits, misses, 0, 0, 0.05), pose)], 0.05)
    wall = se2.transform(pose, np.array([[0.5, 5.5 * 0.05]]))[0]
    floor = se2.transform(pose, np.array([[0.5, 10.5 * 0.05]]))[0]

    def at(p):
        return grid.values[int((p[1] - grid.origin_y_m) / 0.05), int((p[0] - grid.origin_x_m) / 0.05)]

    assert at(wall) > 90
    assert 0 <= at(floor) < 10
    assert grid.values[0, 0] == -1
    assert (grid.values >= 0).sum() == ((hits > 0) | (misses > 0)).sum()  # rotation leaves no holes


def test_rendering_against_reference_code(rng):
    hits = rng.integers(0, 3, (12, 9)).astype(np.uint8)
    misses = rng.integers(0, 3, (12, 9)).astype(np.uint8)
    pose = np.array([0.3, -0.2, 0.7])
    grid = render_occupancy([(CountGrid(hits, misses, -4, -3, 0.1), pose)], 0.05)
    for r in range(0, grid.values.shape[0], 3):
        for c in range(0, grid.values.shape[1], 3):
            p = np.array([[grid.origin_x_m + (c + 0.5) * 0.05, grid.origin_y_m + (r + 0.5) * 0.05]])
            q = np.floor(se2.transform(se2.inverse(pose), p)[0] / 0.1).astype(int)
            i, j = q[1] + 4, q[0] + 3
            inside = 0 <= i < 12 and 0 <= j < 9 and (hits[i, j] or misses[i, j])
            expected = 1 / (1 + np.exp(-(1.5 * hits[i, j] - 0.5 * misses[i, j]))) if inside else None
            assert grid.values[r, c] == (-1 if expected is None else round(100 * expected))


def test_nav2_files(tmp_path):
    values = np.full((64, 64), -1, np.int8)
    values[10, 20], values[11, 20] = 100, 0
    save_nav2(OccupancyGrid(values, -1.0, 2.0, 0.05), tmp_path)
    image = cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (64, 64)
    assert image[63 - 10, 20] == 0  # pgm rows run from the top
    assert image[63 - 11, 20] == 254
    assert image[0, 0] == 205
    text = (tmp_path / "map.yaml").read_text()
    assert "image: map.pgm" in text
    assert "origin: [-1.000000, 2.000000, 0.0]" in text
    assert (tmp_path / "map.png").stat().st_size > 0
    # Interpret the image as map_server does (trinary): unknown cells must stay unknown.
    limits = dict(line.split(": ") for line in text.splitlines() if "thresh" in line)
    occupancy = (255.0 - image.astype(float)) / 255.0
    occupied, free = occupancy > float(limits["occupied_thresh"]), occupancy < float(limits["free_thresh"])
    np.testing.assert_array_equal(np.where(occupied, 100, np.where(free, 0, -1))[::-1], values)


def test_rays_count_misses_up_to_the_wall():
    hits, misses = np.zeros((40, 40), np.uint8), np.zeros((40, 40), np.uint8)
    touched = np.full((40, 40), -1, np.int32)
    origin, end = np.array([0.12, 0.13]), np.array([[1.51, 0.92]])
    cast_rays(end, np.array([True]), origin, 0, hits, misses, touched, 0, 0, 0.05)
    length = np.hypot(*(end[0] - origin)) - 1.5 * 0.05
    along = origin + (end[0] - origin) / np.hypot(*(end[0] - origin)) * np.linspace(0, length, 20000)[:, None]
    crossed = {tuple(c) for c in np.floor(along[:, ::-1] / 0.05).astype(int)}
    assert {tuple(c) for c in np.argwhere(misses)} == crossed
    assert misses.max() == 1


def test_returns_in_free_space_are_dynamic():
    hits, misses = np.zeros((40, 40), np.uint8), np.full((40, 40), 20, np.uint8)
    nearest = np.full((40, 40), -1, np.int32)
    hits[:, 30] = 20
    nearest[:, 25:36] = 0
    misses[20:, :] = 0  # unknown half
    means = np.array([[30.5 * 0.05, 0.5]])
    points = np.array([[0.5, 0.5], [30.5 * 0.05, 0.5], [0.5, 1.5], [1.43, 0.52]])
    out = np.empty(4, dtype=bool)
    contradicts_free_space(points, np.zeros(3), nearest, means, hits, misses, 0, 0, 0.05, out)
    assert out.tolist() == [True, False, False, False]  # free, wall, unknown, next to the wall


def test_the_dynamic_mask_grows_to_the_edge_of_the_object_only():
    points = np.column_stack([np.arange(10) * 0.05, np.ones(10)])
    points[6:] += [2.0, 0.0]  # another object behind a gap
    moving = np.zeros(10, dtype=bool)
    moving[2:5] = True
    out = np.empty(10, dtype=bool)
    grow_along_beams(moving, points, np.arange(10, dtype=np.int32), 0.15, out)
    assert out.tolist() == [True, True, True, True, True, True, False, False, False, False]
