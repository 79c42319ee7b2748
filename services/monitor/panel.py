"""Drawing of the health of the nodes in rerun: plots, states, a table and a log.

Entities:
    plots/<quantity>/<node>     one curve per node
    health/state/<node>         life cycle state (configure, active, drained ...) as a coloured lane
    health/table                the newest health of all nodes
    log                         changes of state, faults, and the nodes' status texts
"""

from __future__ import annotations

from dataclasses import dataclass

import rerun as rr

from beamsplat.common.geometry.tracks import RateLimit
from beamsplat.services.monitor.rerun_writer import RerunWriter

# quantity -> title of its plot
PLOTS = {
    "step_p95_ms": "Step time, p95 [ms]",
    "age_ms": "Age of inputs [ms]",
    "dropped_hz": "Dropped and lost [1/s]",
    "rss_mb": "Memory [MB]",
    "cpu_percent": "CPU [%]",
}
_MAX_NODES = 1000  # of all robots, whose newest report is kept
_STATES = {
    "configure": 0x9E9E9EFF, "standby": 0xFFC107FF, "active": 0x4CAF50FF,
    "drain": 0x00BCD4FF, "drained": 0x2196F3FF, "closed": 0x607D8BFF,
}  # fmt: skip


@dataclass(frozen=True)
class NodeReport:
    """The health of one node, received once per second. Counts start at zero when the node starts."""

    node: str
    instance: str
    wall_ns: int  # the node's clock, for rates
    state: str
    detail: str
    step_p50_ms: float
    step_p95_ms: float
    age_ms: float
    received: int
    sent: int
    dropped: int
    lost: int
    broken: int
    rss_mb: float
    cpu_percent: float


class HealthPanel:
    """Draws the newest report of each node; rates are computed from the newest two reports."""

    def __init__(self, writer: RerunWriter, limits: RateLimit) -> None:
        self._writer = writer
        self._limits = limits
        self._reports: dict[str, NodeReport] = {}
        self._statuses: dict[str, str] = {}

    def report(self, new: NodeReport, stamp_ns: int | None) -> None:
        """Draw a report; `stamp_ns`: newest measurement time, None before the first measurement."""
        old = self._reports.pop(new.node, None)  # the node that reported longest ago is the first one
        if old is None:
            self._declare_plots(new.node)
        if len(self._reports) >= _MAX_NODES:
            del self._reports[next(iter(self._reports))]
        if old is not None and old.instance != new.instance:
            self.log(f"{new.node} was restarted", stamp_ns, "WARN")
            old = None
        self._reports[new.node] = new
        curves = {
            "step_p95_ms": new.step_p95_ms,
            "age_ms": new.age_ms,
            "dropped_hz": 0.0 if old is None else _rate_hz(old, new),
            "rss_mb": new.rss_mb,
            "cpu_percent": new.cpu_percent,
        }
        for quantity, value in curves.items():
            self._writer.log(f"plots/{quantity}/{new.node}", rr.Scalars(value), stamp_ns=stamp_ns)
        if old is None or old.state != new.state:
            self._writer.log(f"health/state/{new.node}", rr.StateChange(state=new.state), stamp_ns=stamp_ns)
            self.log(f"{new.node} is {new.state}", stamp_ns)
        if new.detail and (old is None or old.detail != new.detail):
            self.log(f"{new.node}: {new.detail}", stamp_ns)
        for count, text in (("lost", "lost"), ("broken", "could not decode")):
            more = getattr(new, count) - (0 if old is None else getattr(old, count))
            if more > 0:
                self.log(f"{new.node} {text} {more} messages", stamp_ns, "WARN")
        if self._limits.due("health", new.wall_ns):
            self._writer.log(
                "health/table",
                rr.TextDocument(self._table(), media_type=rr.MediaType.MARKDOWN),
                stamp_ns=stamp_ns,
            )

    def status(self, path: str, status: str, detail: str, stamp_ns: int) -> None:
        """Draw the status of the results of a service, if the status has changed."""
        if self._statuses.get(path) == status:
            return
        self._statuses[path] = status
        self._writer.log(f"health/state/{path}", rr.StateChange(state=status), stamp_ns=stamp_ns)
        level = "INFO" if status == "ok" else "WARN"
        self.log(f"{path}: {status}{f' ({detail})' if detail and status != 'ok' else ''}", stamp_ns, level)

    def log(self, text: str, stamp_ns: int | None, level: str = "INFO") -> None:
        """Append one line to the log."""
        self._writer.log("log", rr.TextLog(text, level=level), stamp_ns=stamp_ns)

    def _declare_plots(self, node: str) -> None:
        for quantity in PLOTS:
            self._writer.log(f"plots/{quantity}/{node}", rr.SeriesLines(names=node), static=True)
        self._writer.log(
            f"health/state/{node}",
            rr.StateConfiguration(values=list(_STATES), labels=list(_STATES), colors=list(_STATES.values())),
            static=True,
        )

    def _table(self) -> str:
        lines = [
            "| node | state | step p50 ms | p95 | age ms | in | out | dropped | lost | bad | MB | CPU % | |",
            "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|---|",
        ]
        for name, r in sorted(self._reports.items()):
            lines.append(
                f"| **{name}** | {r.state} | {r.step_p50_ms:.2f} | {r.step_p95_ms:.2f} | {r.age_ms:.1f} | "
                f"{r.received} | {r.sent} | {r.dropped} | {r.lost} | {r.broken} | {r.rss_mb:.0f} | "
                f"{r.cpu_percent:.0f} | {r.detail.replace('|', '/')} |"
            )
        return "\n".join(lines)


def _rate_hz(old: NodeReport, new: NodeReport) -> float:
    """Return the number of dropped and lost messages per second between two reports."""
    seconds = max((new.wall_ns - old.wall_ns) / 1e9, 1e-3)
    return (new.dropped + new.lost - old.dropped - old.lost) / seconds
