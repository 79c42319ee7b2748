"""Samples of memory, descriptors and threads of running processes, taken from outside, as CSV and charts."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from beamsplat.tools.report.svg import COLOURS, Curve, chart


@dataclass(frozen=True)
class ProcessSample:
    """State of one process at one time."""

    time_s: float  # since the first sample
    pid: int
    private_mb: float  # unique set size: pages that no other process maps
    resident_mb: float
    descriptors: int
    threads: int
    cpu_s: float  # user and system time since the start of the process


@dataclass
class ProcessSamples:
    """Time series of samples by process name; a name keeps its series when its process is replaced."""

    series: dict[str, list[ProcessSample]] = field(default_factory=dict)

    def take(self, time_s: float, pids: Mapping[str, int]) -> None:
        """Add a sample of each process; one that has just ended is left out."""
        for name, pid in pids.items():
            try:
                process = psutil.Process(pid)
                with process.oneshot():
                    memory, times = process.memory_full_info(), process.cpu_times()
                    sample = ProcessSample(
                        time_s, pid, memory.uss / 1e6, memory.rss / 1e6, process.num_fds(),
                        process.num_threads(), times.user + times.system,
                    )  # fmt: skip
            except psutil.Error:
                continue
            self.series.setdefault(name, []).append(sample)

    def values(self, name: str, figure: str) -> np.ndarray:
        """Return one figure (a field of `ProcessSample`) of a process over time, float64 [N]."""
        return np.array([getattr(sample, figure) for sample in self.series.get(name, [])], np.float64)

    def quarter(self, name: str, figure: str, number: int) -> np.ndarray:
        """Return the values of a figure in quarter 1 to 4 of the time that all samples span."""
        end_s = max(samples[-1].time_s for samples in self.series.values())
        times_s, values = self.values(name, "time_s"), self.values(name, figure)
        return values[(times_s >= end_s * (number - 1) / 4) & (times_s <= end_s * number / 4)]

    def write_csv(self, path: Path) -> None:
        """Write all samples, one per line.

        Raises:
            OSError: the file cannot be written.
        """
        columns = tuple(ProcessSample.__dataclass_fields__)
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("process", *columns))
            for name, samples in self.series.items():
                for sample in samples:
                    values = (getattr(sample, column) for column in columns)
                    writer.writerow((name, *(f"{v:.2f}" if isinstance(v, float) else v for v in values)))

    def charts(self) -> list[str]:
        """Return charts of memory, descriptors and threads over time in minutes, as SVG elements."""
        figures = (("private_mb", "private memory", "MB"), ("descriptors", "descriptors", ""),
                   ("threads", "threads", ""))  # fmt: skip
        return [
            chart(title, "min", unit, [
                Curve(
                    name,
                    np.column_stack([self.values(name, "time_s") / 60.0, self.values(name, figure)]),
                    COLOURS[i % len(COLOURS)],
                    dashed=i >= len(COLOURS),
                )
                for i, name in enumerate(sorted(self.series))
            ])
            for figure, title, unit in figures
        ]  # fmt: skip
