"""Long drives under a budget: memory stays, time per keyframe stays, old rooms are still there."""

import numpy as np
import pytest

from services.mapping.session.paging import PROCESS_MB
from tests.services.mapping.home_drive import home
from tests.services.mapping.long_drive import lap_of, samples

PERIOD_S = 0.6  # 100 keyframes a minute
HALF_HOUR = 3000  # keyframes


@pytest.mark.soak
def test_four_hours_at_a_hundred_keyframes_a_minute(tmp_path):
    """24 000 keyframes of a small camera: the same memory and the same time for each, from the first half-hour on."""
    seen, budget_mb = home(64, 100), PROCESS_MB + 10.0
    options = {
        "memory_mb": budget_mb, "max_keyframes": 400, "half_steps": 1, "full_steps": 1, "session_every_s": 60.0,
        "max_gaussians": 12_000,
    }  # fmt: skip
    steps = samples(
        lap_of(seen, 10), tmp_path / "s", options, 8 * HALF_HOUR, HALF_HOUR, PERIOD_S, [], seen.camera
    )
    print(f"\nbefore the first keyframe {next(steps):.0f} MB, budget {budget_mb:.0f} MB")
    rows = []
    for sample in steps:
        rows.append((sample.pss_mb, sample.ms_a_keyframe, sample.disk_mb))
        print(f"{sample.keyframes:6d} keyframes: PSS {sample.pss_mb:.1f} MB (accounted {sample.accounted_mb:.1f}), "
              f"{sample.ms_a_keyframe:.1f} ms, {sample.gaussians} Gaussians ({sample.on_disk} on disk), "
              f"session {sample.disk_mb:.1f} MB; {sample.detail}", flush=True)  # fmt: skip
    pss_mb, ms, disk_mb = np.array(rows).T
    hours = 0.5 * np.arange(1, len(rows) + 1)
    slopes = [np.polyfit(hours[1:], column[1:], 1)[0] for column in (pss_mb, ms)]
    print(f"after the first half-hour: {slopes[0]:+.2f} MB and {slopes[1]:+.2f} ms a keyframe each hour")
    assert pss_mb.max() <= budget_mb
    assert np.ptp(pss_mb[1:]) < 15.0
    assert ms[1:].max() < 1.3 * ms[1:].min()
    assert np.ptp(disk_mb[1:]) < 0.1 * disk_mb.max()
