"""The Gaussian map in the viewer: frames of chunks, revisions, metrics, render."""

import cv2
import numpy as np
import pytest

from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.messages import MapAnchors, MapChunk, MapPreview, MapStatus
from beamsplat.common.messages.header import Header
from beamsplat.common.messages.splat_codec import pack
from beamsplat.common.topics import TOPICS
from beamsplat.services.monitor.node import MAP, MonitorConfig, MonitorNode

S = 1_000_000_000
T0 = 1_700_000_000 * S
PLACE = se2_to_se3(np.array([2.0, -1.0, 0.5]))


def gaussians(count, x=0.0):
    params = np.zeros((14, count), np.float32)
    params[0], params[1] = x, np.arange(count)
    params[3:6] = np.log([[0.1], [0.2], [0.3]])
    params[6] = params[9] = np.sqrt(0.5)  # a quarter turn about z
    params[10] = 0.0
    params[11:] = [[1.0], [0.5], [0.0]]
    return params


def chunk(seconds, revision, count=3, anchor=7, T=PLACE, x=0.0):
    return MapChunk(stamp_ns=T0 + round(seconds * S), anchor_id=anchor, revision=revision, T_map_anchor=T,
                    count=count, packed=pack(gaussians(count, x)))  # fmt: skip


@pytest.fixture
def monitor(tmp_path):
    monitor = MonitorNode(MonitorConfig(view="none", save=tmp_path / "m.rrd"))
    monitor.configure()
    return monitor


def tell(monitor, topic, message, instance="ab" * 8):
    monitor.on_header(Header(message.stamp_ns, 0, 0, 0, 1, "mapping", instance))
    assert list(monitor.handle(topic, message)) == []


def test_gaussians_are_drawn_in_their_submap(monitor, tmp_path, read_rrd):
    tell(monitor, "mapping/chunk", chunk(0.0, 1))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    (place,) = saved.column("map/splats/7", "Transform3D:translation")
    np.testing.assert_allclose(place.ravel(), [2.0, -1.0, 0.0], atol=1e-6)
    (centers,) = saved.column("map/splats/7", "GaussianSplats3D:centers")
    np.testing.assert_allclose(centers.reshape(-1, 3), [[0, 0, 0], [0, 1, 0], [0, 2, 0]], atol=1e-3)
    (scales,) = saved.column("map/splats/7", "GaussianSplats3D:scales")
    np.testing.assert_allclose(scales.reshape(-1, 3)[0], [0.1, 0.2, 0.3], rtol=0.03)
    (quats_xyzw,) = saved.column("map/splats/7", "GaussianSplats3D:quaternions")
    np.testing.assert_allclose(quats_xyzw.reshape(-1, 4)[0], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=0.01)
    (colours,) = saved.column("map/splats/7", "GaussianSplats3D:colors")
    assert int(colours.ravel()[0]) == pytest.approx(0xFF8000_80, abs=1 << 16)
    assert int(colours.ravel()[0]) & 0xFF == pytest.approx(128, abs=1)


def test_the_rate_limit_defers_chunks_until_the_end(monitor, tmp_path, read_rrd):
    for i in range(5):
        tell(monitor, "mapping/chunk", chunk(0.5 * i, i + 1, count=i + 1))
    list(monitor.drain())
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    counts = [len(c.reshape(-1, 3)) for c in saved.column("map/splats/7", "GaussianSplats3D:centers")]
    assert counts == [1, 5]


def test_an_older_revision_does_not_replace_a_newer_one(monitor, tmp_path, read_rrd):
    tell(monitor, "mapping/chunk", chunk(0.0, 5, count=2))
    tell(monitor, "mapping/chunk", chunk(9.0, 4, count=1))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    assert len(saved.stamps("map/splats/7")) == 1


def test_the_map_of_a_restarted_mapper_replaces_that_of_its_predecessor(monitor, tmp_path, read_rrd):
    """Without a session it starts again: low revisions, and anchors that are not in its map any more."""
    tell(monitor, "mapping/chunk", chunk(0.0, 9, count=2))
    tell(monitor, "mapping/chunk", chunk(0.0, 9, count=4, anchor=8))
    tell(monitor, "mapping/chunk", chunk(0.1, 10, count=5))  # deferred by the rate limit
    tell(monitor, "mapping/chunk", chunk(0.2, 1, count=3), instance="cd" * 8)
    tell(monitor, "mapping/chunk", chunk(9.0, 2, count=6), instance="cd" * 8)
    list(monitor.drain())
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    counts = [len(c.reshape(-1, 3)) for c in saved.column("map/splats/7", "GaussianSplats3D:centers")]
    assert counts == [2, 3, 6]
    assert saved.stamps("map/splats") == [T0 + S // 5]  # all below it is cleared
    assert saved.column("map/splats", "Clear:is_recursive")[0].tolist() == [True]


def test_a_loop_closure_moves_the_chunk(monitor, tmp_path, read_rrd):
    tell(monitor, "mapping/chunk", chunk(0.0, 1))
    tell(monitor, "mapping/chunk", chunk(5.0, 2, T=se2_to_se3(np.array([3.0, -1.0, 0.5]))))
    monitor.close()
    places = read_rrd(tmp_path / "m.rrd").column("map/splats/7", "Transform3D:translation")
    np.testing.assert_allclose([p.ravel()[0] for p in places], [2.0, 3.0], atol=1e-6)


def test_chunks_move_with_their_anchors_without_being_sent_again(monitor, tmp_path, read_rrd):
    tell(monitor, "mapping/chunk", chunk(0.0, 1))
    T = np.array([PLACE, PLACE])
    T[:, 0, 3] = 4.0
    anchors = MapAnchors(stamp_ns=T0 + S, pose_revision=2, anchor_ids=np.array([7, 8]), T_map_anchor=T)
    tell(monitor, "mapping/anchors", anchors)
    tell(monitor, "mapping/chunk", chunk(5.0, 2))  # with the pose before the move
    tell(monitor, "mapping/chunk", chunk(6.0, 1, anchor=8))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    places = saved.column("map/splats/7", "Transform3D:translation")
    np.testing.assert_allclose([p.ravel()[0] for p in places], [2.0, 4.0, 4.0], atol=1e-6)
    assert len(saved.column("map/splats/7", "GaussianSplats3D:centers")) == 2
    (place,) = saved.column("map/splats/8", "Transform3D:translation")
    assert place.ravel()[0] == pytest.approx(4.0)


def test_invalid_chunks_are_logged_and_ignored(monitor, tmp_path, read_rrd):
    broken = chunk(0.0, 1).model_copy(update={"packed": np.zeros(5, np.uint8)})
    tell(monitor, "mapping/chunk", broken)
    tell(monitor, "mapping/chunk", chunk(9.0, 2))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    assert "too few for packed Gaussians" in str(saved.column("log", "TextLog:text")[0])
    assert len(saved.stamps("map/splats/7")) == 1


def test_metrics_and_render_over_time(monitor, tmp_path, read_rrd):
    jpeg = cv2.imencode(".jpg", np.full((12, 16, 3), 90, np.uint8))[1].ravel()
    tell(
        monitor,
        "mapping/preview",
        MapPreview(stamp_ns=T0, keyframe_id=1, render=jpeg, T_map_camera=np.eye(4)),
    )
    tell(monitor, "mapping/status", MapStatus(stamp_ns=T0, psnr_db=20.0, depth_error_m=0.05))
    tell(monitor, "mapping/status", MapStatus(stamp_ns=T0 + S, psnr_db=24.0, foretold_psnr_db=18.0))
    tell(monitor, "mapping/status", MapStatus(stamp_ns=T0 + 2 * S, status="no pixel has a depth"))
    monitor.close()
    saved = read_rrd(tmp_path / "m.rrd")
    assert [float(v.ravel()[0]) for v in saved.column("plots/psnr_db/after", "Scalars:scalars")] == [
        20.0,
        24.0,
    ]
    assert [float(v.ravel()[0]) for v in saved.column("plots/psnr_db/foretold", "Scalars:scalars")] == [18.0]
    assert saved.stamps("plots/depth_error_m/map")[-1] == T0
    (blob,) = saved.column("map_render", "EncodedImage:blob")
    assert blob.astype(np.uint8).tobytes() == jpeg.tobytes()
    lines = [str(v.ravel()[0]) for v in saved.column("log", "TextLog:text")]
    assert lines == ["mapping: ok", "mapping: refused (no pixel has a depth)"]


def test_every_row_is_a_topic_that_the_mapper_sends():
    for entry in MAP:
        assert TOPICS[entry.topic].producers == ("mapping",)
