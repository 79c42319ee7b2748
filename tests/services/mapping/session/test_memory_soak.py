"""Long drives under a budget: memory stays, time per keyframe stays, old rooms are still there."""

import numpy as np
import pytest

from beamsplat.services.mapping.session.budgets import PROCESS_MB
from tests.services.mapping.home_drive import home, psnr_db
from tests.services.mapping.long_drive import lap_of, samples

PERIOD_S = 0.6  # 100 keyframes a minute
HALF_HOUR = 3000  # keyframes


@pytest.mark.soak
def test_four_hours_at_a_hundred_keyframes_a_minute(tmp_path):
    """24 000 keyframes of a small camera: the same memory from the first half-hour on; the time for each is
    printed.
    """
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
        rows.append((sample.pss_mb, sample.private_mb, sample.ms_a_keyframe, sample.disk_mb))
        print(f"{sample.keyframes:6d} keyframes: PSS {sample.pss_mb:.1f} MB, {sample.private_mb:.1f} of them private "
              f"(accounted {sample.accounted_mb:.1f}), "
              f"{sample.ms_a_keyframe:.1f} ms, {sample.gaussians} Gaussians ({sample.on_disk} on disk), "
              f"session {sample.disk_mb:.1f} MB; {sample.detail}", flush=True)  # fmt: skip
    pss_mb, private_mb, ms, disk_mb = np.array(rows).T
    hours = 0.5 * np.arange(1, len(rows) + 1)
    slopes = [np.polyfit(hours[1:], column[1:], 1)[0] for column in (private_mb, ms)]
    print(
        f"after the first half-hour: {slopes[0]:+.2f} MB private and {slopes[1]:+.2f} ms a keyframe each hour"
    )
    assert pss_mb.max() <= budget_mb
    assert np.ptp(private_mb[1:]) < 15.0
    assert np.ptp(disk_mb[1:]) < 0.1 * disk_mb.max()


@pytest.mark.soak
@pytest.mark.parametrize("budget_mb", [1000.0, PROCESS_MB + 35.0], ids=["1GB", "tight"])
def test_ten_laps_under_a_budget(tmp_path, budget_mb):
    """The process stays within its budget lap after lap, and the rooms of the first lap look as good after
    the last: where everything fits, and where most keyframes and Gaussians lie on the disk.
    """
    seen, a_lap = home(240, 40), 40
    views = list(range(3, a_lap, 6))
    options = {"memory_mb": budget_mb, "session_every_s": 30.0, "half_steps": 8, "full_steps": 3}
    laps = samples(lap_of(seen, 10), tmp_path / "s", options, 10 * a_lap, a_lap, PERIOD_S, views, seen.camera)
    print(f"\nbefore the first keyframe {next(laps):.0f} MB, budget {budget_mb:.0f} MB")
    truth = [seen.rgb(view).transpose(2, 0, 1) / 255.0 for view in views]
    pss_mb, dB = [], []
    for lap, sample in enumerate(laps, start=1):
        pss_mb.append(sample.pss_mb)
        dB.append([psnr_db(image.astype(np.float64), true) for image, true in zip(sample.renders, truth)])
        print(f"lap {lap}: PSS {sample.pss_mb:.0f} MB (accounted {sample.accounted_mb:.0f}), {sample.ms_a_keyframe:.0f} "
              f"ms a keyframe, first rooms {np.mean(dB[-1]):.2f} dB (worst {min(dB[-1]):.2f}); {sample.detail}",
              flush=True)  # fmt: skip
    assert max(pss_mb) <= budget_mb
    assert max(pss_mb[5:]) < max(pss_mb[:5]) + 0.1 * budget_mb
    assert np.mean(dB[-1]) > np.mean(dB[0])
    assert min(np.array(dB[-1]) - np.array(dB[0])) > -1.0
