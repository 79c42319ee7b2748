"""The targets of keyframes on the device, within a budget of memory: the least recently used ones leave."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import numpy as np
import torch

from beamsplat.common.raster.cuda.source import Kernels


class TargetCache:
    """Blocks of `pack_targets` by key, such as (keyframe, size).

    With CUDA, a block that is missing is copied on a stream of its own, from pinned memory: steps that were
    launched before go on meanwhile. So ask for the blocks of the next steps ahead.

    Args:
        kernels: on the device of the blocks.
        budget_bytes: memory of all blocks; the one in use may exceed it.
    """

    def __init__(self, kernels: Kernels, budget_bytes: int) -> None:
        self.budget_bytes = budget_bytes
        self.held_bytes = 0
        self._device = kernels.device
        self._blocks: dict[Hashable, torch.Tensor] = {}  # the least recently used one first
        self._copies = torch.cuda.Stream(kernels.device) if kernels.device.type == "cuda" else None

    def get(self, key: Hashable, pack: Callable[[], np.ndarray]) -> torch.Tensor:
        """Return a block uint8 [bytes] on the device; `pack` makes it if it is not there."""
        block = self._blocks.pop(key, None)
        if block is None:
            block = self._uploaded(torch.from_numpy(pack()))
            self.held_bytes += block.nbytes
        self._blocks[key] = block
        while self.held_bytes > self.budget_bytes and len(self._blocks) > 1:
            self.held_bytes -= self._blocks.pop(next(iter(self._blocks))).nbytes
        return block

    def forget(self, key: Hashable) -> None:
        """Free a block, if it is there."""
        block = self._blocks.pop(key, None)
        if block is not None:
            self.held_bytes -= block.nbytes

    def _uploaded(self, block: torch.Tensor) -> torch.Tensor:
        if self._copies is None:
            return block.to(self._device)
        current = torch.cuda.current_stream(self._device)
        with torch.cuda.stream(self._copies):
            out = block.pin_memory().to(self._device, non_blocking=True)
        current.wait_stream(self._copies)
        out.record_stream(current)  # its memory is not used again before the steps that read it have ended
        return out
