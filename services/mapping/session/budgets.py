"""The budgets of the mapper's memory: what they must be, and what Gaussians may take of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beamsplat.common.errors import UserError

# Memory of the process that is not counted here, measured live: 270 MB at the start, then caches of the bus,
# waiting keyframes, and memory that the allocator does not return.
PROCESS_MB = 400.0
PAGE_OUT_ABOVE, PAGE_OUT_TO = 0.6, 0.5  # of the free budget, for Gaussians (hysteresis)
# Where the newest keyframes observe more than the share above: page out only above this multiple of it.
_SPARE = 1.25


@dataclass(frozen=True)
class MemoryRoom:
    """What Gaussians may take of one memory that has a budget, in bytes."""

    free: float  # the budget without what paging cannot free
    each: int  # of one Gaussian
    most: float  # for Gaussians, with the fewest possible keyframes

    def is_full(self, count: int, needed: int) -> bool:
        """Return whether Gaussians must be paged out: `count` are in memory, `needed` must stay."""
        needed_bytes = min(_SPARE * needed * self.each, self.most)
        return count * self.each > max(PAGE_OUT_ABOVE * self.free, needed_bytes)


def check_budget(memory_mb: float, session: Path | None) -> None:
    """Check the configured memory budget, independently of the map.

    Raises:
        UserError: no session folder is configured, to which data can be paged out, or the budget is smaller
            than the memory of the process without a map.
    """
    if session is None:
        raise UserError(
            "mapping.memory_mb: paging writes to the folder of the session; give mapping.session too"
        )
    if memory_mb <= PROCESS_MB:
        raise UserError(
            f"mapping.memory_mb = {memory_mb:g}: the process itself takes {PROCESS_MB:g} MB; give at least "
            f"{PROCESS_MB + 100:g}"
        )


def check_gpu_budget(engine: str, session: Path | None) -> None:
    """Check that a budget of GPU memory can be kept.

    Raises:
        UserError: no session folder is configured, to which data can be paged out, or the engine is "cpu".
    """
    if session is None:
        raise UserError(
            "mapping.gpu_memory_mb: paging writes to the folder of the session; give mapping.session too"
        )
    if engine == "cpu":
        raise UserError(
            'mapping.gpu_memory_mb: mapping.engine = "cpu" uses no GPU; set it to "auto" or "cuda", or give '
            "mapping.memory_mb instead"
        )
