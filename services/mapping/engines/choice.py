"""Which engine computes for the mapper of this machine."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from beamsplat.common.engines.choice import EngineName, reason_for_cpu

if TYPE_CHECKING:
    from beamsplat.services.mapping.engines.protocol import Engine

log = logging.getLogger("beamsplat.mapping")

OPTION = "mapping.engine"


def make_engine(
    name: EngineName, threads: int, gpu_memory_mb: float | None = None, sh_degree: int = 0
) -> Engine:
    """Create the engine called `name`; "auto" is the GPU where there is one, else the CPU.

    Args:
        threads: of the CPU engine.
        gpu_memory_mb: budget of the GPU's memory; None = no limit. No effect on the CPU engine.
        sh_degree: of the spherical harmonics of colours; 0 = none.

    Raises:
        UserError: "cuda" is asked for and cannot run here.
    """
    why = reason_for_cpu(name, OPTION)
    if why is not None:
        from beamsplat.services.mapping.engines.cpu import CpuEngine

        log.info("the map is computed on the CPU: %s", why)
        if gpu_memory_mb is not None:
            log.warning("mapping.gpu_memory_mb = %g has no effect without a GPU", gpu_memory_mb)
        return CpuEngine(threads, sh_degree)
    from beamsplat.common.raster.cuda.driver import CudaKernels
    from beamsplat.services.mapping.engines.cuda import CudaEngine

    budget_bytes = None if gpu_memory_mb is None else gpu_memory_mb * 1e6
    return CudaEngine(CudaKernels(), budget_bytes, sh_degree)
