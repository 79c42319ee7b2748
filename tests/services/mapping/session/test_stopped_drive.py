"""A drive that is stopped in the middle and goes on from a start that nobody told: the same map as without
the stop.
"""

import cv2
import numpy as np
import pytest

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.geometry.trajectory import read_tum
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.mapfiles.scores import render_rgb_depth, score_view
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import store_of
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.tools.evaluation.dataset import read_depth_png, read_offpath_views
from beamsplat.tools.report.scores import pose_errors, rigid_offset
from beamsplat.tools.system.assembly import build_node

SECONDS, STOPPED_AT_S, GOES_ON_AT_S = 60.0, 30.0, 26.0
CAMERA = RasterCamera(530.0, 530.0, 319.5, 239.5, 640, 480)


def drive(shared_dir, folder, start_s, duration_s, resume=None, final_steps=150):
    """One run of all nodes: the session in `folder`/map, the robot's state in `folder`/robot. Gives the
    keyframes' (stamps, T_map_body) at its end, and the statuses of localization.
    """
    nodes = {
        "replay": {"data": str(shared_dir / "data/house_a/bag"), "start_s": start_s, "duration_s": duration_s},
        "localization": {"kind": "lidar", "save": str(folder / "robot")},
        "depth": {"source": "stixel"}, "fusion": {}, "keyframes": {},
        "mapping": {"session": str(folder / "map"), "final_steps": final_steps, "half_steps": 12, "full_steps": 4},
    }  # fmt: skip
    if resume is not None:
        nodes["localization"]["resume"] = str(resume)
    poses, statuses = [], []

    def on_message(letter):
        if letter.topic == "mapping/poses":
            poses.append(letter.message)
        elif letter.topic == "localization/odometry":
            statuses.append(letter.message.status)

    deployment = Deployment(nodes=nodes)
    made = [build_node(deployment, name) for name in nodes]
    Lockstep(made, on_message).run()
    for node in made:
        node.close()
    return (poses[-1].stamps_ns, poses[-1].T_map_body), statuses


def scores(shared_dir, session, poses):
    """(mean PSNR in dB at views off the path that this part of the drive saw, ATE in m, T_world_map)."""
    truth = read_tum(shared_dir / "data/house_a/groundtruth.txt")
    stamps_ns, T_map_body = poses
    answered, T_world_body = truth.resampled(stamps_ns)
    found = T_map_body[answered]
    T_world_map = rigid_offset(found, T_world_body)
    store, rasterizer, at_views = store_of(SessionFolder(session).read_state()), Rasterizer(), {}
    for number, view in enumerate(read_offpath_views(shared_dir / "data/house_a/extra_views")):
        T_map_camera = inverse(T_world_map) @ view.T_map_camera
        rgb, depth, alpha = render_rgb_depth(rasterizer, store, CAMERA, T_map_camera)
        if alpha.mean() > 0.95:
            true_rgb = cv2.cvtColor(cv2.imread(str(view.image_file)), cv2.COLOR_BGR2RGB)
            at_views[number] = score_view(rgb, depth, true_rgb, read_depth_png(view.depth_file)).psnr_db
    return at_views, pose_errors(found, T_world_body)["ate_se3_rmse_m"]


@pytest.mark.slow
def test_a_stopped_drive_ends_where_an_uninterrupted_one_does(shared_dir, tmp_path):
    """Stopped after half a minute; the robot is carried back four seconds' way and told nothing. Within 0.3
    dB at views that neither has seen, and within 1 cm of the poses' error.
    """
    whole, _ = drive(shared_dir, tmp_path / "whole", 0.0, SECONDS)
    psnr_whole, ate_whole = scores(shared_dir, tmp_path / "whole" / "map", whole)
    go = tmp_path / "stopped"
    drive(shared_dir, go, 0.0, STOPPED_AT_S, final_steps=0)
    rest, statuses = drive(shared_dir, go, GOES_ON_AT_S, SECONDS - GOES_ON_AT_S, resume=go / "robot")
    found_after = statuses.index("ok")
    psnr_rest, ate_rest = scores(shared_dir, go / "map", rest)
    views = sorted(psnr_whole.keys() & psnr_rest.keys())
    dB = [float(np.mean([at[view] for view in views])) for at in (psnr_whole, psnr_rest)]
    print(f"\nuninterrupted {dB[0]:.2f} dB, ATE {1e3 * ate_whole:.1f} mm, {len(whole[0])} keyframes; stopped and relocalized "
          f"after {found_after} scans {dB[1]:.2f} dB, ATE {1e3 * ate_rest:.1f} mm, {len(rest[0])} keyframes; "
          f"{len(views)} views ({len(psnr_whole)}, {len(psnr_rest)})")  # fmt: skip
    assert "relocalizing" in statuses[:found_after]
    assert len(views) >= 10
    assert len(psnr_rest) >= len(psnr_whole) - 1
    assert abs(dB[1] - dB[0]) < 0.3 or dB[1] > dB[0]
    assert ate_rest < ate_whole + 0.01
