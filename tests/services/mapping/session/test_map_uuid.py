"""The robot's half and the map's half of a session know that they belong together, and those of two drives
that not.
"""

import json

import numpy as np
import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.messages import Anchors, LidarModel, Rig, Scan
from beamsplat.services.localization.lidar2d.node import LidarLocalization
from beamsplat.services.localization.lidar2d.settings import LidarSlamSettings
from beamsplat.services.localization.lidar2d.slam import LidarSlam
from beamsplat.services.localization.lidar2d.state import MANIFEST, map_uuid
from tests.services.localization.world import RayCastLidar, SimulatedDrive
from tests.services.mapping import room_drive as r
from tests.services.mapping.session.maps import SECOND, handle, make_node, message
from tests.services.mapping.session.test_session_cli import run


def localized(folder, seed, resume=None, scans=40):
    """The last anchors of a few seconds' drive, whose state is saved in `folder`."""
    node = LidarLocalization(LidarLocalization.Config(kind="lidar", save=folder, resume=resume))
    node.configure()
    lidar, path, sent = RayCastLidar(seed=seed), SimulatedDrive(), []
    angle_min, increment, dt, least, most = lidar.arguments()
    list(node.handle("rig", Rig(stamp_ns=r.T0, lidar=LidarModel(T_body_lidar=np.eye(4)))))
    for number in range(scans):
        scan = Scan(stamp_ns=r.T0 + number * SECOND // 10, angle_min_rad=angle_min, angle_increment_rad=increment,
                    time_increment_s=dt, scan_time_s=0.1, range_min_m=least, range_max_m=most,
                    ranges_m=lidar.scan(path, 0.1 * number))  # fmt: skip
        list(node.handle("lidar/scan", scan))
    for output in node.drain():
        if isinstance(output, tuple) and isinstance(output[1], Anchors):
            sent.append(output[1])
    return sent[-1]


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    """(session, its robot's state, the state of another drive at the same time)."""
    root = tmp_path_factory.mktemp("halves")
    anchors = localized(root / "robot", 1)
    localized(root / "other", 2)
    node = make_node(root / "map", half_steps=1, full_steps=0)
    place = anchors.T_map_anchor[0]
    for number in range(3):
        frame = message(
            number, r.T0 + number * SECOND, anchor_id=int(anchors.anchor_ids[0]), T_map_anchor=place
        )
        handle(node, "keyframes/frame", frame, {})
    handle(node, "localization/anchors", anchors, {})
    list(node.drain())
    node.close()
    return root / "map", root / "robot", root / "other"


def test_both_halves_have_the_uuid_of_the_same_map(halves):
    session, robot, other = halves
    uuid = json.loads((robot / MANIFEST).read_text())["uuid"]
    assert len(uuid) == 36
    assert json.loads((other / MANIFEST).read_text())["uuid"] != uuid
    assert json.loads(run("info", session, "--json"))["edge"]["map_uuid"] == uuid
    run("join", session, robot)
    assert json.loads(run("info", session, "--json"))["robot"]["uuid"] == uuid
    assert uuid in run("info", session)


def test_the_half_of_another_drive_at_the_same_time_is_refused(halves):
    session, _, other = halves
    before = SessionFolder(session).manifest()
    with pytest.raises(
        UserError, match=r"other: is the robot half of map .*belongs to map .*of another drive"
    ):
        run("join", session, other)
    assert SessionFolder(session).manifest() == before


def test_a_state_without_a_uuid_joins_by_its_stamps(halves, tmp_path):
    session, robot, _ = halves
    slam = LidarSlam.load(robot, LidarSlamSettings(), np.eye(4))
    slam.save(tmp_path / "old")
    table = json.loads((tmp_path / "old" / MANIFEST).read_text())
    del table["uuid"]
    (tmp_path / "old" / MANIFEST).write_text(json.dumps(table))
    assert "joined" in run("join", session, tmp_path / "old")


def test_a_resumed_map_keeps_its_uuid(halves, tmp_path):
    _, robot, _ = halves
    localized(tmp_path / "more", 3, resume=robot, scans=15)
    names = [json.loads((folder / MANIFEST).read_text())["uuid"] for folder in (robot, tmp_path / "more")]
    assert names[0] == names[1]


def test_a_mapper_rejects_data_of_another_robot_map(tmp_path, caplog):
    """Submaps of both maps have the same ids: anchors and keyframes of the second are rejected and reported."""
    node, sent = make_node(tmp_path / "s"), {}
    handle(node, "keyframes/frame", message(0, map_uuid="first"), sent)
    for name, x_m in (("first", 0.5), ("second", 7.0)):
        anchors = Anchors(
            stamp_ns=r.T0, anchor_ids=np.array([0]), T_map_anchor=se2_to_se3(np.array([[x_m, 0.0, 0.0]])),
            map_uuid=name,
        )  # fmt: skip
        handle(node, "localization/anchors", anchors, {})
        assert ("anchors are ignored: it belongs to the robot's map second" in caplog.text) == (
            name == "second"
        )
    assert node._mapper.T_map_anchor[0][0, 3] == 0.5
    handle(node, "keyframes/frame", message(1, map_uuid="second"), sent)
    handle(node, "keyframes/frame", message(2, map_uuid="first"), sent)
    said = [ack.status for ack in sent["keyframes/ack"]]
    assert said[0] == said[2] == "ok"
    assert "localization.resume" in said[1]
    node.close()


def test_the_same_scans_give_the_same_uuid():
    ranges = np.arange(5, dtype=np.float32)
    assert map_uuid(1, ranges) == map_uuid(1, ranges.copy())
    assert len({map_uuid(1, ranges), map_uuid(2, ranges), map_uuid(1, ranges + 1)}) == 3
