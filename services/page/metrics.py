"""Prometheus metrics: the text exposition format 0.0.4, from health reports and alerts.

Names have base units (seconds, bytes, hertz, meters, ratios from 0 to 1); counters end with `_total` and
start at 0 with each process. Of a node that is silent only its state is exported: the other values are
outdated.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any, get_args

from beamsplat.common.config.alerts import AlertKind
from beamsplat.common.runtime.alerts import Alert
from beamsplat.common.runtime.figures import FIGURES
from beamsplat.common.runtime.health import NodeRecord
from beamsplat.common.status import TrackingStatus
from beamsplat.services.page.alerting import Alerting
from beamsplat.services.page.fleet import Fleet

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_PREFIX = "beamsplat_"
_STATES = ("configure", "standby", "active", "drain", "drained", "closed", "failed", "silent")
_DROP_REASONS = {  # label `reason` -> counter of an input
    "overtaken": "dropped", "lost": "lost", "undecodable": "undecodable", "stale": "stale",
    "other_process": "refused",
}  # fmt: skip
# Name without prefix -> type and help. All have the label `robot` except those of the page and its webhook.
FAMILIES: dict[str, tuple[str, str]] = {
    "build_info": ("gauge", "1; the label is the version of the program."),
    "node_up": ("gauge", "1 if the node reports its health and can run, else 0."),
    "node_state": ("gauge", "1 for the state of the node, 0 for the others."),
    "node_report_age_seconds": ("gauge", "Time since the newest health report; nodes report once a second."),
    "node_restarts_total": ("counter", "Further processes of the node since the page started."),
    "node_step_seconds": ("gauge", "Duration of the node's last 512 steps: median and 95th percentile."),
    "node_resident_memory_bytes": ("gauge", "Resident memory of the process."),
    "node_cpu_cores": ("gauge", "CPU use over the last second, in cores."),
    "node_input_messages_total": ("counter", "Messages that the node has handled."),
    "node_input_rate_hertz": ("gauge", "Messages handled per second, over the last 5 s."),
    "node_input_age_seconds": ("gauge", "Age of the newest message when it was handled; one host only."),
    "node_dropped_total": ("counter", "Messages that the node did not handle, by reason."),
    "node_late_total": ("counter", "Messages that were recovered after newer ones."),
    "node_rejected_total": ("counter", "Inputs and results that the node has refused, by reason."),
    "node_output_messages_total": ("counter", "Messages that the node has published."),
    "node_output_bytes_total": ("counter", "Payload that the node has published."),
    "node_output_rate_hertz": ("gauge", "Messages published per second, over the last 5 s."),
    "localization_status": ("gauge", "1 for the status of the newest pose, 0 for the others."),
    **{name: ("counter" if kind.counter else "gauge", kind.help) for name, kind in FIGURES.items()},
    "alert_active": ("gauge", "1 for each active alert; 0 for each kind without one, without a node."),
    "page_viewers": ("gauge", "Open event streams of the page."),
    "page_refused_total": ("counter", "Requests and connections that the page has refused, by reason."),
    "webhook_queued": ("gauge", "Events that wait for the webhook."),
    "webhook_sent_total": ("counter", "Events that the webhook has received."),
    "webhook_failed_attempts_total": ("counter", "Attempts that did not reach the webhook."),
    "webhook_lost_total": ("counter", "Events that the webhook refused, or that the queue had no room for."),
}


class MetricsText:
    """Samples of the families in `FAMILIES`, and their text."""

    def __init__(self) -> None:
        self._samples: dict[str, dict[str, str]] = {}  # family -> labels -> value

    def add(self, name: str, value: float, **labels: str) -> None:
        """Add a sample of a family; `name` is without the prefix.

        A second sample with the same labels replaces the first one: a file with both is refused as a whole.
        """
        assert name in FAMILIES, name
        pairs = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels.items())
        self._samples.setdefault(name, {})[f"{{{pairs}}}" if pairs else ""] = _number(value)

    def text(self) -> bytes:
        """Return all families that have samples, in the order of `FAMILIES`."""
        lines: list[str] = []
        for name, (kind, about) in FAMILIES.items():
            if name in self._samples:
                lines += [f"# HELP {_PREFIX}{name} {about}", f"# TYPE {_PREFIX}{name} {kind}"]
                lines += [f"{_PREFIX}{name}{pairs} {value}" for pairs, value in self._samples[name].items()]
        return ("\n".join(lines) + "\n").encode()


def page_metrics(fleet: Fleet, alerting: Alerting, viewers: int, refused: Mapping[str, int]) -> bytes:
    """Return the metrics of all robots of a page, its alerts, and the page itself.

    Args:
        viewers: number of open event streams.
        refused: requests and connections that were refused, by reason.
    """
    out, now = MetricsText(), time.monotonic()
    out.add("build_info", 1, version=_program_version())
    states = fleet.states()
    for robot, state in states.items():
        state.with_records(partial(add_robot, out, robot, now))
    add_alerts(out, states, alerting.alerts(), alerting.rules.off)
    out.add("page_viewers", viewers)
    for reason, count in refused.items():
        out.add("page_refused_total", count, reason=reason)
    if (webhook := alerting.webhook) is not None:
        out.add("webhook_queued", len(webhook))
        out.add("webhook_sent_total", webhook.sent)
        out.add("webhook_failed_attempts_total", webhook.failed_attempts)
        out.add("webhook_lost_total", webhook.refused + webhook.dropped)
    return out.text()


def add_robot(out: MetricsText, robot: str, now: float, records: Mapping[str, NodeRecord]) -> None:
    """Add what is known of a robot: `records` by node name, `now` in s of `time.monotonic`."""
    for node, record in sorted(records.items()):
        _add_state(out, robot, node, record, now)
        if record.silent_s(now) is None and record.health.state != "failed":
            _add_process(out, robot, node, record)
            _add_messages(out, robot, node, record)
            _add_results(out, robot, node, record)


def add_alerts(out: MetricsText, robots: Iterable[str], alerts: Iterable[Alert], off: Iterable[str]) -> None:
    """Add the active alerts of all robots; `off`: kinds that are never raised."""
    by_robot: dict[str, list[Alert]] = {robot: [] for robot in robots}
    for alert in alerts:
        by_robot.setdefault(alert.key.robot, []).append(alert)
    for robot, active in by_robot.items():
        for alert in active:
            out.add("alert_active", 1, robot=robot, alert=alert.key.kind, node=alert.key.node)
        for kind in get_args(AlertKind):
            if kind not in off and kind not in {alert.key.kind for alert in active}:
                out.add("alert_active", 0, robot=robot, alert=kind, node="")


def _add_state(out: MetricsText, robot: str, node: str, record: NodeRecord, now: float) -> None:
    state = "silent" if record.silent_s(now) is not None else record.health.state
    out.add("node_up", state not in ("silent", "failed"), robot=robot, node=node)
    for name in _STATES:
        out.add("node_state", name == state, robot=robot, node=node, state=name)
    out.add("node_report_age_seconds", round(now - record.received_s, 3), robot=robot, node=node)
    out.add("node_restarts_total", record.starts - 1, robot=robot, node=node)


def _add_process(out: MetricsText, robot: str, node: str, record: NodeRecord) -> None:
    health = record.health
    for quantile, step_ms in (("0.5", health.step_p50_ms), ("0.95", health.step_p95_ms)):
        out.add("node_step_seconds", step_ms / 1e3, robot=robot, node=node, quantile=quantile)
    out.add("node_resident_memory_bytes", health.rss_mb * 1e6, robot=robot, node=node)
    out.add("node_cpu_cores", health.cpu_percent / 100.0, robot=robot, node=node)


def _add_messages(out: MetricsText, robot: str, node: str, record: NodeRecord) -> None:
    for entry in record.health.inputs:
        labels = {"robot": robot, "node": node, "topic": entry.topic}
        out.add("node_input_messages_total", entry.received, **labels)
        out.add("node_input_rate_hertz", record.rate(partial(_received, entry.topic)), **labels)
        if entry.age_ms > 0.0:  # 0 = unknown
            out.add("node_input_age_seconds", entry.age_ms / 1e3, **labels)
        for reason, counter in _DROP_REASONS.items():
            out.add("node_dropped_total", getattr(entry, counter), **labels, reason=reason)
        out.add("node_late_total", entry.late, **labels)
    for sent in record.health.outputs:
        labels = {"robot": robot, "node": node, "topic": sent.topic}
        out.add("node_output_messages_total", sent.sent, **labels)
        out.add("node_output_bytes_total", sent.bytes, **labels)
        out.add("node_output_rate_hertz", record.rate(partial(_sent, sent.topic)), **labels)
        out.add("node_dropped_total", sent.refused, **labels, reason="too_large")
    for refused in record.health.rejected:
        labels = {"robot": robot, "node": node, "topic": refused.topic, "reason": refused.reason}
        out.add("node_rejected_total", refused.count, **labels)


def _add_results(out: MetricsText, robot: str, node: str, record: NodeRecord) -> None:
    for figure in record.health.figures:
        if figure.name in FIGURES:  # names come from other hosts
            out.add(figure.name, figure.value, robot=robot, node=node)
    status = record.health.status.partition(":")[0]
    if node == "localization" and status:
        for name in get_args(TrackingStatus):
            out.add("localization_status", name == status, robot=robot, status=name)


def _program_version() -> str:
    try:
        return version("beamsplat")
    except PackageNotFoundError:  # run from the sources
        return "unknown"


def _received(topic: str, health: Any) -> int:
    return next((i.received for i in health.inputs if i.topic == topic), 0)


def _sent(topic: str, health: Any) -> int:
    return next((o.sent for o in health.outputs if o.topic == topic), 0)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')


def _number(value: float) -> str:
    """Return a number as the format has it: integers without a point, NaN and infinity by name."""
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return str(int(value)) if value == int(value) and abs(value) < 2**53 else repr(float(value))
