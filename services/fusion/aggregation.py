"""Aggregation of the cost volume: from the evidence of a plane sweep to one depth per pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from beamsplat.services.fusion import volume_kernels as kernels
from beamsplat.services.fusion.inputs import PlaneSweepConfig, WorkingImage
from beamsplat.services.fusion.keyframe_depth import WarpedDepth
from beamsplat.services.fusion.surfaces import CandidateSurfaces


@dataclass(frozen=True)
class SweepEvidence:
    """All evidence for the depth of one keyframe, at the working size [h, w] with D depth labels."""

    cost: np.ndarray  # float32 [h, w, D]: matching cost, lowered by the priors
    matching_cost: np.ndarray | None  # uint8 [h, w, D]: without priors, quantised; if the method uses it
    log_z: np.ndarray  # float64 [D]
    working: WorkingImage
    image_rgb: np.ndarray  # uint8 [H, W, 3]
    surfaces: CandidateSurfaces
    warped: WarpedDepth | None  # depth of past keyframes; None if there are none
    estimate_m: np.ndarray | None  # float32 [h, w]: estimate of the depth source, scaled to metres
    estimate_trust: float  # weight of the estimate in [0, 1]
    rise: np.ndarray  # float64 [h, w]: upward part of the rays in the body frame; 0 if that is not known
    views: int  # source images of the sweep


class Aggregation(Protocol):
    """Interface of a method that turns the evidence of a plane sweep into depth."""

    @property
    def labels(self) -> int | None:
        """Number of depth labels that the method requires; None: any."""
        ...

    @property
    def uses_matching_cost(self) -> bool:
        """Whether `SweepEvidence.matching_cost` is required."""
        ...

    @property
    def states_whole_error(self) -> bool:
        """Whether the spread is the standard deviation of the error, also at depth edges."""
        ...

    def solve(self, evidence: SweepEvidence, config: PlaneSweepConfig) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (m) and spread (standard deviation of log depth), float32 [h, w] each."""
        ...


class SemiGlobalMatching:
    """Aggregation along four image directions (Hirschmueller 2008); the label of the lowest cost wins."""

    labels = None
    uses_matching_cost = False
    states_whole_error = False

    def solve(self, evidence: SweepEvidence, config: PlaneSweepConfig) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (m) and spread of the labels about it (log depth), float32 [h, w] each."""
        return winner(self.total_cost(evidence, config), evidence.log_z, config.temperature)

    def total_cost(self, evidence: SweepEvidence, config: PlaneSweepConfig) -> np.ndarray:
        """Return the sum of the path costs of all directions, float32 [h, w, D]."""
        total = np.zeros_like(evidence.cost)
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            kernels.aggregate(
                evidence.cost, evidence.working.grey, dv, du, config.p1, config.p2, config.edge_grey, total
            )
        return total


def winner(total: np.ndarray, log_z: np.ndarray, temperature: float) -> tuple[np.ndarray, np.ndarray]:
    """Return depth (m) of the cheapest labels and the spread about it (log depth), float32 [h, w] each.

    `total` float32 [h, w, D] are the costs, `temperature` scales them to -log probability.
    """
    depth = np.empty(total.shape[:2], np.float32)
    spread = np.empty_like(depth)
    kernels.winner_takes_all(total, log_z, temperature, depth, spread)
    return depth, spread
