"""`beamsplat session`: join the robot half, merge two drives into one map and one grid, prune."""

import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse, se2_to_se3
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.merge import find_alignment, merge_into
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.tools.cli.main import app
from beamsplat.tools.sessions.edit import merged, pruned, summary_of, with_anchors
from tests.services.localization.world import WALLS, RayCastLidar, SimulatedDrive
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, feed, make_node, message

ORIGIN = np.eye(4)
T_A_B = se2_to_se3(np.array([0.4, -0.3, 0.5]))  # pose of the second map in the first


def psnr(arrays, number, T=ORIGIN):
    """Of a state's render at the path's pose `number`, seen through T, against the truth (dB)."""
    params = np.zeros((14, -(-arrays["store_params"].shape[1] // 16) * 16), np.float32)
    count = arrays["store_params"].shape[1]
    params[:, :count] = arrays["store_params"]
    T_map_camera = T @ r.T_map_body(number) @ r.T_BODY_CAMERA
    image = Rasterizer().render(params, count, r.CAMERA, inverse(T_map_camera)).image
    truth = r.shot(number)[0].transpose(2, 0, 1) / 255.0
    return -10.0 * np.log10(np.mean((np.clip(image[:3], 0.0, 1.0) - truth) ** 2))


def run(*words):
    """Return the output of a command; raise its UserError."""
    result = CliRunner().invoke(app, ["session", *map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Folders of two sessions: the path's first half, and the second in a map frame of its own."""
    root = tmp_path_factory.mktemp("drives")
    for name, numbers in (("a", range(5)), ("b", range(4, 9))):
        node = make_node(root / name, half_steps=8, full_steps=6)
        for number in numbers:
            T = np.eye(4) if name == "a" else inverse(T_A_B)
            whole = message(number, stamp_ns=r.T0 + number * SECOND + (name == "b") * 3600 * SECOND)
            frame = whole.model_copy(update={"T_map_anchor": T @ whole.T_map_anchor})
            assert dict(node.handle("keyframes/frame", frame))["keyframes/ack"].status == "ok"
        list(node.drain())
        node.close()
    return root


def test_anchors_move_their_part_of_the_map(drives):
    arrays = SessionFolder(drives / "a").read_state()
    T = se2_to_se3(np.array([3.0, -2.0, 1.2]))
    places = {a: T @ place for a, place in zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"])}
    moved = with_anchors(arrays, places)
    assert psnr(moved, 2, T) == pytest.approx(psnr(arrays, 2), abs=0.1)
    assert psnr(moved, 2) < psnr(arrays, 2) - 3.0
    assert summary_of(moved) == summary_of(arrays)


def test_two_drives_become_one_map_that_can_be_resumed(drives, tmp_path):
    """Both halves of the path render; a mapper resumes with all keyframes, closes the gap between the maps and continues."""
    x, y, yaw = 0.4, -0.3, np.degrees(0.5)
    out = run("merge", drives / "a", drives / "b", "--out", tmp_path / "c", "--place", f"{x},{y},{yaw}")
    assert "10 keyframes" in out
    a, b, c = (SessionFolder(p).read_state() for p in (drives / "a", drives / "b", tmp_path / "c"))
    both = a["store_params"].shape[1] + b["store_params"].shape[1]
    left = c["store_params"].shape[1]
    assert 0.5 * both < left < 0.8 * both
    assert f"{both - left} duplicates removed" in out
    alone = psnr(a, 1), psnr(b, 7, inverse(T_A_B))
    assert psnr(c, 1) > alone[0] - 1.3  # 3.3 dB less with all of both: walls in front of walls
    assert psnr(c, 7) > alone[1] - 0.8
    assert len(set(c["anchor_id"].tolist())) == len(a["anchor_id"]) + len(b["anchor_id"])
    node = make_node(tmp_path / "c")
    assert len(node._mapper.keyframes) == 10
    feed(node, [9])
    node._mapper.refine(150)
    list(node.drain())
    node.close()
    mended = SessionFolder(tmp_path / "c").read_state()
    assert psnr(mended, 1) > alone[0]
    assert psnr(mended, 7) > alone[1]
    uuids = {
        json.loads(run("info", p, "--json"))["uuid"] for p in (drives / "a", drives / "b", tmp_path / "c")
    }
    assert len(uuids) == 3


def test_merging_refuses_what_cannot_be_merged(drives, tmp_path):
    a, b = drives / "a", drives / "b"
    with pytest.raises(UserError, match="they are of the same run"):
        run("merge", a, a, "--out", tmp_path / "c", "--place", "0,0,0")
    with pytest.raises(UserError, match="has no robot half"):
        run("merge", a, b, "--out", tmp_path / "c")
    with pytest.raises(UserError, match="expected X,Y,DEG"):
        run("merge", a, b, "--out", tmp_path / "c", "--place", "0,0")
    with pytest.raises(UserError, match="contains a session already"):
        run("merge", a, b, "--out", b, "--place", "0,0,0")
    arrays = [SessionFolder(p).read_state() for p in (a, b)]
    with pytest.raises(UserError, match="exist in the first"):
        merged(*arrays, np.eye(4), 0)
    assert not (tmp_path / "c" / "session.json").exists()


def test_pruning_keeps_the_visible_map(drives, tmp_path):
    arrays = SessionFolder(drives / "a").read_state()
    out = pruned(arrays, 0.3, 3)
    assert len(out["keyframe_id"]) == 3
    assert out["keyframe_id"].tolist()[0] == arrays["keyframe_id"].min()
    assert out["store_params"].shape[1] < arrays["store_params"].shape[1]
    assert psnr(out, 2) > psnr(arrays, 2) - 3.0
    store = GaussianStore()
    store.restore({k.removeprefix("store_"): v for k, v in out.items() if k.startswith("store_")})
    assert store.versions()
    shutil.copytree(drives / "a", tmp_path / "a")
    assert "5 -> 3 keyframes" in run("prune", tmp_path / "a", "--opacity", "0.3", "--keyframes", "3")
    assert json.loads(run("info", tmp_path / "a", "--json"))["edge"]["keyframes_on_disk"] == 3
    node = make_node(tmp_path / "a")
    assert len(node._mapper.keyframes) == 3
    node.close()


# --- the robot half ---


@pytest.fixture(scope="module")
def lidar_maps():
    """Two drives through the same flat, the second starting elsewhere: (SLAM, true pose_world_map) of each."""
    drive, out = SimulatedDrive(), []
    for start_s, end_s, seed in ((0.0, 36.0, 1), (14.0, 40.0, 2)):
        lidar = RayCastLidar(seed=seed)
        slam = LidarSlam(LidarSlamSettings(), np.eye(4))
        for number in range(int((end_s - start_s) * 10)):
            t = start_s + number * 0.1
            angle_min, increment, dt, least, most = lidar.arguments()
            stamp_ns = r.T0 + int(seed * 3600 * SECOND) + int(t * 1e9)
            result = slam.add_scan(stamp_ns, lidar.scan(drive, t), angle_min, increment, dt, least, most)
            if result.job is not None:
                slam.apply(result.job.run())
        slam.finish()
        times_s = start_s + np.arange(len(slam.trajectory()[0])) * 0.1
        half = len(times_s) // 2
        pose_world_map = se2.compose(drive(times_s)[half], se2.inverse(slam.trajectory()[1][half]))
        out.append((slam, pose_world_map))
    return out


def copies(lidar_maps, tmp_path):
    for name, (slam, _) in zip("ab", lidar_maps):
        slam.save(tmp_path / name)
    return [LidarSlam.load(tmp_path / name, LidarSlamSettings(), np.eye(4)) for name in "ab"]


@pytest.mark.slow
def test_a_second_drive_is_aligned_to_the_first_and_closes_loops_with_it(lidar_maps, tmp_path):
    a, b = copies(lidar_maps, tmp_path)
    true = se2.between(lidar_maps[0][1], lidar_maps[1][1])
    found = find_alignment(a, b)
    off = se2.between(true, found.pose_a_b)
    assert np.hypot(*off[:2]) < 0.1
    assert abs(off[2]) < np.radians(1.0)
    stamps = len(a.record.stamps_ns) + len(b.record.stamps_ns)
    loops = merge_into(a, b, found.pose_a_b, offset=100)
    assert loops >= 3
    grid = a.grid()
    rows, cols = np.nonzero(grid.values >= 65)
    xy = np.column_stack([cols + 0.5, rows + 0.5]) * grid.resolution_m + [grid.origin_x_m, grid.origin_y_m]
    world = se2.transform(lidar_maps[0][1], xy)
    p, q = WALLS[:, :2], WALLS[:, 2:] - WALLS[:, :2]
    along = np.clip(((world[:, None] - p) * q).sum(2) / (q**2).sum(1), 0.0, 1.0)
    distance = np.linalg.norm(world[:, None] - (p + along[..., None] * q), axis=2).min(axis=1)
    assert np.percentile(distance, 95) < 0.1  # one grid, walls not doubled
    all_stamps, poses, _ = a.trajectory()
    assert len(all_stamps) == stamps
    assert np.all(np.diff(all_stamps) > 0)
    assert np.isfinite(poses).all()


@pytest.mark.slow
def test_a_map_of_another_place_is_not_aligned(lidar_maps, tmp_path):
    a, _ = copies(lidar_maps, tmp_path)
    lidar, slam = RayCastLidar(seed=9), LidarSlam(LidarSlamSettings(), np.eye(4))
    walls = np.array([[0, 0, 14, 0], [14, 0, 14, 1.7], [14, 1.7, 0, 1.7], [0, 1.7, 0, 0]], float)
    angle_min, increment, dt, least, most = lidar.arguments()
    for number in range(80):
        at = lambda t: np.tile([2.0 + 0.04 * number, 0.8, 0.0], (len(t), 1))  # noqa: B023, E731
        slam.add_scan(number * 10**8, lidar.scan(at, 0.0, walls), angle_min, increment, dt, least, most)
    slam.finish()
    slam.save(tmp_path / "hall")
    assert find_alignment(a, LidarSlam.load(tmp_path / "hall", LidarSlamSettings(), np.eye(4))) is None


@pytest.mark.slow
def test_halves_join_at_the_robots_anchors_and_merge_by_their_scans(lidar_maps, tmp_path):
    """Keyframes of the room are anchored to submaps of the flat; the test checks their final poses."""
    for seed, (name, (slam, _)) in enumerate(zip("ab", lidar_maps), start=1):
        slam.save(tmp_path / f"robot_{name}")
        node = make_node(tmp_path / name)
        anchor, place = next(iter(slam.anchors().items()))
        bent = se2_to_se3(place) @ se2_to_se3(
            np.array([0.5, 0.0, 0.1])
        )  # as known before the last optimisation
        for number in range(3):
            stamp_ns = r.T0 + seed * 3600 * SECOND + (20 + number) * SECOND
            frame = message(number, stamp_ns, anchor_id=anchor, T_map_anchor=bent)
            assert dict(node.handle("keyframes/frame", frame))["keyframes/ack"].status == "ok"
        list(node.drain())
        node.close()
        assert "submaps joined" in run("join", tmp_path / name, tmp_path / f"robot_{name}")
        arrays = SessionFolder(tmp_path / name).read_state()
        np.testing.assert_allclose(arrays["anchor_T_map"][0], se2_to_se3(place), atol=1e-9)
        assert json.loads(run("info", tmp_path / name, "--json"))["robot"]["submaps"] == len(slam.anchors())
    with pytest.raises(UserError, match="half of another drive"):
        run("join", tmp_path / "a", tmp_path / "robot_b")
    with pytest.raises(UserError, match="no saved map here"):
        run("join", tmp_path / "a", tmp_path / "nowhere")
    before = [SessionFolder(tmp_path / name).read_state() for name in "ab"]
    assert "6 keyframes" in run("merge", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "c")
    after = SessionFolder(tmp_path / "c").read_state()
    true = se2_to_se3(se2.between(lidar_maps[0][1], lidar_maps[1][1]))
    np.testing.assert_allclose(after["anchor_T_map"][0], before[0]["anchor_T_map"][0], atol=0.05)
    np.testing.assert_allclose(after["anchor_T_map"][1], true @ before[1]["anchor_T_map"][0], atol=0.1)
    whole = LidarSlam.load(tmp_path / "c" / "robot", LidarSlamSettings(), np.eye(4))
    assert set(after["anchor_id"].tolist()) <= set(whole.anchors())
