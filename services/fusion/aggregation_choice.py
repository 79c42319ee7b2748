"""Choice of the aggregation of a plane sweep by name; ONNX Runtime is loaded only for the learned one."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from beamsplat.common.errors import UserError
from beamsplat.services.fusion.aggregation import Aggregation
from beamsplat.services.fusion.weights_file import check_weights

AggregationName = Literal["sgm", "learned"]


def check_aggregation(name: AggregationName, weights: Path | None, method: str) -> None:
    """Check the options of the fusion service that choose the aggregation, without reading the weights.

    Raises:
        UserError: "learned" without an existing weights file, or with a method without a plane sweep.
    """
    if name == "sgm":
        return
    if method not in ("field", "poisson"):
        raise UserError(
            f'fusion.aggregation = "learned" has no effect with fusion.method = "{method}": set the method '
            'to "field", or the aggregation to "sgm"'
        )
    check_weights(weights, "fusion.aggregation_weights")


def make_aggregation(name: AggregationName, weights: Path | None, method: str) -> Aggregation | None:
    """Return the learned aggregation; None for "sgm", which is the default of `Fusion`.

    Raises:
        UserError: as `check_aggregation`; or the file has another network.
    """
    check_aggregation(name, weights, method)
    if name == "sgm" or weights is None:
        return None
    from beamsplat.services.fusion.learned_aggregation import LearnedAggregation

    return LearnedAggregation(weights)
