"""`bench sensitivity`: parameters and their comments, runs that are repeated or not, the table, real effects."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from beamsplat.common.errors import UserError
from beamsplat.tools.bench.parameters import invalid, parameters_of, scaled, with_value
from beamsplat.tools.bench.sensitivity import DEFAULTS, SCALES, SEEDS, chosen, measure, plan
from beamsplat.tools.bench.sensitivity_parts import PARTS, Figure, Part
from beamsplat.tools.bench.sensitivity_table import as_json, effects, markdown, write_page

SETUP = {"part": "toy", "data": "somewhere", "seconds": 1.0}


@dataclass(frozen=True)
class InnerSettings:
    rate: float = 0.5  # step size


@dataclass(frozen=True)
class ToySettings:
    """Settings of the synthetic algorithm below."""

    # Group
    noise_m: float = 0.2  # sigma of a | b

    cells: int = 2
    min_inlier_ratio: float = 0.9  # above it, accepted
    votes: int = 0  # 0 = never
    fragile_px: int = 10
    unused_s: float = 3.0
    flag: bool = True
    sizes_m: tuple[float, ...] = (1.0, 2.0)
    inner: InnerSettings = field(default_factory=InnerSettings)


class ToyRun:
    """An error that grows with `noise_m` and falls with `inner.rate`, with a spread of 1 % over the seeds."""

    def __init__(self):
        self.calls = []

    def __call__(self, settings, seed):
        self.calls.append((settings, seed))
        if settings.fragile_px > 10:
            raise ValueError("too | many pixels")
        error_m = settings.noise_m * (1.0 + 0.005 * seed) / settings.inner.rate
        return {"error_m": error_m, "cost_s": float(settings.cells), "unlisted": 1.0}


TOY = Part(
    ToySettings(), (Figure("error_m", "error"), Figure("cost_s", "cost", quality=False)), 1.0,
    lambda data, seconds: ToyRun(), "3 seeds",
)  # fmt: skip


def test_parameters_are_numbers_with_unit_and_comment():
    parameters = {p.name: p for p in parameters_of(ToySettings())}
    assert list(parameters) == [
        "noise_m", "cells", "min_inlier_ratio", "votes", "fragile_px", "unused_s", "inner.rate",
    ]  # fmt: skip
    assert (parameters["noise_m"].unit, parameters["noise_m"].meaning) == ("m", "sigma of a | b")
    assert (parameters["cells"].unit, parameters["cells"].meaning) == ("", "")
    assert parameters["inner.rate"].meaning == "step size"
    assert with_value(ToySettings(), "inner.rate", 0.7) == ToySettings(inner=InnerSettings(0.7))


def test_integers_change_by_at_least_one():
    assert [scaled(2, scale) for scale in SCALES] == [1, 3]
    assert [scaled(1, scale) for scale in SCALES] == [0, 2]
    assert [scaled(100, scale) for scale in SCALES] == [70, 130]
    assert [scaled(0.03, scale) for scale in SCALES] == [0.021, 0.039]


def test_values_without_a_meaning_are_invalid():
    parameters = {p.name: p for p in parameters_of(ToySettings())}
    assert invalid(parameters["votes"], -1) == "negative"
    assert invalid(parameters["min_inlier_ratio"], 1.17) == "above 1"
    assert invalid(parameters["unused_s"], 3.0)
    assert invalid(parameters["unused_s"], float("inf"))
    assert not invalid(parameters["votes"], 1)


@pytest.mark.parametrize("name", PARTS)
def test_every_setting_has_a_meaning(name):
    for parameter in parameters_of(PARTS[name].settings):
        assert parameter.meaning, f"{parameter.name}: no comment at its line"


def test_finished_runs_are_not_repeated(tmp_path):
    run, file = ToyRun(), tmp_path / "out" / "rows.jsonl"
    cells = chosen(TOY, ["cells"])
    rows = measure(TOY, lambda: run, cells, file, SETUP)
    assert [(row["parameter"], row["value"], row["seed"]) for row in rows] == [
        *((DEFAULTS, None, seed) for seed in SEEDS), ("cells", 1, 0), ("cells", 3, 0),
    ]  # fmt: skip
    assert len(run.calls) == 5

    with file.open("a") as stream:
        stream.write('{"part": "toy", "da')  # the process was stopped here
    assert measure(TOY, lambda: pytest.fail("prepared in vain"), cells, file, SETUP) == rows
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    again = measure(TOY, lambda: run, chosen(TOY, ["noise_m", "cells"]), file, SETUP)
    assert len(run.calls) == 7
    assert len(again) == 7
    other = measure(TOY, lambda: run, cells, file, {**SETUP, "seconds": 2.0})
    assert len(other) == 5


def test_no_run_starts_after_the_time_limit(tmp_path):
    run = ToyRun()
    assert measure(TOY, lambda: run, chosen(TOY, None), tmp_path / "rows.jsonl", SETUP, minutes=-1.0) == []
    with pytest.raises(UserError, match="default settings"):
        effects(TOY, chosen(TOY, None), [])


def test_unknown_parameters_are_named():
    with pytest.raises(UserError, match=r"'noise'.*noise_m"):
        chosen(TOY, ["noise"])


def test_the_table_has_a_row_for_each_parameter_largest_effect_first(tmp_path):
    parameters = chosen(TOY, None)
    only = [p for p in parameters if p.name != "unused_s"]
    rows = measure(TOY, ToyRun, only, tmp_path / "rows.jsonl", SETUP)
    found = effects(TOY, parameters, rows)
    assert [effect.parameter.name for effect in found][:3] == ["inner.rate", "noise_m", "cells"]
    assert found[1].changes[0]["error_m"] == pytest.approx(-0.3)
    assert found[1].changes[1]["error_m"] == pytest.approx(0.3)

    text = markdown(TOY, parameters, rows, "the command", "today")
    assert "error 0.4 (spread 1.0 %)" in text
    assert "| `noise_m` | 0.2 | m | sigma of a \\| b | 0.14 | 0.26 | **-30.0** / **+30.0** | 0 / 0 |" in text
    assert "| `votes` | 0 |  | 0 = never | -1 (invalid: negative) | 1 | – / 0 | – / 0 |" in text
    assert "13 (invalid: ValueError: too \\| many pixels)" in text
    assert "Not measured: `unused_s`." in text
    assert "| `unused_s`" not in text

    result = as_json(TOY, parameters, rows, SETUP)
    assert result["default"]["error_m"] == pytest.approx(0.4)
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_times_are_compared_with_all_runs_that_the_parameter_did_not_affect():
    figures = (Figure("error_m", "error"), Figure("cpu_s", "CPU", quality=False, timed=True))
    part = Part(ToySettings(), figures, 1.0, TOY.open, "3 seeds")
    parameters = [p for p in parameters_of(part.settings) if p.name in ("cells", "unused_s")]
    runs = [
        (DEFAULTS, 1.0, 0, 1.00, 2.0), (DEFAULTS, 1.0, 1, 1.01, 2.2), (DEFAULTS, 1.0, 2, 1.02, 2.1),
        ("unused_s", 0.7, 0, 1.00, 1.9), ("unused_s", 1.3, 0, 1.00, 1.8),
        ("cells", 0.7, 0, 1.50, 2.2), ("cells", 1.3, 0, 0.90, 4.0),
    ]  # fmt: skip
    rows = [
        {"parameter": name, "value": 1, "scale": scale, "seed": seed,
         "figures": {"error_m": error_m, "cpu_s": cpu_s}}
        for name, scale, seed, error_m, cpu_s in runs
    ]  # fmt: skip
    assert as_json(part, parameters, rows, SETUP)["default"] == {"error_m": 1.0, "cpu_s": 2.0}
    text = markdown(part, parameters, rows, "the command", "today")
    assert "**+50.0** / **-10.0** | +10.0 / **+100.0** |" in text
    assert "| 0 / 0 | -5.0 / -10.0 |" in text


def test_parts_are_written_between_their_marks(tmp_path):
    page = tmp_path / "docs" / "parameters.md"
    write_page(page, "map", "table of the mapper")
    write_page(page, "slam", "old table")
    write_page(page, "slam", "table of the SLAM")
    text = page.read_text()
    assert text.startswith("# Parameters")
    assert text.index("table of the SLAM") < text.index("table of the mapper")
    assert "old table" not in text


def test_a_lower_limit_of_sigma_lowers_the_coverage_of_the_house(shared_dir, tmp_path):
    part = PARTS["fusion"]
    house = shared_dir / "data" / "house_a"
    parameters = chosen(part, ["max_sigma_m"])
    rows = measure(
        part, lambda: part.open(house, 2.0), parameters, tmp_path / "rows.jsonl", {"part": "fusion"}
    )
    lower, higher = effects(part, parameters, rows)[0].changes
    assert lower["coverage"] < 0.0 < higher["coverage"]
    assert plan(parameters)[-1].value == pytest.approx(1.235)
    assert Path(tmp_path / "rows.jsonl").read_text().count("\n") == 5
