"""Method `poisson`: the depth of a swept keyframe, completed with the gradients of its depth estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beamsplat.services.fusion.inputs import FusionInput, SweepResult
from beamsplat.services.fusion.poisson import complete, estimate_at_size


def completed_sweep(
    frame: FusionInput,
    swept: SweepResult,
    sigma_log: np.ndarray,  # float32 [h, w]: standard deviation of the log depth of `swept`
) -> tuple[SweepResult, np.ndarray]:
    """Return depth and standard deviation of log depth [h, w] after completion; all swept pixels measure.

    Without an estimate, or if the swept depth contradicts it, the arguments are returned.
    """
    if frame.estimate is None or frame.estimate_kind == "none":
        return swept, sigma_log
    h, w = swept.depth_m.shape
    small = estimate_at_size(frame.estimate, frame.estimate_kind, w, h)
    done = complete(small, frame.estimate_kind, swept.depth_m, sigma_log)
    return (swept, sigma_log) if done is None else (replace(swept, depth_m=done.depth_m), done.sigma_log)
