"""Which pixels show somebody who walks."""

import numpy as np
import pytest

from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.transforms import inverse, transform_points
from beamsplat.services.keyframes.dynamic_mask import dynamic_object_mask

CAMERA = Pinhole(530.0, 530.0, 319.5, 239.5, 640, 480)
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.45)


def walker(distance_m, side_m=0.0):
    """Returns at the ankles, and the picture's pixels on a body 0.5 m wide and 1.8 m tall at that distance."""
    y = side_m + np.linspace(-0.12, 0.12, 8)
    ankles = np.stack([np.full(8, distance_m), y, np.full(8, 0.18)], axis=1)
    corners = np.array([[distance_m, side_m + s * 0.25, z] for s in (-1, 1) for z in (0.0, 1.8)])
    points = transform_points(inverse(T_BODY_CAMERA), corners)
    uv = points[:, :2] / points[:, 2:3] * 530.0 + [319.5, 239.5]
    body = np.zeros((480, 640), bool)
    (u0, v0), (u1, v1) = uv.min(axis=0), uv.max(axis=0)
    body[max(int(v0), 0) : max(int(v1), 0), max(int(u0), 0) : max(int(u1), 0)] = True
    return ankles, body


@pytest.mark.parametrize(("distance_m", "side_m"), [(1.5, 0.0), (2.5, 0.6), (4.0, -0.8)])
@pytest.mark.parametrize("noticed", [True, False])
def test_the_whole_body_is_masked_and_little_else(distance_m, side_m, noticed):
    ankles, body = walker(distance_m, side_m)
    depth = np.full((480, 640), 6.0, np.float32)
    if noticed:
        depth[body] = distance_m - 0.1
    mask = dynamic_object_mask(ankles, depth, CAMERA, T_BODY_CAMERA)
    assert mask[body].mean() > (0.98 if noticed else 0.6)
    assert (mask & ~body).sum() < (0.5 if noticed else 0.6) * body.sum() + 4000
    assert mask[:, :5].sum() == 0


def test_what_stands_before_the_walker_is_not_masked():
    ankles, body = walker(3.0)
    depth = np.full((480, 640), 6.0, np.float32)
    depth[300:, :] = 1.2  # a table in front
    mask = dynamic_object_mask(ankles, depth, CAMERA, T_BODY_CAMERA)
    assert mask[310:, :].sum() == 0
    assert mask[100:280][body[100:280]].mean() > 0.5


def test_without_movers_nothing_is_masked():
    assert not dynamic_object_mask(
        np.zeros((0, 3)), np.ones((480, 640), np.float32), CAMERA, T_BODY_CAMERA
    ).any()


def test_a_return_alone_masks_nothing():
    """Edges and noise give single returns in free space; two ankles give several side by side."""
    depth = np.full((480, 640), 6.0, np.float32)
    alone = np.array([[2.0, -0.8, 0.18], [2.5, 0.9, 0.18], [3.0, 0.0, 0.18]])
    assert not dynamic_object_mask(alone, depth, CAMERA, T_BODY_CAMERA).any()
    together = alone[:1] + np.array([[0.0, 0.0, 0.0], [0.02, 0.05, 0.0], [0.0, 0.2, 0.0]])
    assert dynamic_object_mask(together, depth, CAMERA, T_BODY_CAMERA).any()
