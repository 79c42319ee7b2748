"""`bench sensitivity`: effect of each setting, changed one at a time, on the figures of a part."""

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
    """One run: a parameter with a value, or the defaults with a seed."""

    parameter: str
    value: float | int | None  # None for the defaults
    scale: float
    seed: int
    invalid: str = ""  # why the value is not run


def plan(parameters: list[Parameter]) -> list[PlannedRun]:
    """Return the runs with default settings, then each parameter with its smaller and its larger value."""
    runs = [PlannedRun(DEFAULTS, None, 1.0, seed) for seed in SEEDS]
    for parameter in parameters:
        for scale in SCALES:
            value = scaled(parameter.default, scale)
            runs.append(PlannedRun(parameter.name, value, scale, 0, invalid(parameter, value)))
    return runs


def chosen(part: Part, only: list[str] | None) -> list[Parameter]:
    """Return the parameters of a part, or those named in `only`, in that order.

    Raises:
        UserError: a name is unknown.
    """
    parameters = {parameter.name: parameter for parameter in parameters_of(part.settings)}
    for name in only or []:
        if name not in parameters:
            raise UserError(f"unknown parameter {name!r}; known are {', '.join(parameters)}")
    return [parameters[name] for name in only or parameters]


def read_rows(file: Path, setup: dict[str, Any]) -> list[Row]:
    """Return the finished rows of a JSON-lines file that have the values of `setup`; none if it is missing.

    An incomplete last line, of a run that was interrupted, is left out.
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
    """Make the runs that the file lacks, append each as one line of JSON, and return all rows of this setup.

    A row has the entries of `setup`, `parameter`, `value`, `scale`, `seed`, `duration_s`, and either
    `figures` (by name) or `error`: why the value was not run, or how the run failed.

    Args:
        run: prepares the runs; not called if all are finished.
        minutes: no run starts later than this after the first one.
        progress: receives the name of the parameter, and the numbers of finished and of all runs.
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
    """Return the figures of a run, or its error: no setting is checked before it is used."""
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
