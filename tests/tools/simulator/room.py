"""An empty box room in which every range is known analytically."""

import numpy as np

from beamsplat.tools.simulator.mesh import Material

HALF_X, HALF_Y, HEIGHT = 3.0, 2.0, 2.5


WALL = Material("noise")


def draw_room(b, wall=WALL, east=None):
    """Draw the inner faces of a 6 x 4 x 2.5 m room around the origin."""
    x, y, z = 2 * HALF_X, 2 * HALF_Y, HEIGHT
    b.quad((-HALF_X, -HALF_Y, 0), (x, 0, 0), (0, y, 0), wall)
    b.quad((-HALF_X, HALF_Y, z), (x, 0, 0), (0, -y, 0), wall)
    b.quad((-HALF_X, HALF_Y, 0), (x, 0, 0), (0, 0, z), wall)
    b.quad((HALF_X, -HALF_Y, 0), (-x, 0, 0), (0, 0, z), wall)
    b.quad((HALF_X, HALF_Y, 0), (0, -y, 0), (0, 0, z), east or wall)
    b.quad((-HALF_X, -HALF_Y, 0), (0, y, 0), (0, 0, z), wall)


def room_distance(origin, direction):
    """Return the distance along rays from inside the room to its walls, for arrays [..., 3]."""
    low, high = np.array([-HALF_X, -HALF_Y, 0.0]), np.array([HALF_X, HALF_Y, HEIGHT])
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(direction > 0, (high - origin) / direction, (low - origin) / direction)
    return np.min(np.where(np.abs(direction) < 1e-12, np.inf, t), axis=-1)
