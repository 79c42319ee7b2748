"""Plane sweeps beside the other images: no image is overtaken by one, and the order is that of the images."""

import hashlib

import numpy as np
import pytest

from beamsplat.common.messages.codec import encode
from beamsplat.common.runtime.lockstep import Lockstep
from beamsplat.services.depth.node import DepthConfig, DepthNode
from beamsplat.services.fusion.fuse import Fusion
from beamsplat.services.fusion.image_work import CandidateImage, ImageWork
from beamsplat.services.fusion.node import FusionConfig, FusionNode
from beamsplat.services.keyframes.node import KeyframesConfig, KeyframesNode
from beamsplat.services.localization.external.node import ExternalLocalization
from tests.services.fusion.room import CAMERA, T_BODY_CAMERA
from tests.services.fusion.room_nodes import RoomSource, RoomSourceConfig, shot
from tests.services.fusion.test_fuse import _frame

IMAGES = 18


def run(**options):
    """Return the fusion node, its depth messages, the stamps of candidates and of keyframes, and a digest."""
    fusion = FusionNode(FusionConfig(check_pairs=0, **options))
    depths, candidates, keyframes, digest = [], [], [], hashlib.sha256()

    def on_message(envelope):
        digest.update(envelope.topic.encode() + encode(envelope.message))
        if envelope.topic == "fusion/depth":
            depths.append(envelope.message)
        elif envelope.topic == "keyframes/candidate":
            candidates.append(envelope.message.stamp_ns)
        elif envelope.topic == "keyframes/frame":
            keyframes.append(envelope.message.stamp_ns)

    Lockstep(
        [RoomSource(RoomSourceConfig(images=IMAGES)), ExternalLocalization(ExternalLocalization.Config()),
         DepthNode(DepthConfig(source="none")), fusion, KeyframesNode(KeyframesConfig())],
        on_message,
    ).run()  # fmt: skip
    return fusion, depths, candidates, keyframes, digest.hexdigest()


@pytest.fixture(scope="module")
def quick():
    """A machine that needs no time."""
    return run()


@pytest.fixture(scope="module")
def slow():
    """A plane sweep of 0.35 s, longer than the time between most keyframes, and 5 ms for other work."""
    return run(job_cost_s=0.35, step_cost_s=0.005)


def test_a_slow_sweep_overtakes_no_image_and_results_stay_in_order(quick, slow):
    for fusion, depths, candidates, keyframes, _ in (quick, slow):
        stamps = [m.stamp_ns for m in depths]
        assert len(stamps) == IMAGES
        assert stamps == sorted(stamps) == candidates
        assert fusion.overtaken == 0
        assert [m.status for m in depths] == ["ok"] * IMAGES
        assert keyframes == [m.stamp_ns for m in depths if m.keyframe]
        assert 4 <= len(keyframes) < IMAGES // 2


def test_depth_is_right_although_keyframes_are_finished_late(slow):
    _, depths, _, _, _ = slow
    for message in depths[8:]:
        truth = shot(message.stamp_ns)[1]
        known = np.isfinite(message.depth_m)
        assert known.mean() > 0.9
        assert np.median(np.abs(message.depth_m - truth)[known] / truth[known]) < 0.03


def test_the_same_drive_gives_the_same_bytes(slow):
    assert run(job_cost_s=0.35, step_cost_s=0.005)[4] == slow[4]


def test_without_a_place_a_keyframe_becomes_an_image_between_keyframes():
    """Seven images whose sweeps do not end: one runs, one waits, the others are not lost, and not late."""
    work, sweeps, finished = ImageWork(Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True)), [], []
    for k in range(7):
        finished += work.take(CandidateImage(_frame(k)[0], 0), keyframe=k != 2)
        if (sweep := work.next_sweep()) is not None:
            sweeps.append(sweep)
    assert finished == []  # the first is not finished
    assert work.postponed == 4
    while sweeps:
        finished += work.finish_sweep(sweeps.pop()())
        if (sweep := work.next_sweep()) is not None:
            sweeps.append(sweep)
    assert [f.stamp_ns for f in finished] == list(range(7))
    assert [f.keyframe for f in finished] == [True, True, False, False, False, False, False]
    assert all(f.result.ok for f in finished)
