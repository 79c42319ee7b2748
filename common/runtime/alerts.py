"""Alerts about robots: conditions in the health of their nodes, and hysteresis.

A condition that holds for `hold_s` begins an alert; the alert ends when the condition was absent for
`clear_s`. Everything follows from health reports, so that the page, `beamsplat top` and an edge server, which
hears several robots, come to the same result.
"""

from __future__ import annotations

import datetime
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from beamsplat.common.config.alerts import AlertConfig, AlertKind
from beamsplat.common.runtime.health import NodeRecord

_ENDED = ("drained", "closed")  # a process that was stopped in order reports one of them last
_TEXT_CHARS = 300
_CRASHES, _CRASHES_S = 3, 60.0  # restarts within this time: the process crashes again and again
_LATEST_UNIX_S = 4e9  # the year 2096
_FORGET_S = 86400.0  # an alert about a robot of which nothing is known for so long is over


class AlertKey(NamedTuple):
    """What an alert is about; `node` is "" if it is about the whole robot."""

    robot: str
    kind: AlertKind
    node: str


def conditions(
    robot: str, records: Mapping[str, NodeRecord], own_clock_id: int, rules: AlertConfig, now: float
) -> dict[AlertKey, str]:
    """Return what is wrong with a robot now, with one sentence each.

    Args:
        records: the newest health of each node of this robot by node name.
        own_clock_id: clock of this host; a robot with the same one runs on this host.
        now: reading of `time.monotonic`, s.
    """
    found: dict[AlertKey, str] = {}

    def add(kind: AlertKind, node: str, text: str) -> None:
        if kind not in rules.off:
            found[AlertKey(robot, kind, node)] = text[:_TEXT_CHARS]

    heard = {name: record for name, record in records.items() if record.silent_s(now) is None}
    for name, text in _failures(records, heard, now).items():
        if not _is_on_unreachable_host(records[name], records, heard, own_clock_id):
            add("node_failed", name, text)
    if text := _link_fault(records, heard, own_clock_id):
        add("link_down", "", text)
    pose = heard.get("localization")
    if pose is not None and pose.health.state == "active" and pose.health.status not in ("", "ok"):
        add("lost", "localization", f"localization: {pose.health.status}")
    if text := _disk_fault(heard, rules.disk_free_mb):
        add("disk_nearly_full", "", text)
    for name, record in heard.items():
        if record.figure("calibration_doubts"):
            add("calibration_doubt", name, f"{name}: {record.health.detail}")
    return found


def _failures(records: Mapping[str, NodeRecord], heard: Collection[str], now: float) -> dict[str, str]:
    """Return the nodes that cannot run, end again and again, or are silent although nobody stopped them."""
    found = {}
    for name, record in records.items():
        if record.health.state == "failed":
            found[name] = f"{name} cannot run: {record.health.detail}"
        elif name not in heard and record.health.state not in _ENDED:
            found[name] = f"{name} reports nothing; its last state was {record.health.state}"
        elif (restarts := sum(now - at < _CRASHES_S for at in record.restarts_s)) >= _CRASHES:
            found[name] = f"{name} was restarted {restarts} times in the last {_CRASHES_S:.0f} s"
    return found


def _is_elsewhere(record: NodeRecord, own_clock_id: int) -> bool:
    return record.health.clock_id not in (0, own_clock_id)


def _is_on_unreachable_host(
    record: NodeRecord, records: Mapping[str, NodeRecord], heard: Collection[str], own_clock_id: int
) -> bool:
    """Return whether a node is on another host of which nothing is heard: the node itself may well run."""
    if not _is_elsewhere(record, own_clock_id):
        return False
    return not any(_is_elsewhere(records[name], own_clock_id) for name in heard)


def _link_fault(records: Mapping[str, NodeRecord], heard: Mapping[str, NodeRecord], own_clock_id: int) -> str:
    """Return why the link between robot and edge server is down, "" if it is not, or if there is none."""
    for name, record in heard.items():
        if record.figure("link_up") == 0.0:
            return f"{name}: {record.health.detail}"
    elsewhere = [name for name, record in records.items() if _is_elsewhere(record, own_clock_id)]
    stopped = all(records[name].health.state in _ENDED for name in elsewhere)
    if not elsewhere or stopped or any(name in heard for name in elsewhere):
        return ""
    return f"no report of any node on the other host ({', '.join(sorted(elsewhere))})"


def _disk_fault(heard: Mapping[str, NodeRecord], least_mb: float) -> str:
    """Return which nodes write to a disk with less free space than `least_mb` (MB), "" if none."""
    free_mb = {n: free / 1e6 for n, r in heard.items() if (free := r.figure("disk_free_bytes")) is not None}
    short = sorted(name for name, free in free_mb.items() if free < least_mb)
    if not short:
        return ""
    least = min(free_mb[name] for name in short)
    return f"{least:.0f} MB are free on the disk of {', '.join(short)}, less than {least_mb:g} MB"


@dataclass
class Alert:
    """A condition that holds, or has held; `active` is whether it has held for long enough."""

    key: AlertKey
    text: str
    since_s: float  # when the condition began, `time.monotonic`
    since_unix_s: float
    active: bool = False
    absent_since_s: float | None = (
        None  # since then the condition is absent, or nothing is known of the robot
    )
    robot_known: bool = True  # False: after a restart, until the robot is heard

    def as_json(self) -> dict[str, Any]:
        """Return the alert as data for JSON; `since` is UTC, ISO 8601."""
        return {
            "robot": self.key.robot, "alert": self.key.kind, "node": self.key.node, "text": self.text,
            "state": "active" if self.active else "pending", "since": iso_time(self.since_unix_s),
        }  # fmt: skip


class AlertEvent(NamedTuple):
    """An alert has begun or ended."""

    alert: Alert
    state: Literal["begin", "end"]
    at_unix_s: float

    def as_json(self) -> dict[str, Any]:
        """Return the event as data for JSON; begin and end of an alert have the same `id`."""
        key = self.alert.key
        parts = [key.robot, key.kind, *filter(None, [key.node]), f"{self.alert.since_unix_s:.3f}"]
        data, at = self.alert.as_json(), iso_time(self.at_unix_s)
        return {**data, "state": self.state, "at": at, "id": "/".join(parts)}


class AlertBook:
    """The alerts of all robots. Not thread-safe: its owner must lock it."""

    def __init__(self, rules: AlertConfig) -> None:
        self._rules = rules
        self._alerts: dict[AlertKey, Alert] = {}

    def update(
        self, found: Mapping[AlertKey, str], robots: Collection[str], now: float, now_unix_s: float
    ) -> list[AlertEvent]:
        """Take in the conditions of now; return the alerts that begin and end with them.

        Args:
            found: conditions by key, with their texts (`conditions` of each robot).
            robots: robots of which health is known. A restored alert about any other one stays for a day.
            now: reading of `time.monotonic`, s.
            now_unix_s: the time of day at `now`, s since 1970.
        """
        events = []
        for key, text in found.items():
            alert = self._alerts.setdefault(key, Alert(key, text, now, now_unix_s))
            alert.text, alert.absent_since_s, alert.robot_known = text, None, True
            if not alert.active and now - alert.since_s >= self._rules.hold_s:
                alert.active = True
                events.append(AlertEvent(alert, "begin", now_unix_s))
        for key, alert in list(self._alerts.items()):
            if key in found:
                continue
            if key.robot in robots and not alert.robot_known:
                alert.robot_known, alert.absent_since_s = True, None
            if alert.absent_since_s is None:
                alert.absent_since_s = now
            wait_s = self._rules.clear_s if alert.robot_known else _FORGET_S
            if alert.active and now - alert.absent_since_s < wait_s:
                continue
            del self._alerts[key]
            if alert.active:
                events.append(AlertEvent(alert, "end", now_unix_s))
        return events

    def alerts(self, robot: str | None = None, pending: bool = False) -> list[Alert]:
        """Return the active alerts, oldest first, of one robot or of all; with `pending` also the others."""
        chosen = (a for a in self._alerts.values() if robot is None or a.key.robot == robot)
        return sorted((a for a in chosen if a.active or pending), key=lambda a: (a.since_s, a.key))

    def state(self) -> list[dict[str, Any]]:
        """Return the active alerts as data for JSON, from which `restore` continues after a restart."""
        return [{**a.key._asdict(), "text": a.text, "since_unix_s": a.since_unix_s} for a in self.alerts()]

    def restore(self, saved: list[dict[str, Any]], now: float, now_unix_s: float) -> None:
        """Continue with the alerts that were active before a restart: they are not sent again.

        Raises:
            ValueError, KeyError, TypeError: `saved` is not what `state` returned.
        """
        for entry in saved:
            key = AlertKey(str(entry["robot"]), entry["kind"], str(entry["node"]))
            since_unix_s = float(entry["since_unix_s"])
            if not 0.0 <= since_unix_s < _LATEST_UNIX_S:
                raise ValueError(f"since_unix_s = {since_unix_s} is no time of day")
            since_s = now - max(now_unix_s - since_unix_s, 0.0)
            self._alerts[key] = Alert(
                key, str(entry["text"]), since_s, since_unix_s, active=True, robot_known=False
            )


def iso_time(unix_s: float) -> str:
    """Return a time of day (s since 1970) in UTC as ISO 8601 text with seconds."""
    return datetime.datetime.fromtimestamp(unix_s, datetime.UTC).isoformat(timespec="seconds")
