"""What fusion gives for one image, whatever the method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class FusionResult:
    """Metric depth with its error bar. With a status other than "ok" all depth is NaN: nothing to misuse."""

    depth_m: np.ndarray  # float32 [H, W] optical z, NaN = unknown
    sigma_m: np.ndarray  # float32 [H, W] standard deviation, NaN where depth is
    status: str = "ok"
    scale: float = float("nan")  # metres per unit of the estimate (alpha of the paper)
    scale_sigma: float = float("nan")  # its standard error
    inlier_share: float = 0.0  # of the pairs
    residual_m: float = float("nan")  # median |error| at the pairs after correction
    pairs: int = 0
    age_ns: int = 0  # image stamp minus that of the newest beams used

    @property
    def ok(self) -> bool:
        return self.status == "ok"

    def refused(self, why: str) -> FusionResult:
        """The same figures with a reason, and no depth."""
        empty = np.full(self.depth_m.shape, np.nan, dtype=np.float32)
        return replace(self, depth_m=empty, sigma_m=empty.copy(), status=why)


def rejected(shape: tuple[int, int], why: str) -> FusionResult:
    """A result without depth."""
    empty = np.full(shape, np.nan, dtype=np.float32)
    return FusionResult(empty, empty.copy(), status=why)
