"""Result of fusion for one image, the same type for every method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class FusionResult:
    """Metric depth of one image with its standard deviation. All depth is NaN unless `status` is "ok"."""

    depth_m: np.ndarray  # float32 [H, W] optical z, NaN = unknown
    sigma_m: np.ndarray  # float32 [H, W] standard deviation with gross errors, NaN where depth is NaN
    status: str = "ok"  # else the reason why there is no depth
    scale: float = float("nan")  # metres per unit of the depth estimate (alpha of the paper)
    scale_sigma: float = float("nan")  # its standard deviation, as the scale of the whole image
    inlier_share: float = 0.0  # share of the pairs that agree with the result
    residual_m: float = float("nan")  # median |error| at the pairs after correction
    pairs: int = 0

    @property
    def ok(self) -> bool:
        return self.status == "ok"

    def as_rejected(self, why: str) -> FusionResult:
        """Return a copy without depth, whose status is `why`."""
        empty = np.full(self.depth_m.shape, np.nan, dtype=np.float32)
        return replace(self, depth_m=empty, sigma_m=empty.copy(), status=why)


def rejected(shape: tuple[int, int], why: str) -> FusionResult:
    """Return a result of size (height, width) without depth, whose status is `why`."""
    empty = np.full(shape, np.nan, dtype=np.float32)
    return FusionResult(empty, empty.copy(), status=why)
