"""A second drive continues the map of the first: relocalization, same submaps, one saved state."""

import json
import threading
from dataclasses import replace

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse, se2_to_se3
from beamsplat.common.messages import LidarModel, Rig, Scan
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.services.localization.lidar2d.node import LidarLocalization
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from tests.services.localization.world import RayCastLidar, SimulatedDrive

T0 = 1_000_000_000_000
PATH = SimulatedDrive()


def drive(node, start_s, end_s, seed, day):
    """Drive through the flat.

    Return the messages by topic, and the poses (true, published) of the scans with status "ok".
    """
    lidar, sent, poses, T_map_odom = RayCastLidar(seed=seed), {}, [], np.eye(4)
    angle_min, increment, dt, least, most = lidar.arguments()

    def take(outputs):
        nonlocal T_map_odom
        for output in outputs:
            if not isinstance(output, tuple):
                jobs.append([output.after or 0, output])
                continue
            sent.setdefault(output[0], []).append(output[1])
            if output[0] == "localization/correction":
                T_map_odom = output[1].T_map_odom

    jobs = []
    take(node.handle("rig", Rig(stamp_ns=T0, lidar=LidarModel(T_body_lidar=np.eye(4)))))
    for number in range(int((end_s - start_s) * 10)):
        t = start_s + number * 0.1
        for job in jobs:
            job[0] -= 1
        for _, job in [j for j in jobs if j[0] <= 0]:
            take(node.handle_job(job.name, job.run()))
        jobs = [j for j in jobs if j[0] > 0]
        scan = Scan(stamp_ns=T0 + day * 86_400 * 10**9 + int(t * 1e9), angle_min_rad=angle_min,
                    angle_increment_rad=increment, time_increment_s=dt, scan_time_s=0.1, range_min_m=least,
                    range_max_m=most, ranges_m=lidar.scan(PATH, t))  # fmt: skip
        take(node.handle("lidar/scan", scan))
        if sent["localization/odometry"][-1].status == "ok":
            odometry = sent["localization/odometry"][-1]
            poses.append((se2_to_se3(PATH(np.array([t]))[0]), T_map_odom @ odometry.T_odom_body))
    for _, job in jobs:
        take(node.handle_job(job.name, job.run()))
    take(node.handle_drain())
    return sent, poses


def fitted(world, mapped):
    """Return the rigid motion [3] that maps map poses [N, 3] to world poses, in least squares."""
    a, b = world[:, :2] - world[:, :2].mean(0), mapped[:, :2] - mapped[:, :2].mean(0)
    yaw = np.arctan2((b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([*(world[:, :2].mean(0) - [[c, -s], [s, c]] @ mapped[:, :2].mean(0)), yaw])


def make(home=None, **options):
    node = LidarLocalization(LidarLocalization.Config(kind="lidar", **options))
    node.live_settings = home
    node.configure()
    return node


def test_a_stop_without_time_for_the_final_optimisation_keeps_the_map(tmp_path, monkeypatch):
    node, may_end, finished = make(save=tmp_path / "map"), threading.Event(), []
    monkeypatch.setattr(LidarSlam, "finish", lambda slam: may_end.wait(60.0) and finished.append(slam))
    node.must_stop = lambda: True
    _, poses = drive(node, 0.0, 4.0, 1, 0)
    assert not finished  # it was not waited for
    may_end.set()
    opened = LidarSlam.load(tmp_path / "map", LidarSlamSettings(), np.eye(4))
    _, saved, _ = opened.trajectory()
    assert len(saved) == len(poses) > 30
    true = np.array([T[:2, 3] for T, _ in poses])
    assert np.linalg.norm(np.diff(saved[[0, -1], :2], axis=0)) == pytest.approx(
        np.linalg.norm(true[-1] - true[0]), abs=0.05
    )


@pytest.mark.slow
def test_a_second_drive_continues_the_map_of_the_first(tmp_path):
    node = make(save=tmp_path / "map")
    first, _ = drive(node, 0.0, 36.0, 1, 0)
    old = set(first["localization/anchors"][-1].anchor_ids.tolist())
    _, optimised, _ = node._slam.trajectory()
    T_world_map = se2_to_se3(fitted(PATH(np.arange(len(optimised)) * 0.1), optimised))
    second, after = drive(make(resume=tmp_path / "map", save=tmp_path / "map"), 14.0, 42.0, 2, 1)
    statuses = [o.status for o in second["localization/odometry"]]
    assert statuses[0] == "relocalizing"
    assert statuses.index("ok") < 100  # within ten seconds of the drive
    assert set(statuses[statuses.index("ok") :]) == {"ok"}
    errors = [inverse(true) @ T_world_map @ shown for true, shown in after]
    off_m = [np.hypot(*e[:2, 3]) for e in errors]
    assert np.percentile(off_m, 95) < 0.05
    anchors = second["localization/anchors"][-1].anchor_ids.tolist()
    assert old < set(anchors)  # the anchors of the first drive still exist
    table = json.loads((tmp_path / "map" / "lidar_map.json").read_text())
    assert table["submaps"] == len(anchors)


@pytest.mark.slow
def test_a_crashed_process_continues_its_checkpoint(tmp_path):
    home = LiveSettings("r1", (), tmp_path)
    node = make(home, keep_every_s=5.0)
    first, _ = drive(node, 0.0, 36.0, 1, 0)
    _, optimised, _ = node._slam.trajectory()
    T_world_map = se2_to_se3(fitted(PATH(np.arange(len(optimised)) * 0.1), optimised))
    second, after = drive(make(replace(home, resume=True)), 39.0, 52.0, 2, 0)
    statuses = [o.status for o in second["localization/odometry"]]
    assert statuses.index("ok") < 100  # within ten seconds of the drive
    errors = [inverse(true) @ T_world_map @ shown for true, shown in after]
    assert np.percentile([np.hypot(*e[:2, 3]) for e in errors], 95) < 0.05
    names = {a.map_uuid for sent in (first, second) for a in sent["localization/anchors"]}
    assert len(names) == 1
    assert second["localization/anchors"][0].map_uuid  # published before the first pose
    kept = set(second["localization/anchors"][0].anchor_ids.tolist())
    begun = set(second["localization/anchors"][-1].anchor_ids.tolist()) - kept
    lost = set(first["localization/anchors"][-1].anchor_ids.tolist()) - kept
    assert begun
    assert not begun & lost  # ids of submaps after the checkpoint are not used again
    third, _ = drive(make(home), 0.0, 5.0, 3, 0)  # another run starts a new map
    assert {a.map_uuid for a in third["localization/anchors"]}.isdisjoint(names)


def test_an_unreadable_state_is_reported_before_the_start(tmp_path):
    with pytest.raises(UserError, match=r"localization\.resume: .*no saved map here"):
        make(resume=tmp_path)
