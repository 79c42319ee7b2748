"""A textured room by ray casting: a low cupboard along the end wall, which hides the wall from the lidar."""

import cv2
import numpy as np

from beamsplat.common.geometry.beams import Beams
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import inverse, transform_points

CAMERA = Pinhole(265.0, 265.0, 159.5, 119.5, 320, 240)
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.035)
LIDAR_Z = 0.18
# axis, position, and on the other axes the range in which the surface exists
_SURFACES = (
    (2, 0.0, {}),
    (2, 2.4, {}),
    (0, 5.0, {}),
    (1, 1.8, {}),
    (1, -1.8, {}),
    (0, 4.2, {2: (0.0, 0.75)}),
    (2, 0.75, {0: (4.2, 5.0)}),
)
CLOSED = (*_SURFACES, (0, -1.5, {}))  # with a wall behind: for robots that turn around
CLOSED_WALLS = np.array(  # what the lidar sees of it: segments (x, y, x, y) in m
    [[-1.5, -1.8, 4.2, -1.8], [4.2, -1.8, 4.2, 1.8], [4.2, 1.8, -1.5, 1.8], [-1.5, 1.8, -1.5, -1.8]]
)


def _textures():
    rng = np.random.default_rng(11)
    out = []
    for _ in CLOSED:
        coarse = cv2.resize(
            rng.uniform(0, 255, (32, 32)).astype(np.float32), (512, 512), interpolation=cv2.INTER_CUBIC
        )
        fine = cv2.resize(
            rng.uniform(0, 255, (128, 128)).astype(np.float32), (512, 512), interpolation=cv2.INTER_LINEAR
        )
        out.append(np.clip(0.6 * coarse + 0.4 * fine, 0, 255))
    return out


_TEXTURES = _textures()


def cast(origin, directions, surfaces=_SURFACES):
    """(distance along each direction [N], surface number [N]) of the first hit."""
    best = np.full(len(directions), np.inf)
    which = np.zeros(len(directions), int)
    for number, (axis, position, limits) in enumerate(surfaces):
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (position - origin[axis]) / directions[:, axis]
            hit = origin + s[:, None] * directions
        ok = (s > 1e-6) & (s < best)
        for other, (low, high) in limits.items():
            ok &= (hit[:, other] >= low) & (hit[:, other] <= high)
        best[ok], which[ok] = s[ok], number
    return best, which


def render(T_map_body, camera=CAMERA, surfaces=_SURFACES):
    """(uint8 [H, W, 3], float32 [H, W] optical z) of the room."""
    T = T_map_body @ T_BODY_CAMERA
    rays = camera.ray_grid().reshape(-1, 3) @ T[:3, :3].T
    z, which = cast(T[:3, 3], rays, surfaces)
    hit = T[:3, 3] + z[:, None] * rays
    grey = np.zeros(len(z))
    for number, (axis, _, _) in enumerate(surfaces):
        mine = np.flatnonzero(which == number)
        for part in np.array_split(mine, 1 + len(mine) // 30_000):  # remap takes fewer than 32768 rows
            a, b = (hit[part][:, k] for k in range(3) if k != axis)
            x, y = (np.mod(a * 64.0, 511.0), np.mod(b * 64.0, 511.0))
            if len(part):
                grey[part] = cv2.remap(
                    _TEXTURES[number],
                    x.astype(np.float32)[:, None],
                    y.astype(np.float32)[:, None],
                    cv2.INTER_LINEAR,
                )[:, 0]
    image = np.repeat(grey.reshape(camera.shape)[..., None], 3, axis=2).astype(np.uint8)
    return image, z.reshape(camera.shape).astype(np.float32)


def scan(T_map_body, rng=None, count=720):
    """Beams at the pose, 1 cm of noise if a generator is given."""
    angle = np.linspace(-np.pi, np.pi, count, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    origin = transform_points(T_map_body, np.array([[0.0, 0.0, LIDAR_Z]]))[0]
    r, _ = cast(origin, direction @ T_map_body[:3, :3].T)
    good = np.isfinite(r)
    r = r[good] + (rng.normal(0, 0.01, good.sum()) if rng is not None else 0.0)
    points = r[:, None] * direction[good] + [0.0, 0.0, LIDAR_Z]
    return Beams(points, np.flatnonzero(good), np.full(good.sum(), 0.01))


def in_map(T_map_body, beams):
    return transform_points(T_map_body, beams.points_body_m)


__all__ = [
    "CAMERA",
    "CLOSED",
    "CLOSED_WALLS",
    "LIDAR_Z",
    "T_BODY_CAMERA",
    "cast",
    "in_map",
    "inverse",
    "render",
    "scan",
]
