"""Semi-global matching that also keeps what the network would see: the source of training samples."""

from __future__ import annotations

import numpy as np

from beamsplat.services.fusion.aggregation import SemiGlobalMatching, SweepEvidence, winner
from beamsplat.services.fusion.inputs import PlaneSweepConfig
from beamsplat.services.fusion.learned_inputs import LABELS, AggregatorInputs, inputs_of


class RecordingAggregation:
    """Aggregation by semi-global matching that stores the network inputs of the newest keyframe."""

    labels = LABELS
    uses_matching_cost = True
    states_whole_error = False

    def __init__(self) -> None:
        self._matching = SemiGlobalMatching()
        self.inputs: AggregatorInputs | None = None
        self.depth_m: np.ndarray | None = None  # float32 [h, w], before snapping

    def solve(self, evidence: SweepEvidence, config: PlaneSweepConfig) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (m) and spread as `SemiGlobalMatching`, and store the network inputs."""
        total = self._matching.total_cost(evidence, config)
        depth, spread = winner(total, evidence.log_z, config.temperature)
        self.inputs = inputs_of(evidence, total, spread, config.temperature)
        self.depth_m = depth.copy()
        return depth, spread
