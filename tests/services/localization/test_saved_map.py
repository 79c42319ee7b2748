"""Saved maps: what is stored of a scan, the cost of saving while the map grows, compaction, old formats."""

import json
from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.messages.robot import MAX_BEAMS
from beamsplat.services.localization.lidar2d import se2
from beamsplat.services.localization.lidar2d.frozen_map import FrozenMap
from beamsplat.services.localization.lidar2d.map_records import SavedMap
from beamsplat.services.localization.lidar2d.map_saver import MapSaver
from beamsplat.services.localization.lidar2d.node_scan import NodeScan
from beamsplat.services.localization.lidar2d.pose_graph import PoseGraph
from beamsplat.services.localization.lidar2d.pose_graph_data import TableCache
from beamsplat.services.localization.lidar2d.scan import prepare_scan
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.state import load_state, read_manifest
from beamsplat.services.localization.lidar2d.trajectory_record import TrajectoryRecord
from tests.services.localization.graphs import SUBMAP_NODES, finish_submap, grow, room_scan

SETTINGS = LidarSlamSettings()
GOLDEN = Path(__file__).parent / "golden"


def prepared_scan(rng, beams=720):
    angles = -np.pi + np.arange(beams) * 2.0 * np.pi / beams
    ranges = np.minimum(28.0, 4.0 / np.maximum(np.abs(np.cos(angles)), 0.1)) + rng.normal(0.0, 0.01, beams)
    ranges[rng.random(beams) < 0.1] = np.inf
    pose, velocity = np.array([0.2, -0.1, 0.4]), np.zeros(3)
    return prepare_scan(
        ranges.astype(np.float32), angles[0], angles[1] - angles[0], 0.0, 0.1, 30.0, pose, velocity, 0.03, 360
    )


def test_a_stored_scan_is_the_scan_within_a_millimetre_in_8_bytes_per_return(rng):
    scan = prepared_scan(rng)
    dynamic = rng.random(len(scan)) < 0.2
    stored = NodeScan.of(scan, dynamic)
    stored.check()
    assert len(stored) == len(scan)
    assert np.abs(stored.points - scan.points_body).max() < 0.0005
    np.testing.assert_array_equal(stored.dynamic, dynamic)
    np.testing.assert_array_equal(stored.origin, scan.origin_body)
    np.testing.assert_allclose(stored.spacing_m, scan.spacing_m, rtol=1e-3)
    known = np.abs(scan.tangents).max(axis=1) > 0
    assert 0 < known.sum() < len(known)
    assert (stored.tangents[~known] == 0.0).all()
    assert np.abs(np.cross(stored.tangents[known], scan.tangents[known])).max() < 1e-4  # rad, both ways
    static = ~dynamic[scan.match_index]
    features = scan.features()[static]
    assert stored.features.shape == features.shape
    assert np.abs(stored.features[:, :2] - features[:, :2]).max() < 0.0005
    np.testing.assert_allclose(stored.features[:, 4], features[:, 4], rtol=1e-3)
    assert len(stored.data) <= 8.2 * len(scan) + 2 * len(features) + 32


def test_scans_of_any_kind_are_stored_and_damaged_ones_are_refused():
    empty = NodeScan.packed(
        np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool), np.zeros(0, int), np.ones(2)
    )
    empty.check()
    assert empty.points.shape == (0, 2)
    assert empty.features.shape == (0, 5)
    most = np.linspace(-30.0, 30.0, MAX_BEAMS)[:, None] * [1.0, 0.5]
    dense = NodeScan.packed(
        most, np.tile([0.6, 0.8], (MAX_BEAMS, 1)), np.ones(MAX_BEAMS), np.zeros(MAX_BEAMS, bool),
        np.array([0, MAX_BEAMS - 1]), np.ones(2),
    )  # fmt: skip
    dense.check()
    assert np.abs(dense.points - most).max() < 0.0005
    assert np.abs(dense.features[:, :2] - most[[0, -1]]).max() < 0.0005
    data = room_scan(1).data
    for damaged in (b"", data[:-1], data + b"x", b"\xff\xff" + data[2:], data[:2] + b"\xff\xff" + data[4:]):
        with pytest.raises(ValueError, match="a node"):
            NodeScan(damaged).check()
    with pytest.raises(ValueError, match="not finite"):
        NodeScan.packed(
            np.full((1, 2), np.nan),
            np.zeros((1, 2)),
            np.ones(1),
            np.zeros(1, bool),
            np.zeros(1, int),
            np.ones(2),
        )


class Drive:
    """A graph and a record that grow, saved to a folder."""

    def __init__(self, folder):
        self.graph, self.record, self.folder = PoseGraph(SETTINGS), TrajectoryRecord(), folder
        self.graph.uuid = "drive"
        self.saver = MapSaver(folder, SETTINGS)

    def go(self, nodes):
        for _ in range(nodes):
            grow(self.graph, 1)
            number = self.record.count
            for k in range(2):
                self.record.add(10**9 * number + k, self.graph.next_node_id - 1, np.zeros(3), np.ones(3) * k)

    def save(self):
        """Save the map; return the bytes that were written to journal and state."""
        before = self.saver.bytes_written
        self.saver.save(SavedMap.of(self.graph, self.record))
        return self.saver.bytes_written - before, read_manifest(self.folder)["bytes"]


def test_a_save_appends_what_is_new_while_the_map_grows(tmp_path):
    drive = Drive(tmp_path)
    costs = []
    for _ in range(40):
        drive.go(SUBMAP_NODES)
        costs.append(drive.save())
    journal, state = np.array(costs).T
    assert journal[-10:].max() <= 1.1 * journal[1:11].max()
    nodes = len(drive.graph.nodes)
    assert journal.sum() <= 1.1 * (nodes * 2000 + 40 * 8000)
    grown = (state[-1] - state[0]) / (nodes - SUBMAP_NODES)
    assert grown < 24 + 40 / SUBMAP_NODES  # bytes per node: its pose, and a fraction of its submap's
    size = (tmp_path / read_manifest(tmp_path)["journal"]).stat().st_size
    assert size == journal.sum()


def test_a_map_is_restored_with_its_unfinished_submap_and_its_trimmed_nodes(tmp_path):
    drive = Drive(tmp_path)
    drive.go(3 * SUBMAP_NODES + 2)
    drive.save()
    drive.graph._remove(1)  # as trimming does
    moved = {id: np.add(pose, (0.01, -0.02, 0.003)) for id, pose in drive.graph.pose_map_node.items()}
    drive.graph.pose_map_node = moved
    drive.go(1)
    drive.save()
    graph, rows = load_state(tmp_path, SETTINGS)
    assert list(graph.nodes) == list(drive.graph.nodes)
    assert graph.trimmed_nodes == drive.graph.trimmed_nodes != {}
    poses, expected = graph.all_node_poses(), drive.graph.all_node_poses()
    assert poses.keys() == expected.keys()
    assert max(np.abs(poses[id] - expected[id]).max() for id in poses) < 1e-4
    restored = TrajectoryRecord.of(rows).optimised(poses)
    assert np.abs(restored - drive.record.optimised(expected)).max() < 1e-4
    assert [(c.submap, c.node) for c in graph.constraints] == [
        (c.submap, c.node) for c in drive.graph.constraints
    ]
    finish_submap(drive.graph)
    for id, submap in drive.graph.submaps.items():
        other = graph.submaps[id]
        assert other.members == submap.members
        np.testing.assert_array_equal(other.frozen.counts(), submap.frozen.counts())
        np.testing.assert_array_equal(other.frozen.means, submap.frozen.means)
    assert graph.next_node_id == drive.graph.next_node_id


def test_a_journal_with_much_that_is_not_needed_is_written_anew(tmp_path, monkeypatch):
    monkeypatch.setattr("beamsplat.services.localization.lidar2d.map_saver._SPARE_BYTES", 20_000)
    drive, names, sizes = Drive(tmp_path), [], []
    drive.go(4 * SUBMAP_NODES)
    for _ in range(12):
        for submap in drive.graph.submaps.values():  # as after a refinement
            if submap.frozen is not None:
                submap.frozen = FrozenMap(**vars(submap.frozen))
        drive.save()
        names.append(read_manifest(tmp_path)["journal"])
        sizes.append((tmp_path / names[-1]).stat().st_size)
        assert [path.name for path in tmp_path.glob("*.journal")] == names[-1:]
    assert len(set(names)) >= 2
    assert max(sizes) < 3 * sizes[0] + 20_000
    assert list(load_state(tmp_path, SETTINGS)[0].nodes) == list(drive.graph.nodes)


def test_a_map_of_version_1_is_read_and_continued(tmp_path):
    folder = GOLDEN / "lidar_map_v1"
    truth = json.loads((folder / "truth.json").read_text())
    graph, rows = load_state(folder, SETTINGS)
    assert list(graph.nodes) == truth["nodes"]
    assert {id: s.members for id, s in graph.submaps.items()} == {
        int(id): members for id, members in truth["members"].items()
    }
    for id, points in truth["points"].items():
        assert np.abs(graph.nodes[int(id)].scan.points - points).max() < 0.0005
    for id, features in truth["features"].items():
        stored, features = graph.nodes[int(id)].scan.features, np.array(features)
        assert np.abs(stored[:, :2] - features[:, :2]).max() < 0.0005
        assert np.abs(np.cross(stored[:, 2:4], features[:, 2:4])).max() < 1e-4
    assert graph.uuid == truth["uuid"]
    assert rows["extra_stamps"].tolist() == truth["stamps"]
    MapSaver(tmp_path, SETTINGS).save(SavedMap.of(graph, TrajectoryRecord.of(rows)))
    again, _ = load_state(tmp_path, SETTINGS)
    assert all(again.nodes[id].scan == graph.nodes[id].scan for id in graph.nodes)
    assert all(again.submaps[id].frozen.packed == graph.submaps[id].frozen.packed for id in graph.submaps)
    off = [se2.between(again.pose_map_node[id], graph.pose_map_node[id]) for id in graph.nodes]
    assert np.abs(off).max() < 1e-4


def test_the_cache_of_match_tables_is_bounded_by_bytes():
    graph = PoseGraph(SETTINGS)
    grow(graph, 30 * SUBMAP_NODES + 1)
    frozen = {id: s.frozen for id, s in graph.submaps.items() if s.frozen is not None}
    cache = TableCache(SETTINGS.reach_cells, limit_bytes=1_000_000)
    for id, submap in frozen.items():
        assert cache.tables(id, submap) is cache.tables(id, submap)
        cache.pyramid(id, submap)
        assert cache.bytes <= 1_000_000
    one = TableCache(SETTINGS.reach_cells, limit_bytes=1)
    assert one.tables(0, frozen[0]) is one.tables(0, frozen[0])  # the newest is always kept
