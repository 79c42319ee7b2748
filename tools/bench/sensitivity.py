"""`bench sensitivity`: effect of each setting on quality and cost of SLAM, fusion or mapper.

One setting is changed at a time, by the factors `SCALES`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.parameters import Parameter, invalid, parameters_of, scaled, with_value
from beamsplat.tools.bench.sensitivity_parts import Part, Run

SCALES = (0.7, 1.3)
DEFAULTS = "default"  # stands in a row for the name of the parameter, if none is changed
SEEDS = (0, 1, 2)  # of the runs with default settings, which show the noise; all others have seed 0

Row = dict[str, Any]  # one run; see `measure`


@dataclass(frozen=True)
class PlannedRun:
    """One run to make: with one parameter changed to `value`, or with default settings and a seed."""

    parameter: str
    value: float | int | None  # None for the defaults
    scale: float
    seed: int
    invalid: str = ""  # why the value is not run


def plan(parameters: list[Parameter]) -> list[PlannedRun]:
    """Return all runs: default settings with each of `SEEDS`, then each parameter times each of `SCALES`."""
    runs = [PlannedRun(DEFAULTS, None, 1.0, seed) for seed in SEEDS]
    for parameter in parameters:
        for scale in SCALES:
            value = scaled(parameter.default, scale)
            runs.append(PlannedRun(parameter.name, value, scale, 0, invalid(parameter, value)))
    return runs


def chosen(part: Part, only: list[str] | None) -> list[Parameter]:
    """Return the parameters of a part that are named in `only`, in this order; all parameters without `only`.

    Raises:
        UserError: the part has no parameter of this name.
    """
    parameters = {parameter.name: parameter for parameter in parameters_of(part.settings)}
    for name in only or []:
        if name not in parameters:
            raise UserError(f"unknown parameter {name!r}; known are {', '.join(parameters)}")
    return [parameters[name] for name in only or parameters]


def read_rows(file: Path, setup: dict[str, Any]) -> list[Row]:
    """Return the rows of a JSON-lines file whose entries include all of `setup`; [] if the file is missing.

    A row is one finished run, see `measure`. An incomplete last line (of an interrupted run) is left out.
    """
    if not file.is_file():
        return []
    rows = []
    for line in file.read_text().splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if all(row.get(key) == value for key, value in setup.items()):
            rows.append(row)
    return rows


def measure(
    part: Part,
    run: Callable[[], Run],
    parameters: list[Parameter],
    file: Path,
    setup: dict[str, Any],
    minutes: float = float("inf"),
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[Row]:
    """Make the runs that are not in `file` yet, append one row per run to it, and return all rows of `setup`.

    A row is a JSON object with the entries of `setup`, `parameter`, `value`, `scale`, `seed`, `duration_s`,
    and either `figures` (metrics by name) or `error` (why the value was not run, or how the run failed).

    Args:
        part: SLAM, fusion or mapper.
        run: loads the recording and returns the function that makes one run; not called if no run is left.
        parameters: the parameters to change.
        file: JSON-lines file of the rows.
        setup: entries that identify the measurement, such as the recording; other rows of `file` are ignored.
        minutes: no run starts later than this time after the first one.
        progress: receives the name of the parameter, the number of finished runs, the number of all runs.
    """
    rows, runs = read_rows(file, setup), plan(parameters)
    finished = {(row["parameter"], row["value"], row["seed"]) for row in rows}
    todo = [item for item in runs if (item.parameter, item.value, item.seed) not in finished]
    prepared = run() if any(not item.invalid for item in todo) else None
    file.parent.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60.0 * minutes
    for item in todo:
        progress(item.parameter, len(runs) - len(todo) + todo.index(item), len(runs))
        if time.monotonic() > end:
            break
        started = time.monotonic()
        outcome = {"error": item.invalid} if item.invalid else _outcome(part, prepared, item)
        row = {
            **setup, "parameter": item.parameter, "value": item.value, "scale": item.scale, "seed": item.seed,
            "duration_s": round(time.monotonic() - started, 2), **outcome,
        }  # fmt: skip
        with file.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
        rows.append(row)
    return rows


def _outcome(part: Part, run: Run | None, item: PlannedRun) -> dict[str, Any]:
    """Make one run; return {"figures": metrics by name}, or {"error": text} if the changed setting fails.

    Settings are not checked before they are used.
    """
    assert run is not None
    settings = part.settings
    if item.value is not None:
        settings = with_value(settings, item.parameter, item.value)
    try:
        return {"figures": run(settings, item.seed)}
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError, UserError) as error:
        if item.value is None:
            raise
        return {"error": f"{type(error).__name__}: {error}"}
