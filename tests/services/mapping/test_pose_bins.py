"""Which keyframe is dropped when there are too many: one of the fullest pose bin, never one of the newest."""

import numpy as np

from beamsplat.common.geometry.transforms import make_transform, se2_to_se3
from beamsplat.services.mapping.mapper import Mapper
from beamsplat.services.mapping.pose_bins import PoseBins, pose_bin
from beamsplat.services.mapping.settings import MapperSettings
from tests.services.mapping.session import gallery
from tests.services.mapping.session.maps import SECOND, handle, make_node

T_BODY_CAMERA = gallery.T_BODY_CAMERA


def camera_at(x_m, y_m, yaw_deg):
    return se2_to_se3(np.array([x_m, y_m, np.deg2rad(yaw_deg)])) @ T_BODY_CAMERA


def test_a_bin_is_a_cubic_metre_and_an_eighth_of_the_compass():
    here = pose_bin(camera_at(0.3, 0.3, 10.0))
    assert pose_bin(camera_at(0.6, 0.6, 40.0)) == here
    assert pose_bin(camera_at(1.3, 0.3, 10.0)) != here
    assert pose_bin(camera_at(0.3, -0.3, 10.0)) != here
    assert pose_bin(camera_at(0.3, 0.3, 50.0)) != here
    assert pose_bin(make_transform(np.eye(3), np.array([0.0, 0.0, 5.0])) @ camera_at(0.3, 0.3, 10.0)) != here


def test_the_fullest_bin_without_the_newest():
    bins = PoseBins()
    for id in range(4):
        bins.insert(id, camera_at(0.3, 0.3, 10.0))
    for id in (8, 9):
        bins.insert(id, camera_at(5.3, 0.3, 10.0))
    assert bins.fullest(set()) == [0, 1, 2, 3]
    assert bins.fullest({1, 2, 3}) == [0]
    assert bins.fullest({0, 1, 2, 3, 8}) == [9]
    bins.remove(8)
    assert bins.fullest({0, 1, 2, 3}) == [9]
    bins.insert(9, camera_at(0.3, 0.3, 10.0))
    assert bins.fullest(set()) == [0, 1, 2, 3, 9]
    assert len(bins) == 5
    assert PoseBins().fullest(set()) == []


def test_rare_poses_keep_their_keyframes_and_dropped_ones_are_counted(tmp_path):
    """Twenty keyframes before one painting, one before each of five others: those five stay, on the disk too."""
    node, sent = (
        make_node(tmp_path / "s", max_keyframes=16, half_steps=1, full_steps=0, session_every_s=1.0),
        {},
    )
    order = [0, 1, 2, 3, 4, 5, *[0] * 20]
    for number, place in enumerate(order):
        message = gallery.message(place)
        stamp_ns = gallery.T0 + number * SECOND
        handle(
            node, "keyframes/frame", message.model_copy(update={"id": stamp_ns, "stamp_ns": stamp_ns}), sent
        )
    list(node.drain())
    ids = {(id - gallery.T0) // SECOND for id in node._mapper.keyframes}
    assert {1, 2, 3, 4, 5} <= ids
    assert len(ids) == 16
    assert "10 keyframes dropped in favour of others with the same pose" in sent["mapping/status"][-1].session
    assert {(id - gallery.T0) // SECOND for id in node._session._checkpointer.folder.keyframe_ids()} == ids
    assert len(node._intake._inserted) == 16
    steps = node._mapper.steps
    gone = gallery.message(0).model_copy(update={"id": min(node._mapper._dropped)})
    handle(node, "keyframes/frame", gone, sent)  # sent again: answered, not taken
    assert sent["keyframes/ack"][-1].id == gone.id
    assert node._mapper.steps == steps
    node.close()


def test_dropped_keyframes_are_remembered_across_restarts():
    mapper = Mapper(MapperSettings())
    mapper.resume({**mapper.progress(), "forgotten": [3, 1], "given_up": 9000})
    assert mapper.was_inserted(1)
    assert mapper.progress()["given_up"] == 9000
    old = {**mapper.progress()}
    del old["given_up"]  # of a program before it was counted
    mapper.resume(old)
    assert mapper.dropped_count == 2
