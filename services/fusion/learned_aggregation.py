"""Learned aggregation: a small network corrects the label distribution of semi-global matching.

The network sees the cost volume, the distribution of semi-global matching, all candidate surfaces and the
image. It is trained by `beamsplat train aggregator` and runs on ONNX Runtime, on one thread without spinning.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.onnx_model import OnnxModel
from beamsplat.services.fusion.aggregation import SemiGlobalMatching, SweepEvidence, winner
from beamsplat.services.fusion.inputs import PlaneSweepConfig
from beamsplat.services.fusion.learned_inputs import (
    CHANNELS,
    INPUTS_VERSION,
    LABELS,
    OUTPUTS,
    AggregatorInputs,
    inputs_of,
)
from beamsplat.services.fusion.learned_kernels import decode_depth
from beamsplat.services.fusion.weights_file import TRAINED_BY, check_weights

METADATA_KEY = "beamsplat_aggregator_inputs"  # of the ONNX file; its value is the version of the inputs


class LearnedAggregation:
    """Aggregation by a network of `beamsplat train aggregator`.

    Raises:
        UserError: the weights file is missing, or it has another network, or another version of the inputs.
    """

    labels = LABELS
    uses_matching_cost = True
    states_whole_error = True

    def __init__(self, weights: Path) -> None:
        self._network = OnnxModel(
            check_weights(weights, "weights"), threads=1, providers=("CPUExecutionProvider",)
        )
        path, metadata = self._network.path, self._network.metadata
        if metadata.get(METADATA_KEY) != str(INPUTS_VERSION):
            found = metadata.get(METADATA_KEY)
            reason = f"version {found} of the inputs" if found else "no network for aggregation"
            raise UserError(f"{path}: has {reason}, expected version {INPUTS_VERSION}; {TRAINED_BY}")
        self._network.check_inputs(1)
        shape = self._network.inputs[0].shape
        outputs = self._network.outputs[0].shape
        if len(shape) != 4 or shape[1] != CHANNELS or len(outputs) != 4 or outputs[1] not in (OUTPUTS, None):
            raise UserError(
                f"{path}: input {shape} and output {outputs}; expected [1, {CHANNELS}, h, w] and "
                f"[1, {OUTPUTS}, h, w]; {TRAINED_BY}"
            )
        self._matching = SemiGlobalMatching()

    def solve(self, evidence: SweepEvidence, config: PlaneSweepConfig) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (m) and the standard deviation of log depth, float32 [h, w] each."""
        total = self._matching.total_cost(evidence, config)
        _, spread = winner(total, evidence.log_z, config.temperature)
        return self.depth_of(inputs_of(evidence, total, spread, config.temperature), evidence.log_z)

    def depth_of(self, inputs: AggregatorInputs, log_z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (m) and the standard deviation of log depth, float32 [h, w], from network inputs."""
        (output,) = self._network.run(inputs.features(log_z)[None])
        depth = np.empty(inputs.votes.shape, np.float32)
        spread = np.empty_like(depth)
        decode_depth(
            output[0], inputs.cost, inputs.energy, inputs.place(log_z), float(log_z[0]),
            float(log_z[1] - log_z[0]), depth, spread,
        )  # fmt: skip
        return depth, spread
