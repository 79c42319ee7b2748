"""Which engine computes on this machine."""

from __future__ import annotations

import ctypes
import importlib.util
from typing import TYPE_CHECKING, Literal

from beamsplat.common.errors import UserError

if TYPE_CHECKING:
    from beamsplat.common.engines.protocol import SplatEngine

EngineName = Literal["auto", "cpu", "cuda"]


def cuda_obstacle() -> str | None:
    """Return the reason why an engine cannot compute on a GPU here, as one sentence; None if it can.

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


def check_cuda(option: str) -> None:
    """Check that the engine "cuda" can run here.

    Args:
        option: that asks for it, such as "mapping.engine".

    Raises:
        UserError: it cannot.
    """
    why = cuda_obstacle()
    if why is not None:
        raise UserError(f'{option} = "cuda": {why}; or set {option} = "auto"')


def reason_for_cpu(name: EngineName, option: str) -> str | None:
    """Return why the engine called `name` is that of the CPU; None if it is that of the GPU.

    Raises:
        UserError: "cuda" is asked for, by the option `option`, and cannot run here.
    """
    if name == "cpu":
        return "it is configured"
    if name == "cuda":
        check_cuda(option)
        return None
    return cuda_obstacle()


def make_splat_engine(name: EngineName, option: str) -> SplatEngine:
    """Create the engine called `name`; "auto" is the GPU where there is one, else the CPU with one thread.

    Raises:
        UserError: "cuda" is asked for, by the option `option`, and cannot run here.
    """
    if reason_for_cpu(name, option) is not None:
        from beamsplat.common.engines.cpu import CpuSplatEngine

        return CpuSplatEngine()
    from beamsplat.common.engines.cuda import CudaSplatEngine
    from beamsplat.common.raster.cuda.driver import CudaKernels

    return CudaSplatEngine(CudaKernels())
