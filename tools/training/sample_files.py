"""Training samples on disk: network inputs of one image, its true depth, and its depth without network."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np
import zstandard

from beamsplat.common.errors import UserError
from beamsplat.services.fusion.learned_inputs import AggregatorInputs

Carrier = Literal["robot", "hand"]
SUFFIX = ".npz.zst"
_ARRAYS = tuple(f.name for f in fields(AggregatorInputs) if f.name not in ("views", "trust"))
_LEVEL = 1  # of the compression: 1.8 times smaller, and faster than a disk


@dataclass(frozen=True)
class TrainingSample:
    """One image of a simulated home, at the working size [h, w]."""

    inputs: AggregatorInputs
    truth_mm: np.ndarray  # uint16 [2h, 2w], true optical z in mm, 0 = none
    matched_log_depth: np.ndarray  # float16 [h, w], log depth (m) by semi-global matching
    carrier: Carrier


def save_sample(path: Path, sample: TrainingSample) -> None:
    """Write a sample to a file; its folder becomes visible only when it is complete."""
    buffer = io.BytesIO()
    arrays = {name: getattr(sample.inputs, name) for name in _ARRAYS}
    np.savez(
        buffer, **arrays, views=np.int64(sample.inputs.views), trust=np.float64(sample.inputs.trust),
        truth_mm=sample.truth_mm, matched_log_depth=sample.matched_log_depth,
        carrier=np.array(sample.carrier),
    )  # fmt: skip
    path.write_bytes(zstandard.compress(buffer.getvalue(), _LEVEL))


def load_sample(path: Path) -> TrainingSample:
    """Return the sample in a file.

    Raises:
        UserError: the file is missing, truncated or no sample.
    """
    try:
        data = zstandard.decompress(path.read_bytes())
        with np.load(io.BytesIO(data)) as table:
            inputs = AggregatorInputs(
                **{name: table[name] for name in _ARRAYS}, views=int(table["views"]),
                trust=float(table["trust"]),
            )  # fmt: skip
            carrier: Carrier = "robot" if str(table["carrier"]) == "robot" else "hand"
            return TrainingSample(inputs, table["truth_mm"], table["matched_log_depth"], carrier)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, zstandard.ZstdError) as error:
        raise UserError(
            f"{path}: not a complete training sample ({error}); remove its folder and run the command again, "
            "which generates that home anew"
        ) from error


def samples_in(folder: Path, carrier: Carrier) -> list[Path]:
    """Return the files of a carrier in the homes of a folder, in the order of their names."""
    return sorted(folder.glob(f"home_*/{carrier}_*{SUFFIX}"))
