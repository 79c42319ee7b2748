"""`bench paper`: figures of synthetic runs with known results, deployments, report."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.camera import Pinhole
from beamsplat.common.geometry.frames import camera_mount
from beamsplat.common.geometry.trajectory import Trajectory
from beamsplat.common.geometry.transforms import make_transform, so3_exp
from beamsplat.common.messages import MapAnchors, MapChunk, MapPoses
from beamsplat.tools.bench import paper
from beamsplat.tools.evaluation.drive import RecordedDrive
from beamsplat.tools.report.drive_report import write_drive_report
from beamsplat.tools.report.html import write_report
from beamsplat.tools.report.observer import RunCosts, RunRecord
from beamsplat.tools.report.run_report import compare_pairs, single_run_report
from beamsplat.tools.report.scores import (
    GroundTruth,
    aligned_poses,
    aligned_rmse,
    depth_errors,
    pose_errors,
    rigid_offset,
    speed_and_load,
)
from beamsplat.tools.report.svg import Curve, chart
from beamsplat.tools.system.assembly import faults

S = 10**9


def pose(x, y=0.0, yaw=0.0):
    return make_transform(so3_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))


def truth(tmp_path, stamps):
    T = np.array([pose(1.0 + i, 2.0, 0.5) for i in range(len(stamps))])
    drive = RecordedDrive(
        tmp_path, Pinhole(100.0, 100.0, 31.5, 23.5, 64, 48), camera_mount(0.0, 0.0, 0.4), np.eye(4), [], [],
        Trajectory(np.array(stamps), T), "made up",
    )  # fmt: skip
    return GroundTruth(tmp_path, drive, {})


def test_errors_are_per_axis_after_aligning_the_first_pose_only(tmp_path):
    stamps = [S, 2 * S, 3 * S]
    known = truth(tmp_path, stamps)
    # A map frame of its own, the truth moved into it; the second pose is 0.3 m ahead and turned by 0.1 rad.
    T_map_world = pose(5.0, -1.0, 1.2)
    poses = [T_map_world @ T for T in known.drive.poses.T_a_b]
    poses[1] = poses[1] @ pose(0.3, 0.0, 0.1)
    record = RunRecord(
        poses=[(s, T, "ok", True) for s, T in zip(stamps, poses)] + [(4 * S, np.eye(4), "lost", True)]
    )
    _, found, true = aligned_poses(record, known)
    figures = pose_errors(found, true)
    xyz = 0.3 * np.array([np.cos(0.5), np.sin(0.5), 0.0]) / np.sqrt(3)
    np.testing.assert_allclose(figures["position_rmse_xyz_m"], xyz, atol=1e-9)
    assert figures["position_rmse_m"] == pytest.approx(np.sqrt(np.mean(xyz**2)))
    assert figures["ate_first_pose_rmse_m"] == pytest.approx(0.3 / np.sqrt(3))
    assert figures["orientation_rmse_rpy_rad"] == pytest.approx([0.0, 0.0, 0.1 / np.sqrt(3)], abs=1e-9)
    assert figures["poses"] == 3
    assert pose_errors(found[:1], true[:1]) == {"poses": 1}  # its error is zero by alignment


def test_a_map_is_aligned_by_all_poses():
    random = np.random.default_rng(1)
    true = np.array([pose(*random.normal(size=2), random.normal()) for _ in range(40)])
    T = pose(0.03, -0.02, 0.004)
    noise = [pose(*random.normal(0, 0.002, 2), random.normal(0, 0.001)) for _ in true]
    found = np.linalg.inv(T) @ true @ np.array(noise)
    np.testing.assert_allclose(rigid_offset(found, true), T, atol=0.002)


def test_a_similarity_hides_the_scale_and_a_rigid_alignment_does_not():
    random = np.random.default_rng(0)
    true = random.normal(size=(50, 3))
    R = so3_exp(np.array([0.3, -0.2, 0.9]))
    found = 0.25 * true @ R.T + [1.0, 2.0, 3.0]
    rmse, scale = aligned_rmse(found, true, scaled=True)
    assert rmse < 1e-9
    assert scale == pytest.approx(4.0)
    assert aligned_rmse(found, true, scaled=False)[0] > 0.5


def test_an_image_counts_with_pose_depth_and_decision():
    images = {i * S: i * S for i in range(1, 11)}
    fused = {
        1 * S: (1 * S, "ok", True), 2 * S: (2 * S, "ok", False), 3 * S: (3 * S, "bad beams", False),
        4 * S: (4 * S, "ok", True), 9 * S: (9 * S, "ok", True), 20 * S: (20 * S, "ok", False),
    }  # fmt: skip
    record = RunRecord(
        images=images, fused=fused, acks={S: (S + S // 2, "ok"), 6 * S: (7 * S, "refused")},
        pose_at_ns={i * S: i * S for i in range(1, 11)}, keyframes={S: S}, poses=[(S, np.eye(4), "ok", True)],
    )  # fmt: skip
    costs = RunCosts(wall_s=10.0, cpu_s={"mapping": 4.0, "keyframes": 1.0}, drained=True)
    figures = speed_and_load(record, costs, 2)
    # 1 s is used, 2 s is no keyframe, 3 s is bad, 4 s precedes a decided one, 9 s is undecided, 20 s has no pose.
    assert figures["images_through"] == 3
    assert figures["fps"] == pytest.approx(3 / 9)
    assert figures["cpu_load_percent"] == pytest.approx(50.0)
    assert figures["cpu_s_per_image"] == pytest.approx(5 / 3)
    assert figures["keyframes_refused"] == 1
    assert figures["keyframe_latency_p50_ms"] == pytest.approx(750.0)
    assert speed_and_load(record, RunCosts(wall_s=10.0, cpu_s={"localization": 1.0}), 2)["fps"] is None


def test_depth_is_compared_scaled_and_unscaled_and_disparity_has_no_error_in_metres(tmp_path):
    import cv2

    true = np.full((48, 64), 2.0, np.float32)
    cv2.imwrite(str(tmp_path / f"{S}.png"), (true * 1e3).astype(np.uint16))
    known = GroundTruth(tmp_path, truth(tmp_path, [S]).drive, {S: tmp_path / f"{S}.png"})
    record = RunRecord(kinds={"metric"})
    record.kept_fused[S], record.kept_estimates[S] = true[::2, ::2] + 0.1, true[::2, ::2] * 1.5
    figures = depth_errors(record, known)
    assert figures["depth_dense_rmse_scaled_m"] == pytest.approx(0.1, abs=1e-3)
    assert figures["depth_dense_rmse_unscaled_m"] == pytest.approx(1.0, abs=1e-3)
    assert figures["depth_rmse_scaled_m"] is None  # no beams in this drive
    record.kinds = {"disparity"}
    assert depth_errors(record, known)["depth_dense_rmse_unscaled_m"] is None


@pytest.mark.parametrize("configuration", paper.CONFIGURATIONS, ids=lambda c: c.name)
def test_every_configuration_fits_together(configuration, tmp_path, monkeypatch):
    monkeypatch.setattr(paper, "_installed", lambda model: True)
    deployment, _, advice = paper.prepare_deployment(configuration, tmp_path / "bag", tmp_path, None, 3)
    assert advice == ""
    assert [f.text for f in faults(deployment) if f.fatal] == []
    assert "recorder" not in deployment.nodes
    if "mapping" in deployment.nodes:
        assert deployment.nodes["mapping"]["seed"] == 3
    kind = deployment.nodes["localization"]["kind"]
    assert kind == ("lidar" if configuration.lidar else "camera")
    if configuration.name != "default" and not configuration.lidar:
        assert "scan" in deployment.nodes["replay"]["without"]


def test_missing_weights_are_replaced_under_another_name_or_not_run(tmp_path, monkeypatch):
    unidepth = paper.CONFIGURATIONS[0]
    monkeypatch.setattr(paper, "_installed", lambda model: model == paper.SUBSTITUTE_MODEL)
    deployment, depth, advice = paper.prepare_deployment(unidepth, tmp_path, tmp_path, None, 0)
    assert deployment.nodes["depth"]["source"] == "fastdepth"
    assert "FastDepth" in depth
    assert "beamsplat models pull unidepth_v2_vits" in advice
    deployment, depth, _ = paper.prepare_deployment(unidepth, tmp_path, tmp_path, tmp_path / "depths", 0)
    assert deployment.nodes["depth"]["source"] == "recorded"
    assert "recorded" in depth
    monkeypatch.setattr(paper, "_installed", lambda model: False)
    deployment, _, advice = paper.prepare_deployment(unidepth, tmp_path, tmp_path, None, 0)
    assert deployment is None
    assert "models pull" in advice


def test_names_are_checked():
    with pytest.raises(UserError, match="monogs-lidar"):
        paper.select_configurations(["nope"])
    assert len(paper.select_configurations(None)) == 7


def test_pairs_have_the_papers_saving():
    rows = [{**c.paper, "name": c.name, "partner": c.partner} for c in paper.CONFIGURATIONS]
    found = {p["lidar"]: p for p in compare_pairs(rows)}
    assert set(found) == {"unidepth-lidar", "depth_anything-lidar", "monogs-lidar"}
    assert found["unidepth-lidar"]["cpu_load_ratio"] == pytest.approx(1024 / 1243)
    assert found["unidepth-lidar"]["fps_ratio"] == pytest.approx(2.176 / 1.201)


def test_charts_are_well_formed_and_interrupt_lines_at_gaps():
    line = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, np.nan], [3.0, 1.0], [4.0, 2.0]])
    svg = ET.fromstring(chart("a < b & c", "s", "m", [Curve("x<y", line, "#123456")], equal=True))
    assert len(svg.findall("polyline")) == 2
    assert "no data" in chart("t", "s", "m", [])


def test_the_report_is_one_file_and_names_what_did_not_run(tmp_path):
    known = truth(tmp_path, [S, 2 * S])
    ran = {
        "name": "default", "title": "default <1>", "seed": 0, "paper": {"fps": 2.0}, "advice": "", "status": "ok",
        "depth_source": "x", "fps": 3.25, "position_rmse_xyz_m": [0.1, 0.2, 0.3], "metric": True,
        "depth_series": {"stamps_ns": [S], "scaled_m": [0.1], "unscaled_m": [None]},
        "plots": {
            "stamps_ns": np.array([S, 2 * S]), "found": known.drive.poses.T_a_b, "true": known.drive.poses.T_a_b,
            "offpath": [np.zeros((8, 8, 3), np.uint8)], "previews": [], "estimates": {}, "fused": {},
            "above": np.zeros((8, 8, 3), np.uint8),
        },
    }  # fmt: skip
    missing = {
        "name": "unidepth-lidar", "title": "UniDepth", "seed": 0, "paper": {}, "advice": "weights missing",
        "status": "weights missing", "depth_source": "not run",
    }  # fmt: skip
    report = {"data": "drive", "cores": 2, "configurations": [ran, missing], "pairs": []}
    write_report(tmp_path / "report.html", report, known)
    text = (tmp_path / "report.html").read_text()
    assert "default &lt;1&gt;" in text
    assert "3.25" in text
    assert "weights missing" in text
    assert "data:image/jpeg;base64," in text
    assert 'src="http' not in text
    assert "src='http" not in text


@pytest.mark.parametrize("has_truth", [True, False])
def test_the_report_on_a_drive_begins_with_its_pictures(tmp_path, has_truth):
    known = truth(tmp_path, [S, 2 * S])
    above = np.full((8, 8, 3), 90, np.uint8)
    row = {
        "position_rmse_m": 0.0123, "psnr_keyframes_db": 24.56, "fps": None, "gaussians": 1234,
        "depth_series": {"stamps_ns": [S], "scaled_m": [0.1], "unscaled_m": [None]},
        "plots": {
            "stamps_ns": np.array([S, 2 * S]), "found": known.drive.poses.T_a_b, "true": known.drive.poses.T_a_b,
            "offpath": [np.zeros((8, 8, 3), np.uint8)], "previews": [], "estimates": {},
            "fused": {S: np.full((8, 8), 2.0, np.float32)}, "above": above,
        },
    }  # fmt: skip
    if not has_truth:
        del row["position_rmse_m"]
    report = single_run_report("demo", "lidar + fused depth", tmp_path / "kitchen", known, row)
    write_drive_report(tmp_path / "report.html", report, known)
    text = (tmp_path / "report.html").read_text()
    assert ("1.2 cm" in text) == ("Errors over time" in text) == ("truth</text>" in text) == has_truth
    assert "24.6 dB" in text
    assert "kitchen, mapped" in text
    assert "#0" not in text.partition("<style>")[0] + text.partition("</style>")[2]
    order = [
        text.index(word)
        for word in ("24.6 dB", "The map from above", "Depth: 0.5 m", "All figures", "<table>")
    ]
    assert order == sorted(order)


def test_single_corrections_of_fusion_are_the_papers_ratio_or_the_guess_itself():
    from beamsplat.common.geometry.beams import NO_BEAMS
    from beamsplat.services.fusion.inputs import FusionInput
    from beamsplat.services.fusion.single_image import SingleImageFusion

    camera, mount = Pinhole(100.0, 100.0, 31.5, 23.5, 64, 48), camera_mount(0.0, 0.0, 0.4)
    rgb = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    guess = np.full((48, 64), 2.0, np.float32)
    given = SingleImageFusion(camera, mount, "given").fuse(
        FusionInput(1, rgb, np.eye(4), NO_BEAMS, guess, "metric"), keyframe=True
    )
    assert given.ok
    assert np.array_equal(given.depth_m, guess)
    refused = SingleImageFusion(camera, mount, "ratio").fuse(
        FusionInput(2, rgb, np.eye(4), NO_BEAMS, guess, "metric"), keyframe=True
    )
    assert "no beams" in refused.status


@pytest.mark.slow
def test_a_few_seconds_live(shared_dir, tmp_path):
    data = shared_dir / "data" / "house_a"
    report = paper.bench_paper(data, tmp_path, names=["monogs-lidar"], seconds=8.0, log=lambda text: None)
    row = report["configurations"][0]
    assert row["status"] == "ok"
    assert row["drained"]
    assert row["images"] > 70
    assert row["images_through"] > 0  # how many depends on what else this machine does
    assert row["position_rmse_m"] < 0.02
    assert (Path(tmp_path) / "report.json").is_file()
    assert (Path(tmp_path) / "report.html").stat().st_size > 20_000


def map_chunk(anchor, revision):
    return MapChunk(
        stamp_ns=S, anchor_id=anchor, revision=revision, T_map_anchor=np.eye(4), count=0,
        packed=np.zeros(0, np.uint8),
    )  # fmt: skip


def map_poses():
    return MapPoses(
        stamp_ns=S, keyframe_ids=np.zeros(1, np.int64), stamps_ns=np.full(1, S), T_map_body=np.eye(4)[None]
    )


def test_the_map_at_the_end_of_the_drive_is_kept_apart_from_the_refined_one():
    """Topics have no common order: a chunk published before the end of the drive may be received after it."""
    from beamsplat.common.messages.header import Header
    from beamsplat.common.runtime.mailbox import Envelope
    from beamsplat.tools.report.observer import BusObserver

    observer = BusObserver(frozenset())

    def receive(topic, message, at_ns):
        header = Header(
            stamp_ns=message.stamp_ns, publish_ns=at_ns, clock_id=1, sequence=0, producer="mapping",
            instance="ab" * 8, epoch=1,
        )  # fmt: skip
        observer._receive(Envelope(topic, header, message, 100))

    poses = map_poses()
    receive("mapping/chunk", map_chunk(0, 1), 10)
    receive("mapping/poses", poses, 30)
    receive("mapping/chunk", map_chunk(0, 2), 20)  # published before the end, received after it
    receive("mapping/chunk", map_chunk(0, 3), 40)  # refined
    receive("mapping/poses", poses, 50)
    assert observer.record.online_chunks[0].revision == 2
    assert observer.record.chunks[0].revision == 3
    T = np.eye(4)
    T[0, 3] = 2.0
    receive("mapping/anchors", MapAnchors(stamp_ns=S, pose_revision=1, anchor_ids=np.zeros(1, np.int64),
                                          T_map_anchor=T[None]), 45)  # fmt: skip
    assert observer.record.online_chunks[0].T_map_anchor[0, 3] == 0.0
    assert observer.record.chunks[0].T_map_anchor[0, 3] == 2.0
    receive("mapping/chunk", map_chunk(0, 4), 42)  # sent before the anchors have moved
    assert observer.record.chunks[0].revision == 4
    assert observer.record.chunks[0].T_map_anchor[0, 3] == 2.0


def test_the_map_of_a_restarted_mapper_is_scored_without_chunks_of_its_predecessor():
    from beamsplat.common.messages.header import Header
    from beamsplat.common.runtime.mailbox import Envelope
    from beamsplat.tools.report.observer import BusObserver

    observer = BusObserver(frozenset())

    def receive(topic, message, instance):
        header = Header(S, 10, 1, 0, 1, "mapping", instance)
        observer._receive(Envelope(topic, header, message, 100))

    poses = map_poses()
    for anchor in (0, 1):
        receive("mapping/chunk", map_chunk(anchor, 7), "ab" * 8)
    receive("mapping/poses", poses, "ab" * 8)
    receive("mapping/chunk", map_chunk(1, 2), "cd" * 8)
    assert {anchor: c.revision for anchor, c in observer.record.chunks.items()} == {1: 2}
    assert observer.record.keyframe_poses is None
    receive("mapping/poses", poses, "cd" * 8)
    assert observer.record.keyframe_poses.shape == (1, 4, 4)
