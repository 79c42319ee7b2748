"""Table of `bench sensitivity` in Markdown: one row per parameter, those with the largest effect first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.parameters import Parameter
from beamsplat.tools.bench.readme import replace_readme_table
from beamsplat.tools.bench.sensitivity import DEFAULTS, SCALES, Row
from beamsplat.tools.bench.sensitivity_parts import PARTS, Figure, Part

# A change counts as real if it exceeds this many times the spread of the runs with default settings.
NOISE_FACTOR = 2.0
TIME_NOISE_FACTOR = 3.0  # the load of the machine stays different over several runs
# Largest minus smallest of 3 values of a normal distribution, in the mean, over its standard deviation.
_RANGE_OF_3 = 1.7
_INTRODUCTION = """# Parameters and their effect

Each numeric setting of SLAM, fusion and mapper was changed by -30 % and by +30 % while all others kept their
defaults. The tables show the change of the figures, in percent of their values with default settings. This
page is generated:

    beamsplat bench sensitivity --part slam --data DIR --markdown docs/parameters.md

* A cell `-1.2 / +3.4` shows the change with the smaller and with the larger value. **Bold** changes exceed
  twice the spread (largest minus smallest) of the runs with default settings; all others may be noise.
* CPU times vary with the load of the machine. Their default value is the median, and their spread 1.7
  standard deviations, of all runs whose other figures are those of the default settings. Their changes are
  bold if they exceed three times this spread.
* Rows are in the order of the largest bold change of a quality figure, then of a cost.
* Integers are rounded and change by at least 1. Flags and tuples are left out. Values that cannot be used are
  marked as invalid.
* No effect means that the figures of this recording do not depend on the setting. Other recordings can:
  settings for long drives, lost localization or large maps never act in a short drive through a house.
"""


@dataclass(frozen=True)
class Effect:
    """Relative changes of the metrics caused by one parameter; a metric that a run lacks has no entry."""

    parameter: Parameter
    values: tuple[float | int | None, ...]  # by SCALES; None: not measured
    errors: tuple[str, ...]  # by SCALES; "" if the run has metrics
    changes: tuple[dict[str, float], ...]  # by SCALES; 0.01 is one percent

    @property
    def measured(self) -> bool:
        """Whether both changed values of the parameter were run or are invalid."""
        return None not in self.values


def noise(part: Part, rows: list[Row]) -> dict[str, float]:
    """Return the spread of each metric over the runs with default settings, by the key of the metric.

    The spread is the largest minus the smallest value, divided by the value with default settings. Times have
    the equivalent of the standard deviation over all runs that `_unaffected` returns.
    """
    base = _base(part, rows)
    defaults, unaffected = _defaults(rows).values(), _unaffected(part, rows)
    spread = {}
    for figure in part.figures:
        values = [run[figure.key] for run in (unaffected if figure.timed else defaults)]
        width = _RANGE_OF_3 * float(np.std(values)) if figure.timed else max(values) - min(values)
        spread[figure.key] = _relative(width, base[figure.key])
    return spread


def effects(part: Part, parameters: list[Parameter], rows: list[Row]) -> list[Effect]:
    """Return the effect of each parameter on the metrics, the parameter with the largest effect first.

    Args:
        rows: finished runs, see `beamsplat.tools.bench.sensitivity.measure`.

    Raises:
        UserError: the run with default settings and seed 0 is missing.
    """
    base, spread, found = _base(part, rows), noise(part, rows), []
    for parameter in parameters:
        own = {row["scale"]: row for row in rows if row["parameter"] == parameter.name}
        runs = [own.get(scale) for scale in SCALES]
        changes = tuple(
            {
                figure.key: _relative(row["figures"][figure.key] - base[figure.key], base[figure.key])
                for figure in part.figures
                if row and row.get("figures", {}).get(figure.key) is not None
            }
            for row in runs
        )
        values = tuple(row["value"] if row else None for row in runs)
        found.append(Effect(parameter, values, tuple((row or {}).get("error", "") for row in runs), changes))
    return sorted(found, key=lambda effect: _order(part, effect, spread), reverse=True)


def as_json(
    part: Part, parameters: list[Parameter], rows: list[Row], setup: dict[str, Any]
) -> dict[str, Any]:
    """Return the result for JSON: metrics with default settings, their relative spread, relative changes.

    The entries of `setup` are included.
    """
    return {
        **setup,
        "default": _base(part, rows),
        "spread": noise(part, rows),
        "parameters": [
            {
                "name": effect.parameter.name, "default": effect.parameter.default,
                "unit": effect.parameter.unit, "meaning": effect.parameter.meaning,
                "runs": [
                    {"scale": scale, "value": value, "change": change, **({"error": error} if error else {})}
                    for scale, value, change, error in zip(
                        SCALES, effect.values, effect.changes, effect.errors
                    )
                    if value is not None
                ],
            }
            for effect in effects(part, parameters, rows)
        ],
    }  # fmt: skip


def markdown(part: Part, parameters: list[Parameter], rows: list[Row], command: str, date: str) -> str:
    """Return the section of one part in Markdown: command and date, noise, table, parameters not measured."""
    spread, base = noise(part, rows), _base(part, rows)
    defaults = [
        f"{figure.title} {base[figure.key]:.4g} (spread {100.0 * spread[figure.key]:.1f} %)"
        for figure in part.figures
    ]
    found = effects(part, parameters, rows)
    head = ["parameter", "default", "unit", "meaning", "-30 %", "+30 %", *(f.title for f in part.figures)]
    lines = [
        f"Measured with `{command}` on {date}.",
        "",
        f"Default settings ({part.noise}): {', '.join(defaults)}. Changes below are in percent."
        + (f" {part.note}" if part.note else ""),
        "",
        "| " + " | ".join(head) + " |",
        "|---" * len(head) + "|",
    ]
    for effect in found:
        if effect.measured:
            cells = [_cell(figure, effect, spread) for figure in part.figures]
            lines.append("| " + " | ".join([*_head_cells(effect), *cells]) + " |")
    if rest := [f"`{effect.parameter.name}`" for effect in found if not effect.measured]:
        lines += ["", f"Not measured: {', '.join(rest)}."]
    return "\n".join(lines)


def write_page(file: Path, name: str, text: str) -> None:
    """Replace the section of the part called `name` in a Markdown page; create the page if it is missing."""
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        titles = {"slam": "Lidar SLAM", "fusion": "Depth fusion", "map": "Mapper"}
        marks = [
            f"\n## {titles[part]}\n\n<!-- bench sensitivity {part} -->\n<!-- /bench sensitivity {part} -->\n"
            for part in PARTS
        ]
        file.write_text(_INTRODUCTION + "".join(marks))
    replace_readme_table(file, f"sensitivity {name}", f"\n{text}\n")


def _defaults(rows: list[Row]) -> dict[int, dict[str, float]]:
    """Return the metrics of the runs with default settings, by seed.

    Raises:
        UserError: the run with seed 0 is missing.
    """
    runs = {row["seed"]: row["figures"] for row in rows if row["parameter"] == DEFAULTS}
    if 0 not in runs:
        raise UserError("no run with default settings is finished; run the command again, or raise --minutes")
    return runs


def _unaffected(part: Part, rows: list[Row]) -> list[dict[str, float]]:
    """Return the metrics of the default runs and of all runs that differ from them in times only."""
    defaults = _defaults(rows)
    keys = [figure.key for figure in part.figures if not figure.timed]
    changed = [row["figures"] for row in rows if row["parameter"] != DEFAULTS and "figures" in row]
    same = [run for run in changed if all(run[key] == defaults[0][key] for key in keys)]
    return [*defaults.values(), *same]


def _base(part: Part, rows: list[Row]) -> dict[str, float]:
    """Return the metrics with default settings by key: of seed 0, which all other runs use too.

    Times are medians over all runs that `_unaffected` returns.
    """
    unaffected = _unaffected(part, rows)
    timed = [figure.key for figure in part.figures if figure.timed]
    medians = {key: float(np.median([run[key] for run in unaffected])) for key in timed}
    return {**_defaults(rows)[0], **medians}


def _relative(difference: float, base: float) -> float:
    return difference / (abs(base) or 1.0)


def _order(part: Part, effect: Effect, spread: dict[str, float]) -> tuple[float, float, float]:
    """Return the sort key of an effect: three largest absolute relative changes, 0.0 where there is none.

    The first is of quality metrics beyond the noise, the second of costs beyond the noise, the third of
    quality metrics, also within the noise.
    """

    def largest(quality: bool, noise_counts: bool) -> float:
        sizes = [
            abs(change[figure.key])
            for change in effect.changes
            for figure in part.figures
            if figure.quality == quality and figure.key in change
            if noise_counts or _is_real(figure, change[figure.key], spread)
        ]
        return max(sizes, default=0.0)

    return largest(True, False), largest(False, False), largest(True, True)


def _is_real(figure: Figure, change: float, spread: dict[str, float]) -> bool:
    """Return whether a relative change of a metric exceeds the noise."""
    return abs(change) > (TIME_NOISE_FACTOR if figure.timed else NOISE_FACTOR) * spread[figure.key]


def _head_cells(effect: Effect) -> list[str]:
    parameter = effect.parameter
    values = [
        _number(value) + (f" (invalid: {error})" if error else "")
        for value, error in zip(effect.values, effect.errors)
    ]
    words = [parameter.unit, parameter.meaning, *values]
    return [f"`{parameter.name}`", _number(parameter.default), *(word.replace("|", "\\|") for word in words)]


def _number(value: float | int | None) -> str:
    return "–" if value is None else str(value) if isinstance(value, int) else f"{value:.4g}"


def _cell(figure: Figure, effect: Effect, spread: dict[str, float]) -> str:
    shown = []
    for change in effect.changes:
        if figure.key not in change:
            shown.append("–")
            continue
        text = f"{100.0 * change[figure.key]:+.1f}"
        text = "0" if text in ("+0.0", "-0.0") else text
        real = text != "0" and _is_real(figure, change[figure.key], spread)
        shown.append(f"**{text}**" if real else text)
    return " / ".join(shown)
