"""Alerts: which conditions the health of a robot contains, and when an alert begins and ends."""

import pytest

from beamsplat.common.config.alerts import AlertConfig
from beamsplat.common.config.base import parse
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health, NodeFigure
from beamsplat.common.messages.instances import process_of
from beamsplat.common.runtime.alerts import AlertBook, AlertKey, conditions
from beamsplat.common.runtime.health import STALE_S, HealthRecords

HERE, THERE = 7, 2**63 + 5  # clocks of this host and of another one
RULES = AlertConfig(hold_s=10.0, clear_s=5.0, disk_free_mb=1000.0)


def report(node, *, state="active", status="", clock_id=HERE, detail="", **figures):
    return Health(
        stamp_ns=1, node=node, instance=f"{hash(node) % 2**64:016x}", epoch=1, state=state, status=status,
        clock_id=clock_id, detail=detail,
        figures=tuple(NodeFigure(name=name, value=value) for name, value in figures.items()),
    )  # fmt: skip


def found(*reports, now=0.0, rules=RULES, own_clock_id=HERE):
    """Conditions of reports that all arrived at 0 s, as {(kind, node): text}."""
    book = HealthRecords()
    for health in reports:
        book.add(health, 0.0)
    seen = conditions("r1", book.records, own_clock_id, rules, now)
    assert all(key.robot == "r1" for key in seen)
    return {(key.kind, key.node): text for key, text in seen.items()}


@pytest.mark.parametrize("status", ["lost: 12 of 90 beams match", "relocalizing", "rejected: no beams"])
def test_a_pose_that_is_not_ok_is_lost(status):
    assert found(report("localization", status=status)) == {
        ("lost", "localization"): f"localization: {status}"
    }
    assert found(report("localization", status="ok")) == {}
    assert found(report("localization", status="")) == {}, "no pose yet"
    assert found(report("localization", status=status, state="drained")) == {}, "the drive has ended"


def test_a_node_that_crashed_or_cannot_run_has_failed_and_a_stopped_one_has_not():
    later = STALE_S + 0.1
    assert found(report("depth"), now=STALE_S - 0.1) == {}
    assert ("node_failed", "depth") in found(report("depth"), now=later)
    assert found(report("depth", state="drained"), now=later) == {}
    failed = found(report("depth", state="failed", detail="no such model"))
    assert failed == {("node_failed", "depth"): "depth cannot run: no such model"}


def test_a_node_that_crashes_again_and_again_has_failed_although_it_reports_between():
    book = HealthRecords()
    for second in range(100):
        process = process_of(b"seed", "depth", min(second // 5, 4) + 1)  # restarted at 5, 10, 15 and 20 s
        health = report("depth").model_copy(update={"instance": process.instance, "epoch": process.epoch})
        book.add(health, float(second))
        seen = conditions("r1", book.records, HERE, RULES, float(second))
        # Three of the restarts are within the last minute until 70 s.
        expected = [("node_failed", "depth")] if 15 <= second < 70 else []
        assert [key[1:] for key in seen] == expected, second
    assert book.records["depth"].starts == 5


def test_the_uplink_says_that_its_link_is_down():
    down = report("uplink", link_up=0.0, detail="no link for 12 s (tls/edge:7448)")
    assert found(down) == {("link_down", ""): "uplink: no link for 12 s (tls/edge:7448)"}
    assert found(report("uplink", link_up=1.0)) == {}


def test_a_silent_host_is_a_link_that_is_down_and_not_many_failed_nodes():
    there = [report(name, clock_id=THERE) for name in ("fusion", "localization")]
    stopped = [report(name, clock_id=THERE, state="drained") for name in ("fusion", "localization")]
    book = HealthRecords()
    for health in there:
        book.add(health, 0.0)
    book.add(report("mapping"), 10.0)
    seen = conditions("r1", book.records, HERE, RULES, 10.0)
    assert [key[1:] for key in seen] == [("link_down", "")]
    assert "fusion, localization" in next(iter(seen.values()))
    assert found(*stopped, now=10.0) == {}, "the robot was switched off in order"
    # One node of the host is heard: the link is up, and the other node has failed.
    book.add(there[0], 10.0)
    seen = conditions("r1", book.records, HERE, RULES, 10.0)
    assert [key[1:] for key in seen] == [("node_failed", "localization")]


def test_the_disk_is_nearly_full_below_the_limit():
    reports = [report(n, disk_free_bytes=mb * 1e6) for n, mb in (("keyframes", 999.0), ("depth", 1001.0))]
    assert found(*reports) == {
        ("disk_nearly_full", ""): "999 MB are free on the disk of keyframes, less than 1000 MB"
    }
    assert found(reports[1]) == {}
    assert found(reports[0], rules=AlertConfig(off=("disk_nearly_full",))) == {}


def test_a_doubt_about_the_calibration_names_the_node():
    doubt = report("fusion", calibration_doubts=1.0, detail="calibration: the camera's clock is wrong")
    assert found(doubt) == {
        ("calibration_doubt", "fusion"): "fusion: calibration: the camera's clock is wrong"
    }
    assert found(report("fusion", calibration_doubts=0.0)) == {}


KEY = AlertKey("r1", "lost", "localization")


class Timeline:
    """An alert book that is evaluated once a second."""

    def __init__(self, rules=RULES):
        self.book = AlertBook(rules)

    def run(self, start, end, present):
        """Evaluate from `start` to `end` (s); return [(time, state)] of the events."""
        events = []
        for now in range(start, end):
            found = {KEY: f"lost at {now}"} if present(now) else {}
            events += [(now, e.state) for e in self.book.update(found, {"r1"}, float(now), 1e9 + now)]
        return events


def test_an_alert_begins_once_after_the_hold_time_and_ends_once_after_the_clear_time():
    assert Timeline().run(0, 60, lambda now: 5 <= now < 30) == [(15, "begin"), (35, "end")]


def test_a_condition_that_comes_and_goes_begins_nothing_and_ends_nothing():
    line = Timeline()
    assert line.run(0, 40, lambda now: now % 9 < 8) == [], "never for ten seconds"
    assert line.book.alerts() == []
    assert [a.as_json()["state"] for a in line.book.alerts(pending=True)] == ["pending"]
    line = Timeline()
    # Active from 10 s on; absent for 4 s at a time, less than the clear time.
    assert line.run(0, 60, lambda now: now < 20 or now % 8 < 4) == [(10, "begin")]


def test_begin_and_end_have_one_id_and_the_times_of_day():
    book = AlertBook(AlertConfig(hold_s=0.0, clear_s=0.0))
    (begin,) = book.update({KEY: "no match"}, {"r1"}, 5.0, 1_700_000_000.0)
    (end,) = book.update({}, {"r1"}, 65.0, 1_700_000_060.0)
    assert begin.as_json() | {"id": ""} == {
        "robot": "r1", "alert": "lost", "node": "localization", "text": "no match", "state": "begin",
        "since": "2023-11-14T22:13:20+00:00", "at": "2023-11-14T22:13:20+00:00", "id": "",
    }  # fmt: skip
    assert end.as_json()["id"] == begin.as_json()["id"]
    assert (end.state, end.as_json()["at"]) == ("end", "2023-11-14T22:14:20+00:00")


def test_after_a_restart_an_active_alert_is_not_sent_again_and_ends_once_the_robot_is_heard():
    before = Timeline()
    before.run(0, 20, lambda now: True)
    after = AlertBook(RULES)
    after.restore(before.book.state(), 100.0, 1e9 + 20)
    assert after.alerts()[0].since_s == pytest.approx(80.0)
    assert after.update({}, set(), 101.0, 1e9 + 21) == [], "nothing is known of the robot yet"
    assert after.update({KEY: "still lost"}, {"r1"}, 200.0, 1e9 + 120) == []
    assert after.update({}, {"r1"}, 300.0, 1e9 + 220) == []
    assert [e.state for e in after.update({}, {"r1"}, 306.0, 1e9 + 226)] == ["end"]


def test_an_alert_about_a_robot_that_is_never_heard_again_ends_after_a_day():
    before = Timeline()
    before.run(0, 20, lambda now: True)
    after = AlertBook(RULES)
    after.restore(before.book.state(), 0.0, 1e9)
    day_s = 86400.0
    assert after.update({}, set(), 1.0, 1e9) == []
    assert after.update({}, {"r2"}, day_s, 1e9 + day_s) == []
    assert [e.state for e in after.update({}, {"r2"}, day_s + 1.0, 1e9 + day_s)] == ["end"]
    assert after.state() == []


@pytest.mark.parametrize(
    "address",
    ["hooks.example/x", "ftp://hooks.example/SECRET", "https://", "http://a:b/SECRET", "http://a b"],
)
def test_an_address_that_is_none_is_refused_without_showing_it(address):
    with pytest.raises(UserError, match=r"webhook = REMOVED: .*https://HOST/PATH") as error:
        parse(AlertConfig, {"webhook": address}, "robot.toml", "page.alerts.")
    assert not {"SECRET", "hooks.example"} & set(str(error.value).replace("/", " ").split())


def test_unknown_kinds_and_negative_times_are_refused():
    with pytest.raises(UserError, match="off"):
        parse(AlertConfig, {"off": ["fire"]}, "robot.toml")
    with pytest.raises(UserError, match=r"hold_s = -1"):
        parse(AlertConfig, {"hold_s": -1}, "robot.toml")
