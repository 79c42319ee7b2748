"""The whole command on two sessions: a box that hangs above the plane of the lidar is gone in the second."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.geometry.transforms import inverse, se2_to_se3
from beamsplat.common.mapfiles.ply import read_ply_points
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.services.localization.lidar2d import se2
from beamsplat.tools.cli.main import app
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, make_node, message
from tests.tools.compare.drives import mapped_flat, pose_in

BOX = np.array([1.9, 1.4, 0.5, 2.3, 1.8, 1.3])  # low and high corner in the world


def with_box(number):
    """Return image and depth of the synthetic room with a red box in it."""
    rgb, depth = (array.copy() for array in r.shot(number))
    T = r.T_map_body(number) @ r.T_BODY_CAMERA
    v, u = np.mgrid[: r.HEIGHT, : r.WIDTH]
    rays = np.stack([(u - 79.5) / r.FOCAL, (v - 59.5) / r.FOCAL, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    t0, t1 = ((corner - T[:3, 3]) / rays for corner in (BOX[:3], BOX[3:]))
    enter, leave = np.minimum(t0, t1).max(axis=-1), np.maximum(t0, t1).min(axis=-1)
    hit = (enter < leave) & (enter > 0) & ~(depth < enter)
    rgb[hit], depth[hit] = (200, 40, 30), enter[hit]
    return rgb, depth


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """The folder with both sessions, and the poses of their maps in the world; lidar and room share the world."""
    root, poses = tmp_path_factory.mktemp("sessions"), []
    for k, (name, start_s) in enumerate((("monday", 0.0), ("tuesday", 3.0))):
        slam, pose_world_map = mapped_flat(None, start_s, 13.0, seed=k)
        T_map_world = inverse(se2_to_se3(pose_world_map))
        node = make_node(root / name, half_steps=8, full_steps=6)
        for number in range(9):
            whole = message(number, stamp_ns=r.T0 + (3600 * k + number) * SECOND)
            T_map_anchor = se2_to_se3(slam.anchors()[0])
            T_map_body = T_map_world @ r.T_map_body(number)
            change = {
                "anchor_id": 0,
                "T_map_anchor": T_map_anchor,
                "T_anchor_body": inverse(T_map_anchor) @ T_map_body,
            }
            if name == "monday":
                rgb, depth = with_box(number)
                change |= {
                    "picture": cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].ravel(),
                    "depth": pack_depth(depth),
                    "sigma": pack_sigma(np.full_like(depth, 0.01)),
                }
            list(node.handle("keyframes/frame", whole.model_copy(update=change)))
        list(node.drain())
        node.close()
        slam.save(root / name / "robot")
        poses.append(pose_world_map)
    return root, poses


def test_the_box_is_reported_where_it_was_with_pictures_and_points(sessions, tmp_path):
    root, (pose_world_a, pose_world_b) = sessions
    words = ["compare", str(root / "monday"), str(root / "tuesday"), "--out", str(tmp_path), "--json"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    table = json.loads(done.stdout)
    assert table == json.loads((tmp_path / "changes.json").read_text())
    off = se2.between(pose_in(pose_world_a, pose_world_b), np.array(table["alignment"]["pose_first_second"]))
    assert np.hypot(off[0], off[1]) < 0.03
    assert [o["kind"] for o in table["objects"]] == ["vanished"]
    found = table["objects"][0]
    at = se2.transform(pose_world_a, np.array([found["centre_m"][:2]]))[0]
    assert at == pytest.approx((BOX[:2] + BOX[3:5]) / 2, abs=0.25)
    assert BOX[2] < found["centre_m"][2] < BOX[5]  # other boxes hide its lower part
    assert found["evidence"]["lidar_cells"] == 0
    assert found["evidence"]["keyframes_through"] >= 3
    assert found["appearance_difference"] > 0.1  # red against the wall
    for name in ("top_view.png", "object_1.png"):
        assert cv2.imread(str(tmp_path / name)) is not None
    assert len(read_ply_points(tmp_path / "changes.ply")) > 1000
