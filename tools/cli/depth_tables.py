"""Tables of `beamsplat eval depth`."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

_WHOLE = (
    "rmse_m", "absrel", "delta1", "coverage", "beams_rmse_m", "heldout_median_m", "heldout_p90_m",
    "heldout_excluded", "heldout_blocks_median_m", "within_1sigma", "within_3sigma",
    "dense_within_1sigma", "dense_within_3sigma", "sigma_median_m", "frames", "frames_refused",
)  # fmt: skip
_INTERVALS = (
    "absrel", "rmse_m", "l1_m", "delta1", "within_5cm", "coverage", "within_1sigma", "within_3sigma",
)  # fmt: skip
_PART_COLUMNS = ("within_5cm", "share_of_l1", "median_m", "l1_m", "absrel")
_TITLES = {"height": "by height above the floor", "distance": "by distance", "edges": "at depth edges"}


def print_depth_report(report: dict[str, Any]) -> None:
    """Print the report of `evaluation.evaluate.evaluate` as tables on standard output."""
    console = Console()
    names = [name for name, entry in report.items() if isinstance(entry, dict) and "rmse_m" in entry]
    table = Table(title=f"default {report['default']}, source {report['source']}, {report['poses']}")
    table.add_column("")
    for name in names:
        table.add_column(name, justify="right")
    for key in _WHOLE:
        table.add_row(key, *(_text(report[name].get(key)) for name in names))
    console.print(table)
    breakdown = report["breakdown"]
    methods = [name for name in (report["default"], "poisson", "learned") if name in breakdown["methods"]]
    _print_intervals(console, breakdown, methods)
    for name in (name for name in methods if name != "poisson"):
        _print_parts(console, name, breakdown["methods"][name])
    console.print(_heights_line(breakdown["heights"]), highlight=False, markup=False, soft_wrap=True)
    for key in ("comparison", "poisson_comparison"):
        if key in report:
            _print_comparison(console, report[key])
    print("CPU ms per image: " + ", ".join(f"{k} {v:.1f}" for k, v in report["cpu_ms"].items()))


def _print_intervals(console: Console, breakdown: dict[str, Any], methods: list[str]) -> None:
    share, block = breakdown["confidence"], breakdown["block_frames"]
    table = Table(title=f"means over images, with {share:.0%} intervals from blocks of {block} images")
    table.add_column("")
    for name in methods:
        table.add_column(name, justify="right")
    for key in _INTERVALS:
        table.add_row(key, *(_with_interval(breakdown["methods"][name]["whole"], key) for name in methods))
    console.print(table)


def _print_parts(console: Console, method: str, groupings: dict[str, Any]) -> None:
    for grouping, title in _TITLES.items():
        if grouping not in groupings:
            continue
        table = Table(title=f"{method}: {title}", title_justify="left")
        table.add_column("part")
        for column in ("share of pixels", "coverage", *_PART_COLUMNS):
            table.add_column(column, justify="right")
        for row in groupings[grouping]:
            table.add_row(
                row["part"], _text(row["share"]), _text(row["coverage"]),
                *(_with_interval(row, key) for key in _PART_COLUMNS),
            )  # fmt: skip
        console.print(table)


def _heights_line(heights: dict[str, Any]) -> str:
    """Return one sentence on where the heights come from."""
    if "floor_m" not in heights:
        return f"No figures by height: no floor was found in the true depth ({heights['poses']})."
    ceilings = ", ".join(f"{z:.2f} m" for z in heights["ceilings_m"]) or "none found"
    return (
        f"Heights from true depth and {heights['poses']}; floor: {heights['floor']}, at "
        f"{heights['floor_m']:.2f} m; ceilings above it: {ceilings}."
    )


def _print_comparison(console: Console, comparison: dict[str, Any]) -> None:
    table = Table(
        title=f"{comparison['second']} against {comparison['first']}, on the {comparison['coverage']:.1%} "
        "of the pixels that both answer"
    )
    for column in ("", comparison["first"], comparison["second"], "change"):
        table.add_column(column, justify="right")
    for key in ("absrel", "rmse_m", "l1_m", "within_5cm"):
        entry = comparison[key]
        table.add_row(key, _text(entry["first"]), _text(entry["second"]), _with_interval(entry, "change"))
    console.print(table)


def _text(value: float | int | None) -> str:
    return "-" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _with_interval(row: dict[str, Any], key: str) -> str:
    bounds = row.get(f"{key}_interval")
    value = _text(row.get(key))
    return value if bounds is None else escape(f"{value} [{bounds[0]:.3f}, {bounds[1]:.3f}]")
