"""`bench uncertainties`: stated standard deviations agree with the true errors of simulated drives."""

import numpy as np
import pytest

from beamsplat.tools.bench.depth_uncertainties import BANDS_M, DEPTHS
from beamsplat.tools.bench.uncertainties import MOTION, StatedErrors, bench_uncertainties
from beamsplat.tools.simulator.recording import simulate
from beamsplat.tools.simulator.settings import CameraSettings, Faults, SimulationSettings

# Seeds that were not used to choose the errors common to a drive.
SEEDS = (104, 105, 106)
CALIBRATED = ("clock", "roll", "pitch", "yaw")


def test_the_normalised_error_is_the_rms_of_error_by_sigma():
    row = StatedErrors(np.array([1e-3, -2e-3]), np.array([1e-3, 1e-3])).row("x", "mm", 1e3)
    assert row["rms_error"] == pytest.approx(2.5**0.5)
    assert row["normalised_error"] == pytest.approx(2.5**0.5)
    assert row["mean_sigma"] == pytest.approx(1.0)


@pytest.mark.slow
def test_normalised_errors_of_a_simulated_deck_are_between_07_and_15(tmp_path):
    for seed in SEEDS:
        settings = SimulationSettings(
            seed=seed, seconds=60.0, extra_views=0, surface_points=1000,
            camera=CameraSettings(width_px=320, height_px=240, rate_hz=4.0),
            faults=Faults(clock_offset_ms=15.0, extrinsic_yaw_deg=0.5),
        )  # fmt: skip
        simulate(settings, tmp_path / str(seed), jobs=2, replace=False, progress=lambda *_: None)
    rows = {row["quantity"]: row for row in bench_uncertainties(tmp_path, lambda _: None)}
    for quantity in MOTION:
        assert 0.7 < rows[quantity]["normalised_error"] < 1.5, rows[quantity]
    checks = [f"{check} {name}" for check in ("camera", "start-up check,") for name in CALIBRATED]
    for quantity in checks:
        row = rows[quantity]
        assert row["samples"] == len(SEEDS)
        # Three samples: 95 % of honest statements have a normalised error between 0.27 and 1.77.
        assert 0.7 * 0.27 < row["normalised_error"] < 1.5 * 1.77, row
    depths = [row for quantity, row in rows.items() if quantity.startswith("depth of")]
    assert len(depths) == len(DEPTHS) * len(BANDS_M)
    for row in depths:
        # Three homes have few places with gross errors, so that a band of one deck may be a third lower.
        assert 0.45 < row["normalised_error"] < 1.5, row
