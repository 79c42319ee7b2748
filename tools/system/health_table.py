"""Receive the health messages of all nodes of a robot from the bus, and show them as tables."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from beamsplat.common.config.alerts import AlertConfig
from beamsplat.common.messages.header import DecodeError, local_clock_id
from beamsplat.common.runtime.alerts import Alert, AlertBook, AlertKey, conditions
from beamsplat.common.runtime.health import HealthRecords, NodeRecord, TopicConsumer, TopicTraffic
from beamsplat.common.topics import HEALTH
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.health_samples import decode_health
from beamsplat.common.zenoh.receiving import receive_in_thread

ALL = "*"
DEFAULT_RULES = AlertConfig()


class HealthTable:
    """Table of the newest health message of every node, received in a thread until `session` is closed.

    The nodes are of one robot, or of all robots if `robot` is `ALL`; they are then named robot/node.
    """

    def __init__(
        self, session: zenoh.Session, robot: str, clock_s: Callable[[], float] = time.monotonic,
        rules: AlertConfig = DEFAULT_RULES,
    ) -> None:  # fmt: skip
        """Subscribe.

        Args:
            clock_s: replaces `time.monotonic`.
            rules: of the alerts that `alerts` returns and `nodes_table` shows.
        """
        self._clock_s = clock_s
        self._all, self._robot = robot == ALL, robot
        self._rules, self._alerts = rules, AlertBook(rules)
        self._clock_id = local_clock_id()
        self._book = HealthRecords()
        self.records: dict[str, NodeRecord] = self._book.records
        self._lock = threading.Lock()
        self._undecodable, self._last_fault = 0, ""  # reports that could not be decoded
        self._subscriber = session.declare_subscriber(
            key(robot, HEALTH, "*"), zenoh.handlers.FifoChannel(256)
        )
        receive_in_thread(session, "health-board", self._subscriber, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        try:
            reports = decode_health(sample)
        except DecodeError as error:
            with self._lock:
                self._undecodable, self._last_fault = self._undecodable + 1, f"{sample.key_expr}: {error}"
            return
        if self._all:
            whose = str(sample.key_expr).split("/")[1]
            reports = [h.model_copy(update={"node": f"{whose}/{h.node}"}) for h in reports]
        with self._lock:
            for health in reports:
                self._book.add(health, self._clock_s())

    def states(self) -> dict[str, str]:
        """Return the state of each node by name; "silent" if its last health message is too old."""
        with self._lock:
            return self._book.states(self._clock_s())

    def reported(self) -> dict[str, tuple[str, str]]:
        """Return (instance, state) of each node by name, without the silent ones."""
        now = self._clock_s()
        with self._lock:
            records = self.records.items()
            return {n: (r.health.instance, r.health.state) for n, r in records if not r.silent_s(now)}

    def snapshot(self) -> dict[str, Any]:
        """Return the health of all nodes and the traffic of all topics for JSON; keys end with the unit."""
        now = self._clock_s()
        with self._lock:
            nodes = {name: _node_figures(record, now) for name, record in sorted(self.records.items())}
            topics = {flow.topic: _topic_figures(flow) for flow in self._book.traffic()}
        return {"nodes": nodes, "topics": topics, "alerts": [alert.as_json() for alert in self.alerts()]}

    def alerts(self) -> list[Alert]:
        """Evaluate the alerts now, and return the active and the pending ones, oldest first.

        A pending alert is a condition that does not hold for long enough yet; time counts from the first
        call.
        """
        now = self._clock_s()
        with self._lock:
            robots: dict[str, dict[str, NodeRecord]] = {}
            for name, record in self.records.items():
                robot, _, node = name.rpartition("/")
                robots.setdefault(robot or self._robot, {})[node] = record
            found: dict[AlertKey, str] = {}
            for robot, records in robots.items():
                found.update(conditions(robot, records, self._clock_id, self._rules, now))
            self._alerts.update(found, robots, now, time.time())
            return self._alerts.alerts(pending=True)

    def status_line(self) -> str:
        """Return state, message rate and number of lost messages of every node in one line of text."""
        now = self._clock_s()
        parts = []
        with self._lock:
            for name, record in sorted(self.records.items()):
                totals, silent_s = record.totals(), record.silent_s(now)
                state = f"silent {silent_s:.0f} s" if silent_s else record.health.state
                rate = totals.out_hz if record.health.outputs else totals.in_hz
                lost = f", {totals.lost} lost" if totals.lost else ""
                why = f": {record.health.detail}" if state == "failed" else f" {rate:.1f} Hz{lost}"
                parts.append(f"{name} {state}{why}")
        return "; ".join(parts) or "no node reports yet"

    def nodes_table(self) -> RenderableType:
        """Return a table with one row per node: process, state, rates, step time, age, losses, memory, CPU.

        Status texts of the nodes are below the table. With several robots, process ids are not shown: the
        names need the space, and the ids belong to other hosts.
        """
        table = _narrow_table()
        table.add_column("node", no_wrap=True)
        if not self._all:
            table.add_column("pid", justify="right", no_wrap=True)
        table.add_column("state", no_wrap=True)
        for heading in (
            "in\nHz",
            "out\nHz",
            "step\nms",
            "p95\nms",
            "age\nms",
            "drop",
            "lost",
            "bad",
            "MB",
            "CPU%",
        ):
            table.add_column(heading, justify="right", no_wrap=True)
        now = self._clock_s()
        said = [_alert_text(alert, now, self._all) for alert in self.alerts()]
        with self._lock:
            for name, record in sorted(self.records.items()):
                name_cell, *cells = _node_row(name, record, now)
                pid = () if self._all else (str(record.health.pid or ""),)
                table.add_row(name_cell, *pid, *cells)
                if record.health.detail:
                    style = "red" if record.health.state == "failed" else "dim"
                    said.append(Text(f"{name}: {record.health.detail}", style=style))
                if late := record.totals().late:
                    said.append(Text(f"{name}: {late} messages arrived late, and are not lost", style="dim"))
                if record.refused:
                    text = f"{name}: {record.refused} reports of another process with this name are refused"
                    said.append(Text(text, style="red"))
            if self._undecodable:
                text = f"{self._undecodable} health reports could not be decoded: {self._last_fault}"
                said.append(Text(text, style="red"))
        return Group(table, *said)

    def topics_table(self) -> Table:
        """Return a table with one row per published topic: producer, rate, bytes, consumers."""
        table = _narrow_table()
        for heading in ("topic", "from"):
            table.add_column(heading, no_wrap=True)
        for heading in ("Hz/nominal", "KB/s", "sent"):
            table.add_column(heading, justify="right", no_wrap=True)
        table.add_column("to, age ms", overflow="fold")
        with self._lock:
            for flow in self._book.traffic():
                table.add_row(*_flow_row(flow))
        return table


def _node_figures(record: NodeRecord, now: float) -> dict[str, Any]:
    health, totals, silent_s = record.health, record.totals(), record.silent_s(now)
    return {
        "state": "silent" if silent_s else health.state, "silent_s": silent_s, "pid": health.pid,
        "starts": record.starts, "epoch": health.epoch, "in_hz": totals.in_hz, "out_hz": totals.out_hz,
        "step_p50_ms": health.step_p50_ms, "step_p95_ms": health.step_p95_ms, "age_ms": totals.age_ms,
        "dropped": totals.dropped, "lost": totals.lost, "late": totals.late,
        "bad": totals.bad + record.refused, "rss_mb": health.rss_mb, "cpu_percent": health.cpu_percent,
        "detail": health.detail,
    }  # fmt: skip


def _topic_figures(flow: TopicTraffic) -> dict[str, Any]:
    return {
        "producer": flow.producer, "rate_hz": flow.hz, "nominal_hz": flow.nominal_hz,
        "bytes_per_s": flow.bytes_s, "sent": flow.sent,
        "consumers": {
            consumer.node: {"age_ms": consumer.age_ms, "dropped": consumer.dropped, "lost": consumer.lost}
            for consumer in flow.consumers
        },
    }  # fmt: skip


def _narrow_table() -> Table:
    """Return a table without borders: both tables must fit into 80 columns."""
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=0)


def _node_row(name: str, record: NodeRecord, now: float) -> tuple[str, ...]:
    health, totals, silent_s = record.health, record.totals(), record.silent_s(now)
    colours = {"active": "green", "drained": "cyan", "failed": "red"}
    colour = "red" if silent_s else colours.get(health.state, "yellow")
    state = f"silent {silent_s:.0f} s" if silent_s else health.state
    return (
        name,
        f"[{colour}]{state}[/]",
        _short(totals.in_hz) if health.inputs else "",
        _short(totals.out_hz) if health.outputs else "",
        _short(health.step_p50_ms),
        _short(health.step_p95_ms),
        _short(totals.age_ms) if health.inputs else "",
        _count(totals.dropped, "yellow"),
        _count(totals.lost, "red"),
        _count(totals.bad + record.refused, "red"),
        f"{health.rss_mb:.0f}",
        f"{health.cpu_percent:.0f}",
    )


def _alert_text(alert: Alert, now: float, with_robot: bool) -> Text:
    key, seconds = alert.key, now - alert.since_s
    subject = f"{key.robot}: " if with_robot else ""
    kind = f"{'ALERT' if alert.active else 'pending alert'} {key.kind.replace('_', ' ')}"
    return Text(
        f"{subject}{kind} ({seconds:.0f} s): {alert.text}", style="bold red" if alert.active else "yellow"
    )


def _short(number: float) -> str:
    """Return a number as text of at most four characters, from 10 000 on of more."""
    return f"{number:.1f}" if number < 99.95 else f"{number:.0f}"


def _flow_row(flow: TopicTraffic) -> tuple[str, ...]:
    nominal = f"{flow.nominal_hz:g}" if flow.nominal_hz else "event"
    consumers = "\n".join(map(_consumer_text, flow.consumers))
    hz, kb_s = f"{flow.hz:.1f}/{nominal}", f"{flow.bytes_s / 1e3:.1f}"
    return flow.topic, flow.producer, hz, kb_s, str(flow.sent), consumers


def _consumer_text(consumer: TopicConsumer) -> str:
    counts = ((consumer.dropped, "yellow", "dropped"), (consumer.lost, "red", "lost"))
    losses = "".join(f", [{colour}]{number} {what}[/]" for number, colour, what in counts if number)
    return f"{consumer.node} {consumer.age_ms:.1f}{losses}"


def _count(number: int, colour: str) -> str:
    return f"[{colour}]{number}[/]" if number else "0"
