"""What `top` and the page show of nodes: rates between reports, silence, restarts, and who takes what."""

import pytest

from beamsplat.common.messages import Health, InputHealth, OutputHealth
from beamsplat.common.runtime.health import STALE_S, HealthRecords


def report(node, instance, *, received=0, sent=0, state="active"):
    inputs = (
        InputHealth(
            topic="lidar/scan", received=received, dropped=2, lost=3, undecodable=4, stale=5, age_ms=80.0
        ),
    )
    return Health(
        stamp_ns=1, node=node, instance=instance * 16, epoch=1, state=state, inputs=inputs,
        outputs=(OutputHealth(topic="localization/odometry", sent=sent, bytes=100 * sent),),
        step_p50_ms=1.0, step_p95_ms=2.0, rss_mb=50.0, cpu_percent=10.0, detail="",
    )  # fmt: skip


def test_rates_are_changes_of_counters_over_the_last_seconds():
    book = HealthRecords()
    for second in range(10):  # 10 Hz at first, 20 Hz for the last five seconds
        received = 10 * second if second < 5 else 50 + 20 * (second - 5)
        book.add(report("localization", "a", received=received, sent=received // 2), float(second))
    totals = book.records["localization"].totals()
    assert totals.in_hz == pytest.approx(18.0)  # from 4 s to 9 s
    assert totals.out_hz == pytest.approx(9.0)
    assert (totals.dropped, totals.lost, totals.bad, totals.age_ms) == (2, 3, 9, 80.0)
    (flow,) = [f for f in book.traffic() if f.topic == "localization/odometry"]
    assert flow.producer == "localization"
    assert flow.hz == pytest.approx(9.0)
    assert flow.bytes_s == pytest.approx(900.0)
    assert flow.consumers == ()


def test_a_restart_is_counted_and_begins_new_rates():
    book = HealthRecords()
    book.add(report("localization", "a", received=1000), 0.0)
    book.add(report("localization", "b", received=0), 1.0)
    book.add(report("localization", "b", received=10), 2.0)
    assert book.records["localization"].starts == 2
    assert book.records["localization"].totals().in_hz == pytest.approx(10.0)  # not minus 495


def test_who_says_nothing_is_silent_and_said_what_it_was_before():
    book = HealthRecords()
    book.add(report("localization", "a", state="drained"), 10.0)
    assert book.states(10.0 + STALE_S - 0.1) == {"localization": "drained"}
    assert book.states(10.0 + STALE_S + 0.1) == {"localization": "silent"}
    assert book.records["localization"].silent_s(20.0) == pytest.approx(10.0)


def test_one_report_has_no_rate():
    book = HealthRecords()
    book.add(report("localization", "a", received=500), 0.0)
    assert book.records["localization"].totals().in_hz == 0.0
