"""Health reports in few bytes: all counts exact, measurements to three digits, other versions readable."""

import math

import msgpack
import numpy as np
import pytest
import zstandard

from beamsplat.common.messages import Health, InputHealth, NodeFigure, OutputHealth, Rejected
from beamsplat.common.messages.codec import encode
from beamsplat.common.messages.health_codec import pack_reports, unpack_reports
from tests.common.samples import sample_messages

# node -> its inputs and outputs, as on a robot
ROBOT = {
    "camera": ((), ("rig", "camera/image")),
    "lidar": ((), ("lidar/scan",)),
    "localization": (("rig", "lidar/scan", "wheel/odometry"), (
        "localization/odometry", "localization/correction", "localization/anchors", "localization/movers",
        "localization/grid")),
    "depth": (("rig", "camera/image", "lidar/scan", "localization/odometry"), ("depth/estimate",)),
    "fusion": (("rig", "camera/image", "depth/estimate", "lidar/scan", "localization/odometry",
                "localization/movers", "wheel/odometry", "keyframes/decision"),
               ("keyframes/candidate", "fusion/depth", "fusion/cloud")),
    "keyframes": (("rig", "lidar/scan", "camera/image", "localization/odometry", "localization/correction",
                   "localization/anchors", "localization/movers", "keyframes/candidate", "fusion/depth",
                   "keyframes/ack"), ("keyframes/decision", "keyframes/frame")),
    "uplink": ((), ()),
}  # fmt: skip


def robot_reports(seed=0):
    rng = np.random.default_rng(seed)

    def count(most=5000):
        return int(rng.integers(most))

    return [
        Health(
            stamp_ns=1_795_916_427_590_450_846 + count(), node=node, instance=rng.bytes(8).hex(), epoch=161,
            state="active", pid=25_000 + count(), clock_id=8_911_981_134_931_944_561, status="ok",
            inputs=tuple(
                InputHealth(topic=name, received=count(), dropped=count(100), lost=0, undecodable=0, stale=0,
                            age_ms=rng.uniform(0.0, 50.0))
                for name in takes
            ),
            outputs=tuple(OutputHealth(topic=name, sent=count(), bytes=count(10**7)) for name in gives),
            step_p50_ms=rng.uniform(0.0, 1.0), step_p95_ms=rng.uniform(1.0, 70.0),
            rss_mb=rng.uniform(50.0, 400.0), cpu_percent=rng.uniform(0.0, 60.0), detail=f"{node} is at rest",
            figures=(NodeFigure(name="disk_free_bytes", value=11_958_419_456.0),
                     NodeFigure(name="disk_size_bytes", value=270_553_174_016.0)),
        )
        for node, (takes, gives) in ROBOT.items()
    ]  # fmt: skip


def _assert_same(before, after):
    for name in type(before).model_fields:
        a, b = getattr(before, name), getattr(after, name)
        if isinstance(a, tuple):
            assert len(a) == len(b)
            for x, y in zip(a, b):
                _assert_same(x, y)
        elif isinstance(a, float):
            assert math.isclose(a, b, rel_tol=1e-3)
        else:
            assert a == b, name


def test_reports_round_trip():
    (sample,) = [m for m in sample_messages() if isinstance(m, Health)]
    reports = [sample, *robot_reports()]
    back = unpack_reports(pack_reports(reports))
    assert len(back) == len(reports)
    for a, b in zip(reports, back):
        _assert_same(a, b)


def test_counters_that_are_reported_as_figures_are_exact():
    value = 123_456_789_012.0  # of bytes: rates are differences of two of them
    report = robot_reports()[0].model_copy(update={"figures": (NodeFigure(name="x", value=value),)})
    (back,) = unpack_reports(pack_reports([report]))
    assert back.figures[0].value == value


def test_the_reports_of_a_robot_take_a_fifth_of_their_messages():
    sizes = [(len(pack_reports(r)), sum(len(encode(m)) for m in r)) for r in map(robot_reports, range(5))]
    assert max(packed for packed, _ in sizes) < 1400
    assert all(5 * packed < whole for packed, whole in sizes)


def _content(rows, version=Health.version):
    content = msgpack.packb([version, *rows])
    return np.frombuffer(zstandard.ZstdCompressor().compress(content), np.uint8)


def _rows(reports):
    content = zstandard.ZstdDecompressor().decompress(pack_reports(reports).tobytes())
    return msgpack.unpackb(content)[1:]


def test_reports_of_other_minor_versions_are_read():
    reports = robot_reports()
    rows = _rows(reports)
    newer = unpack_reports(_content([[*row, "a new field"] for row in rows], "1.99"))
    assert [r.node for r in newer] == list(ROBOT)
    assert newer[4].inputs == unpack_reports(pack_reports(reports))[4].inputs
    older = unpack_reports(_content([row[:-1] for row in rows], "1.3"))  # without clock_id
    assert {r.clock_id for r in older} == {0}
    with pytest.raises(ValueError, match=r"version 2\.0"):
        unpack_reports(_content(rows, "2.0"))


@pytest.mark.parametrize("damage", [
    lambda b: b[:20], lambda b: b[:0], lambda b: b"X" + b[1:], lambda b: zstandard.compress(b"\xc1"),
    lambda b: zstandard.compress(msgpack.packb(["1.4", [1, 2]])),
    lambda b: zstandard.compress(msgpack.packb(["1.4", 7])),
    lambda b: zstandard.compress(msgpack.packb([])), lambda b: zstandard.compress(b"\0" * 10_000_000),
])  # fmt: skip
def test_damaged_bytes_are_an_error(damage):
    packed = pack_reports(robot_reports()).tobytes()
    with pytest.raises(ValueError):
        unpack_reports(np.frombuffer(damage(packed), np.uint8))


def test_the_order_of_the_fields_is_that_of_released_versions():
    """New ones follow: a bundle has no names of fields."""
    order = {
        Health: "stamp_ns node instance epoch state inputs outputs step_p50_ms step_p95_ms rss_mb cpu_percent detail "
        "pid rejected status figures clock_id",
        InputHealth: "topic received dropped lost undecodable stale age_ms late refused",
        OutputHealth: "topic sent bytes refused", Rejected: "topic reason count", NodeFigure: "name value",
    }  # fmt: skip
    for cls, names in order.items():
        assert list(cls.model_fields)[: len(names.split())] == names.split()
