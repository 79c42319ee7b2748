"""Which engine computes for the mapper of this machine."""

from __future__ import annotations

import ctypes
import importlib.util
import logging
from typing import TYPE_CHECKING

from beamsplat.common.errors import UserError
from beamsplat.services.mapping.config import EngineName

if TYPE_CHECKING:
    from beamsplat.services.mapping.engines.protocol import Engine

log = logging.getLogger("beamsplat.mapping")


def cuda_obstacle() -> str | None:
    """Return the reason why the mapper cannot compute on a GPU here, as one sentence; None if it can.

    Asks the driver first: without a GPU, torch is not imported.
    """
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "there is no NVIDIA driver (libcuda.so.1)"
    count = ctypes.c_int(0)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)) or count.value == 0:
        return "the NVIDIA driver finds no GPU: `nvidia-smi` must show it"
    if importlib.util.find_spec("torch") is None:
        return "torch is not installed: pip install 'beamsplat[gpu]'"
    from beamsplat.common.raster.cuda.driver import cuda_fault

    return cuda_fault()


def check_cuda() -> None:
    """Check that the engine "cuda" can run here.

    Raises:
        UserError: it cannot.
    """
    why = cuda_obstacle()
    if why is not None:
        raise UserError(_refusal(why))


def _refusal(why: str) -> str:
    return f'mapping.engine = "cuda": {why}; or set mapping.engine = "auto"'


def make_engine(name: EngineName, threads: int) -> Engine:
    """Create the engine called `name`; "auto" is the GPU where there is one, else the CPU.

    Args:
        threads: of the CPU engine.

    Raises:
        UserError: "cuda" is asked for and cannot run here.
    """
    why = "it is configured" if name == "cpu" else cuda_obstacle()
    if why is not None:
        if name == "cuda":
            raise UserError(_refusal(why))
        from beamsplat.services.mapping.engines.cpu import CpuEngine

        log.info("the map is computed on the CPU: %s", why)
        return CpuEngine(threads)
    from beamsplat.common.raster.cuda.driver import CudaKernels
    from beamsplat.services.mapping.engines.cuda import CudaEngine

    return CudaEngine(CudaKernels())
