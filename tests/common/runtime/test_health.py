"""Health records: rates between reports, silent nodes, restarts, and consumers of a topic."""

import pytest

from beamsplat.common.messages import Health, InputHealth, OutputHealth
from beamsplat.common.messages.instances import ProcessId, process_of
from beamsplat.common.runtime.health import STALE_S, HealthRecords

FIRST, SECOND = (process_of(b"seed", "localization", epoch) for epoch in (1, 2))


def report(node, process, *, received=0, sent=0, state="active"):
    inputs = (
        InputHealth(
            topic="lidar/scan",
            received=received,
            dropped=2,
            lost=3,
            undecodable=4,
            stale=5,
            age_ms=80.0,
            late=6,
            refused=7,
        ),
    )
    return Health(
        stamp_ns=1, node=node, instance=process.instance, epoch=process.epoch, state=state, inputs=inputs,
        outputs=(OutputHealth(topic="localization/odometry", sent=sent, bytes=100 * sent),),
        step_p50_ms=1.0, step_p95_ms=2.0, rss_mb=50.0, cpu_percent=10.0, detail="",
    )  # fmt: skip


def test_rates_are_changes_of_counters_over_the_last_seconds():
    records = HealthRecords()
    for second in range(10):  # 10 Hz at first, 20 Hz for the last five seconds
        received = 10 * second if second < 5 else 50 + 20 * (second - 5)
        records.add(report("localization", FIRST, received=received, sent=received // 2), float(second))
    totals = records.records["localization"].totals()
    assert totals.in_hz == pytest.approx(18.0)  # from 4 s to 9 s
    assert totals.out_hz == pytest.approx(9.0)
    assert (totals.dropped, totals.lost, totals.bad, totals.age_ms) == (2, 3, 16, 80.0)
    (traffic,) = [t for t in records.traffic() if t.topic == "localization/odometry"]
    assert traffic.producer == "localization"
    assert traffic.hz == pytest.approx(9.0)
    assert traffic.bytes_s == pytest.approx(900.0)
    assert traffic.consumers == ()


def test_a_restart_is_counted_and_starts_new_rates():
    records = HealthRecords()
    records.add(report("localization", FIRST, received=1000), 0.0)
    records.add(report("localization", SECOND, received=0), 1.0)
    records.add(report("localization", SECOND, received=10), 2.0)
    assert records.records["localization"].starts == 2
    assert records.records["localization"].totals().in_hz == pytest.approx(10.0)  # not minus 495


def test_a_node_without_reports_becomes_silent():
    records = HealthRecords()
    records.add(report("localization", FIRST, state="drained"), 10.0)
    assert records.states(10.0 + STALE_S - 0.1) == {"localization": "drained"}
    assert records.states(10.0 + STALE_S + 0.1) == {"localization": "silent"}
    assert records.records["localization"].silent_s(20.0) == pytest.approx(10.0)


def test_one_report_has_no_rate():
    records = HealthRecords()
    records.add(report("localization", FIRST, received=500), 0.0)
    assert records.records["localization"].totals().in_hz == 0.0


def test_reports_of_another_process_are_refused_and_counted_while_the_node_reports():
    records = HealthRecords()
    stranger = ProcessId("localization", 99, "ef" * 8)
    for second in range(10):
        assert records.add(report("localization", FIRST), float(second))
        assert not records.add(report("localization", stranger, state="closed"), second + 0.5)
    assert records.states(9.5) == {"localization": "active"}
    assert records.records["localization"].refused == 10
    assert records.add(report("localization", SECOND), 10.0)
    assert records.add(report("localization", stranger), 15.5)  # silent for more than 5 s


def test_reports_of_any_number_of_names_leave_room_for_a_node_that_comes_later():
    records = HealthRecords()
    for number in range(1500):
        records.add(report(f"node{number}", ProcessId("x", 1, f"{number:016x}")), 0.0)
    assert len(records.records) == 1000
    assert not records.add(report("localization", FIRST), 1.0)
    assert records.add(report("localization", FIRST), 100.0)
    assert len(records.records) <= 1000
