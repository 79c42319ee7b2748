"""Lidar SLAM in a simulated flat with exact truth, and on recordings where available."""

import json

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.job_runner import JobRunner
from beamsplat.services.localization.lidar2d.jobs import run_job
from beamsplat.services.localization.lidar2d.map_saver import MapSaver
from beamsplat.services.localization.lidar2d.metrics import trajectory_errors
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.services.localization.lidar2d.state import MANIFEST
from tests.services.localization.world import WALLS, RayCastLidar, SimulatedDrive, box, wheels

NS = 1_000_000_000
SETTINGS = LidarSlamSettings()
START = 1_700_000_000 * NS


def run(
    slam, drive, lidar, *, odometry=None, threaded=False, start_s=0.0, end_s=None, walls_at=None, offset_s=0.0
):
    """Drive through the flat; return the results and the true poses of all scans."""
    results, truth = [], []
    end_s = drive.duration_s - 0.2 if end_s is None else end_s
    times = np.arange(start_s, end_s, lidar.beams * lidar.dt or 0.1)
    ticks = np.arange(0, drive.duration_s, 0.02)
    k = 0
    with JobRunner(slam, threaded) as jobs:
        for t in times:
            while odometry is not None and k < len(ticks) and ticks[k] <= t + 0.1:
                slam.add_odometry(START + round((ticks[k] + offset_s) * NS), *odometry[k])
                k += 1
            jobs.before_scan()
            walls = WALLS if walls_at is None else np.vstack([WALLS, walls_at(t)])
            result = slam.add_scan(
                START + round((t + offset_s) * NS), lidar.scan(drive, t, walls), *lidar.arguments()
            )
            jobs.after_scan(result)
            results.append(result)
            truth.append(drive(np.array([t]))[0])
        jobs.finish()
    return results, np.array(truth)


@pytest.fixture(scope="module")
def mapped():
    drive, lidar = SimulatedDrive(laps=1), RayCastLidar(seed=1)
    slam = LidarSlam(SETTINGS, np.eye(4))
    results, truth = run(slam, drive, lidar, odometry=wheels(drive, np.arange(0, drive.duration_s, 0.02)))
    return slam, results, truth


def test_pose_and_map_with_odometry(mapped):
    slam, results, truth = mapped
    assert {r.status for r in results} == {"ok"}
    stamps, final, online = slam.trajectory()
    assert len(stamps) == len(results)
    errors = trajectory_errors(final, truth)
    assert errors.ate_first_pose_rmse_m < 0.015
    assert errors.yaw_rmse_rad < 0.003
    assert trajectory_errors(online, truth).ate_first_pose_rmse_m < 0.02
    smooth = np.array([r.pose_odom_body for r in results])
    steps = se2.between_many(smooth[:-1], smooth[1:])
    assert np.hypot(steps[:, 0], steps[:, 1]).max() < 0.1  # 0.5 m/s at 10 Hz: no jumps
    assert np.sqrt(results[-1].covariance[0, 0]) < 0.02


def test_grid_shows_the_walls(mapped):
    slam, _, truth = mapped
    grid = slam.grid(0.05)
    pose_world_map = se2.compose(truth[0], se2.inverse(slam.trajectory()[1][0]))
    rows, cols = np.nonzero(grid.values >= 65)
    cells = np.column_stack([grid.origin_x_m + (cols + 0.5) * 0.05, grid.origin_y_m + (rows + 0.5) * 0.05])
    world = se2.transform(pose_world_map, cells)
    a, b = WALLS[:, None, :2], WALLS[:, None, 2:]
    f = np.clip(((world - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1), 0, 1)
    distance = np.hypot(*(world - (a + f[..., None] * (b - a))).transpose(2, 0, 1)).min(axis=0)
    assert len(distance) > 400
    assert np.percentile(distance, 98) < 0.075  # cells of 5 cm, walls of no thickness


@pytest.mark.parametrize(
    "lidar",
    [
        RayCastLidar(beams=180, fov=np.pi, rate_hz=5.0, sweep=False, seed=2),
        RayCastLidar(beams=1440, rate_hz=10, seed=3, sigma_m=0.02),
    ],
    ids=["180 beams of a half turn at 5 Hz", "1440 beams"],
)
def test_without_odometry(lidar):
    drive = SimulatedDrive(speed_m_s=0.4)
    lidar.dt = 0.0 if lidar.beams == 180 else lidar.dt
    slam = LidarSlam(SETTINGS, np.eye(4))
    _, truth = run(slam, drive, lidar, end_s=40.0)
    assert trajectory_errors(slam.trajectory()[1], truth).ate_first_pose_rmse_m < 0.025


def test_wrong_odometry_does_not_degrade_the_pose():
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=240, seed=4)
    ticks = np.arange(0, drive.duration_s, 0.02)
    odometry = wheels(drive, ticks)
    odometry[500:700] = odometry[500]  # frozen for four seconds, then it jumps
    odometry[900:, 0] *= -1.0  # and then the wrong sign
    slam = LidarSlam(SETTINGS, np.eye(4))
    results, truth = run(slam, drive, lidar, odometry=odometry, end_s=30.0)
    assert {r.status for r in results} == {"ok"}
    assert trajectory_errors(slam.trajectory()[1], truth).ate_first_pose_rmse_m < 0.02


def test_threading_does_not_change_the_result():
    outcomes = []
    for threaded in (False, True):
        slam = LidarSlam(SETTINGS, np.eye(4))
        run(
            slam,
            SimulatedDrive(speed_m_s=1.0),
            RayCastLidar(beams=180, seed=5),
            threaded=threaded,
            end_s=25.0,
        )
        _, final, online = slam.trajectory()
        outcomes.append((final.tobytes(), online.tobytes(), slam.grid().values.tobytes()))
    assert outcomes[0] == outcomes[1]


def test_an_overdue_job_result_raises():
    slam, drive, lidar = (
        LidarSlam(SETTINGS, np.eye(4)),
        SimulatedDrive(speed_m_s=1.0),
        RayCastLidar(beams=120),
    )

    def drive_on():
        for k in range(250):
            slam.add_scan(START + k * NS // 10, lidar.scan(drive, k * 0.1), *lidar.arguments())

    with pytest.raises(RuntimeError, match="call apply"):
        drive_on()


def test_malformed_scans_are_rejected_and_change_nothing(mapped):
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=180, seed=6)
    slam = LidarSlam(SETTINGS, np.eye(4))
    args = lidar.arguments()

    def good(k):
        return slam.add_scan(START + k * NS // 10, lidar.scan(drive, k * 0.1), *args)

    for k in range(20):
        assert good(k).status == "ok"
    nodes, stamp = len(slam.pose_graph.nodes), START + 20 * NS // 10 - 1
    for ranges in (
        np.full(180, np.inf),
        np.full(180, np.nan),
        np.full(180, -1.0),
        np.zeros(0),
        np.ones((2, 90)),
        np.ones(999),
        np.full(180, 50.0),
    ):
        result = slam.add_scan(stamp, ranges.astype(np.float32), *args)
        assert result.status.startswith("rejected: ")
        stamp += 1 if result.status.endswith("needed") else 0
    assert slam.add_scan(START, lidar.scan(drive, 2.0), *args).status.startswith("rejected: stamp")
    assert slam.add_scan(
        stamp + 9, lidar.scan(drive, 2.0), args[0], float("nan"), *args[2:]
    ).status.startswith("rejected")
    assert len(slam.pose_graph.nodes) == nodes
    for k in range(21, 30):
        assert good(k).status == "ok"


def test_a_gap_in_the_scans_and_a_clock_set_back():
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=240, seed=7)
    slam, odometry = LidarSlam(SETTINGS, np.eye(4)), wheels(drive, np.arange(0, drive.duration_s, 0.02))
    results, truth = run(slam, drive, lidar, end_s=10.0, odometry=odometry)
    later, more = run(slam, drive, lidar, start_s=15.0, end_s=25.0, odometry=odometry)  # 5 s without a scan
    assert {r.status for r in later} <= {"ok", "relocalizing"}
    both, true = np.array([r.pose_odom_body for r in results + later]), np.vstack([truth, more])
    assert trajectory_errors(both, true).ate_first_pose_rmse_m < 0.05
    back, _ = run(slam, drive, lidar, start_s=25.0, end_s=28.0, offset_s=-3600.0)
    assert [r.status.startswith("rejected") for r in back[:6]] == [True] * 4 + [False] * 2
    assert back[-1].status == "ok"


@pytest.mark.parametrize("late_s", [0.0, 5.0, 99.0], ids=["wheels", "late wheels", "no wheels"])
def test_a_recording_that_is_played_again_from_an_earlier_place_does_not_shift_the_map(late_s):
    """Stamps and robot go back by 4 s, 2 m: the new scans do not continue from the last pose.

    Wheels of the old time must not pass for those of the new time, which a slow bus delivers `late_s` later.
    """
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=240, seed=7)
    ticks = np.arange(0, drive.duration_s, 0.02)
    poses, slam, results, truth = wheels(drive, ticks), LidarSlam(SETTINGS, np.eye(4)), [], []
    with JobRunner(slam) as jobs:
        for first_s, last_s in ((0.0, 10.0), (6.0, 26.0)):
            k = round(first_s / 0.02)
            for t in np.arange(first_s, last_s, 0.1):
                while (first_s == 0.0 or t >= first_s + late_s) and ticks[k] <= t + 0.1:
                    slam.add_odometry(START + round(ticks[k] * NS), *poses[k])
                    k += 1
                jobs.before_scan()
                result = slam.add_scan(START + round(t * NS), lidar.scan(drive, t), *lidar.arguments())
                jobs.after_scan(result)
                results.append(result)
                truth.append(drive(np.array([t]))[0])
    ok = [i for i, r in enumerate(results) if r.status == "ok"]
    assert len(ok) > (290 if late_s == 0.0 else 250)
    found = np.array([se2.compose(results[i].pose_map_odom, results[i].pose_odom_body) for i in ok])
    assert trajectory_errors(found, np.array(truth)[ok]).ate_first_pose_rmse_m < 0.06


def test_dynamic_objects_are_marked_and_not_mapped():
    drive, lidar = SimulatedDrive(speed_m_s=0.3), RayCastLidar(beams=360, seed=8)

    def person(t):
        return box(2.4 + 0.9 * np.sin(0.7 * t), 2.6 + 0.4 * np.cos(0.5 * t), 0.35)

    slam = LidarSlam(SETTINGS, np.eye(4))
    run(slam, drive, lidar, end_s=8.0)
    results, truth = run(slam, drive, lidar, start_s=8.1, end_s=16.0, walls_at=person)
    marked = on_person = false = others = 0
    clean = RayCastLidar(beams=360, sigma_m=0.0)
    for k, result in enumerate(results):
        t = 8.1 + k * 0.1
        without, with_ = clean.scan(drive, t), clean.scan(drive, t, np.vstack([WALLS, person(t)]))
        hit = without - with_ > 0.3
        marked, on_person = marked + (result.dynamic & hit).sum(), on_person + hit.sum()
        false, others = false + (result.dynamic & ~hit).sum(), others + (~hit).sum()
    assert on_person > 200
    assert marked / on_person > 0.9
    assert false / others < 0.01
    assert trajectory_errors(slam.trajectory()[1][-len(truth) :], truth).ate_se3_rmse_m < 0.02


def test_global_relocalization(mapped, rng):
    slam, _, truth = mapped
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=360, seed=9, sweep=False)
    pose_world_map = se2.compose(truth[0], se2.inverse(slam.trajectory()[1][0]))
    args, sure = lidar.arguments(), 0
    for t in rng.uniform(1, drive.duration_s - 1, 12):
        pose = drive(np.array([t]))[0] + [0.05, -0.05, rng.uniform(-3, 3)]
        answer = slam.relocalize(
            lidar.scan(lambda _, p=pose: np.tile(p, (360, 1)), 0.0), args[0], args[1], *args[3:]
        )
        error = se2.between(pose, se2.compose(pose_world_map, answer.pose_map_body))
        assert np.hypot(error[0], error[1]) < 0.10
        assert abs(error[2]) < np.radians(2.0)
        sure += answer.confidence > 0.5
    assert sure >= 8  # the two rooms are ambiguous from some poses
    elsewhere = np.vstack([box(0, 0, 5.0), box(1.5, 0.2, 0.8)])
    strange = slam.relocalize(
        lidar.scan(lambda _: np.zeros((360, 3)), 0.0, elsewhere), args[0], args[1], *args[3:]
    )
    assert strange.confidence < 0.5


def test_save_load_and_continue(mapped, tmp_path):
    slam, _, truth = mapped
    slam.save(tmp_path)
    again = LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    assert again.anchors().keys() == slam.anchors().keys()
    assert np.allclose(again.trajectory()[1], slam.trajectory()[1], atol=1e-4)  # saved in steps of 0.1 mm
    assert np.array_equal(again.grid().values, slam.grid().values)
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=360, seed=10)
    results, more = run(again, drive, lidar, start_s=6.0, end_s=14.0, offset_s=1000.0)
    assert results[0].status == "relocalizing"
    assert results[-1].status == "ok"
    pose_world_map = se2.compose(truth[0], se2.inverse(slam.trajectory()[1][0]))
    placed = se2.compose_many(pose_world_map, again.trajectory()[1][-len(more) :])
    assert np.hypot(*(placed - more)[:, :2].T).max() < 0.08


def test_a_job_adds_only_its_loop_closures_to_a_saved_map(mapped, tmp_path):
    slam = mapped[0]
    saver = MapSaver(tmp_path, SETTINGS)
    saver.save(slam.saved())
    whole, nodes = saver.bytes_written, len(slam.pose_graph.nodes)
    assert whole / nodes < 8.2 * 360 + 2 * 360 + 64 + 2000  # a scan of 360 beams, and its share of submaps
    slam.pose_graph.apply(run_job(slam.pose_graph.snapshot()))
    saver.save(slam.saved())
    assert saver.bytes_written - whole < 0.02 * whole


def test_pure_localization_does_not_change_the_map(mapped, tmp_path):
    slam, _, truth = mapped
    slam.save(tmp_path)
    again = LidarSlam.load(tmp_path, SETTINGS, np.eye(4), localize_only=True)
    results, more = run(
        again, SimulatedDrive(), RayCastLidar(beams=360, seed=11), start_s=20.0, end_s=40.0, offset_s=1000.0
    )
    assert results[-1].status == "ok"
    for i, pose in slam.anchors().items():
        assert np.allclose(again.anchors()[i], pose, atol=1e-4)
    assert len(again.pose_graph.submaps) <= len(slam.pose_graph.submaps) + 5
    pose_world_map = se2.compose(truth[0], se2.inverse(slam.trajectory()[1][0]))
    ok = np.array([r.status == "ok" for r in results])
    online = np.array([se2.compose(r.pose_map_odom, r.pose_odom_body) for r in results])[ok]
    placed = se2.compose_many(pose_world_map, online)
    assert np.sqrt(np.mean(np.hypot(*(placed - more[ok])[:, :2].T) ** 2)) < 0.03


def test_a_kidnapped_robot_is_relocalized():
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=360, seed=12)
    slam = LidarSlam(SETTINGS, np.eye(4))
    _, truth = run(slam, drive, lidar, end_s=drive.duration_s - 1.0)
    results, more = run(
        slam, drive, lidar, start_s=8.0, end_s=38.0, offset_s=drive.duration_s
    )  # the robot was moved
    statuses = [r.status for r in results]
    assert "relocalizing" in statuses
    assert statuses[-1] == "ok"
    poses = slam.trajectory()[1]
    pose_world_map = se2.compose(truth[0], se2.inverse(poses[0]))
    placed = se2.compose_many(pose_world_map, poses[-50:])
    assert np.hypot(*(placed - more[-50:])[:, :2].T).max() < 0.1


def test_errors_of_invalid_states(mapped, tmp_path):
    with pytest.raises(UserError, match="no saved map here"):
        LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    mapped[0].save(tmp_path)
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    arrays = tmp_path / manifest["arrays"]
    whole = arrays.read_bytes()
    arrays.write_bytes(whole[:-100])
    with pytest.raises(UserError, match="truncated or altered"):
        LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    arrays.write_bytes(whole)
    journal = tmp_path / manifest["journal"]
    whole = journal.read_bytes()
    journal.write_bytes(whole[:-100])
    with pytest.raises(UserError, match=r"\.journal: truncated at byte"):
        LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    journal.write_bytes(whole[:5000] + b"?" + whole[5001:])
    with pytest.raises(UserError, match=r"\.journal: altered at byte"):
        LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    journal.write_bytes(whole + b"of a state that was not completed")
    LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | {"version": 99}))
    with pytest.raises(UserError, match="version 99, this program reads 1"):
        LidarSlam.load(tmp_path, SETTINGS, np.eye(4))
    (tmp_path / MANIFEST).write_text("{")
    with pytest.raises(UserError, match="cannot be read"):
        LidarSlam.load(tmp_path, SETTINGS, np.eye(4))


@pytest.mark.parametrize("known", [True, False])
def test_a_drive_goes_on_after_a_gap_without_scans_and_odometry(known):
    """For 16 s nothing is heard, in which the robot drives 8 m; the wheels have counted on, or are unknown."""
    drive, lidar = SimulatedDrive(laps=2), RayCastLidar(beams=360, seed=14)
    slam, ticks = LidarSlam(SETTINGS, np.eye(4)), np.arange(0, drive.duration_s, 0.02)
    odometry = wheels(drive, ticks)
    results, truth = [], []
    k, silent = 0, (50.0, 66.0)
    with JobRunner(slam) as jobs:
        for t in np.arange(0.0, drive.duration_s - 0.2, 0.1):
            while known and k < len(ticks) and ticks[k] <= t + 0.1:
                if not silent[0] < ticks[k] < silent[1]:
                    slam.add_odometry(START + round(ticks[k] * NS), *odometry[k])
                k += 1
            if silent[0] < t < silent[1]:
                continue
            jobs.before_scan()
            results.append(slam.add_scan(START + round(t * NS), lidar.scan(drive, t), *lidar.arguments()))
            jobs.after_scan(results[-1])
            truth.append(drive(np.array([t]))[0])
        jobs.finish()
    assert (slam.gaps_tied, slam.gaps_open) == ((1, 0) if known else (0, 1))
    after = [r.status for r in results[500:]]
    assert set(after) <= ({"lost", "ok"} if known else {"lost", "relocalizing", "ok"})
    assert ("relocalizing" in after) != known
    assert after[-1] == "ok"
    assert after.count("lost") <= 5
    stamps, final, _ = slam.trajectory()
    assert len(stamps) == len(results)  # no scan is without a pose, those right after the gap included
    assert trajectory_errors(final, np.array(truth)).ate_first_pose_rmse_m < 0.03
    assert np.hypot(*(se2.between(final[0], final[505]) - se2.between(truth[0], truth[505]))[:2]) < 0.15


@pytest.mark.parametrize("pause_s", [2.5, 20.0])
def test_a_robot_that_stands_through_a_pause_of_its_lidar_goes_on_in_the_same_map(pause_s):
    drive, lidar = SimulatedDrive(), RayCastLidar(beams=360, seed=15)
    slam, results = LidarSlam(SETTINGS, np.eye(4)), []
    for t in [*np.arange(0.0, 1.0, 0.1), *(pause_s + np.arange(1.0, 2.0, 0.1))]:
        stamp = START + round(t * NS)
        slam.add_odometry(stamp, 0.0, 0.0, 0.0)
        slam.add_odometry(stamp + round(0.1 * NS), 0.0, 0.0, 0.0)
        results.append(slam.add_scan(stamp, lidar.scan(drive, 0.0), *lidar.arguments()))
    assert {r.status for r in results} == {"ok"}
    assert (slam.gaps_tied, slam.gaps_open) == (0, 0)
    assert np.abs(results[-1].pose_odom_body).max() < 0.01
