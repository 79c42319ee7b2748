"""Corrections of pose and exposure of keyframes, with their Adam state, in device memory.

The values are fields of `services.mapping.keyframe.StoredKeyframe`; the kernels of `mapping.cu` change them.
"""

from __future__ import annotations

import numpy as np
import torch

from beamsplat.common.raster.cuda.source import KEYFRAME_STATE, Kernels

# Name -> (first place, shape); the places are those of `mapping.cu`.
FIELDS: dict[str, tuple[int, tuple[int, ...]]] = {
    "delta": (0, (4, 4)), "pose_first": (16, (6,)), "pose_second": (22, (6,)), "pose_steps": (28, ()),
    "exposure": (29, (6,)), "exposure_first": (35, (6,)), "exposure_second": (41, (6,)),
    "exposure_steps": (47, ()),
}  # fmt: skip


class KeyframeStates:
    """One row of float64 values per keyframe; the caller assigns the rows."""

    def __init__(self, kernels: Kernels, rows: int) -> None:
        self.values = torch.zeros((rows, KEYFRAME_STATE), dtype=torch.float64, device=kernels.device)

    def write(self, rows: list[int], states: list[dict[str, np.ndarray]]) -> None:
        """Set rows to the values of keyframes; `states` are dictionaries with the names in `FIELDS`."""
        block = np.zeros((len(rows), KEYFRAME_STATE))
        for values, state in zip(block, states):
            for name, (first, shape) in FIELDS.items():
                values[first : first + int(np.prod(shape))] = np.ravel(state[name])
        self.values[torch.tensor(rows, device=self.values.device)] = torch.from_numpy(block).to(
            self.values.device
        )

    def read(self, rows: list[int]) -> list[dict[str, np.ndarray]]:
        """Return the values of rows as `write` takes them. Waits for the device."""
        block = self.values[torch.tensor(rows, device=self.values.device)].cpu().numpy()
        return [
            {
                name: values[first : first + int(np.prod(shape))].reshape(shape)
                for name, (first, shape) in FIELDS.items()
            }
            for values in block
        ]
