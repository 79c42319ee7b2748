"""The top view of a map: objects at their position and scale, without the ceiling."""

import numpy as np
import pytest

from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, PARAMS, QUAT, SCALE
from beamsplat.tools.report.top_view import top_view


def tiles(low, high, z, colour, step=0.05):
    """Return Gaussians float32 [PARAMS, N] that cover a rectangle (x, y) at a height."""
    x, y = (
        a.ravel() for a in np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    )
    out = np.zeros((PARAMS, len(x)), np.float32)
    out[MEAN : MEAN + 3] = x, y, np.full(len(x), z)
    out[SCALE : SCALE + 3] = np.log([[0.04], [0.04], [0.005]])
    out[QUAT], out[OPACITY] = 1.0, 4.0
    out[COLOUR : COLOUR + 3] = np.array(colour)[:, None]
    return out


@pytest.fixture
def room():
    return np.concatenate([
        tiles((-2, -1), (2, 1), 0.0, (0.5, 0.5, 0.5)),
        tiles((1.2, 0.2), (1.8, 0.8), 0.7, (1.0, 0.0, 0.0)),  # a red table to the upper right
        tiles((-2, -1), (2, 1), 2.5, (0.0, 1.0, 0.0)),  # the ceiling
    ], axis=1)  # fmt: skip


def test_objects_appear_at_their_position(room):
    image = top_view(room, metres_per_px=0.02)
    h, w = image.shape[:2]
    assert w * 0.02 == pytest.approx(4.0 + 0.8, abs=0.1)  # a margin around
    assert h * 0.02 == pytest.approx(2.0 + 0.8, abs=0.1)

    def at(x, y):
        return image[round((h - 1) / 2 - y / 0.02), round((w - 1) / 2 + x / 0.02)].astype(int)

    assert np.abs(at(1.5, 0.5) - [0, 0, 255]).max() < 30  # BGR
    assert np.abs(at(-1.5, 0.5) - 128).max() < 30
    assert np.abs(at(1.5, -0.5) - 128).max() < 30
    assert np.abs(at(-2.3, 0.0) - 255).max() == 0  # nothing there


def test_a_path_is_drawn_on_it(room):
    path = np.array([[-1.5, -0.5], [1.0, -0.5]])
    plain, drawn = top_view(room), top_view(room, path)
    changed = np.argwhere(np.any(plain != drawn, axis=2))
    h, w = plain.shape[:2]
    x = (changed[:, 1] - (w - 1) / 2) * 0.015
    y = ((h - 1) / 2 - changed[:, 0]) * 0.015
    assert x.min() == pytest.approx(-1.5, abs=0.06)
    assert x.max() == pytest.approx(1.0, abs=0.06)
    assert np.abs(y + 0.5).max() < 0.06


def test_a_map_of_only_a_ceiling_has_no_top_view(room):
    assert top_view(room[:, room[2] > 2.0]) is None
