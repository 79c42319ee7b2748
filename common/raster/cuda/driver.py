"""Loads compiled kernels and launches them on torch's current stream, through the CUDA driver."""

from __future__ import annotations

import ctypes
import threading

import torch

from beamsplat.common.errors import UserError
from beamsplat.common.raster.cuda.rtc import Nvrtc, compiled, nvrtc
from beamsplat.common.raster.cuda.source import KernelSource, kernel_source

_LIBRARY = "libcuda.so.1"


def cuda_fault() -> str | None:
    """Return the reason why this machine cannot run the kernels, as one sentence; None if it can."""
    if torch.version.cuda is None:
        return (
            f"torch {torch.__version__} is built without CUDA: pip install --force-reinstall torch, "
            "from an index that has it with CUDA"
        )
    if not torch.cuda.is_available():
        return "no NVIDIA GPU with a running driver was found: `nvidia-smi` must show it; or use the CPU"
    try:
        ctypes.CDLL(_LIBRARY)
        nvrtc().architecture(torch.cuda.get_device_capability())
    except OSError:
        return f"{_LIBRARY} of the NVIDIA driver cannot be loaded: install the driver, or use the CPU"
    except UserError as error:
        return str(error)
    return None


class CudaKernels:
    """The kernels on a GPU, compiled for it.

    Args:
        tile: side of the rasterizer's tiles, px.
        device: index of the GPU.

    Raises:
        UserError: the GPU, its driver, torch with CUDA or NVRTC is missing.
    """

    def __init__(self, tile: int = 8, device: int = 0) -> None:
        why = cuda_fault()
        if why is not None:
            raise UserError(f"the CUDA rasterizer cannot run: {why}")
        self.device = torch.device("cuda", device)
        self.source: KernelSource = kernel_source(tile)
        torch.zeros(1, device=self.device)  # creates torch's context, which the driver calls use
        self._cuda = ctypes.CDLL(_LIBRARY)
        self._context = ctypes.c_void_p()
        self._thread = threading.local()
        with torch.cuda.device(self.device):
            capability = torch.cuda.get_device_capability(self.device)
            compiler: Nvrtc = nvrtc()
            self._check(self._cuda.cuCtxGetCurrent(ctypes.byref(self._context)), "find torch's context")
            self._module = ctypes.c_void_p()
            code = compiled(self.source, capability, compiler)
            self._check(self._cuda.cuModuleLoadData(ctypes.byref(self._module), code), "load its kernels")
        self._functions: dict[str, ctypes.c_void_p] = {}
        for name in self.source.kernels:
            function = ctypes.c_void_p()
            self._check(
                self._cuda.cuModuleGetFunction(ctypes.byref(function), self._module, name.encode()),
                f"find its kernel {name}",
            )
            self._functions[name] = function
        architecture = compiler.architecture(capability)
        self.description = f"{torch.cuda.get_device_name(self.device)}, {architecture}, NVRTC {compiler.name}"

    def launch(self, name: str, blocks: int, arguments: ctypes.Structure) -> None:
        """Start a kernel on torch's current stream, without waiting; a CUDA graph in capture records it."""
        if not getattr(self._thread, "ready", False):  # a thread's first launch: the driver needs the context
            self._check(self._cuda.cuCtxSetCurrent(self._context), "use torch's context")
            self._thread.ready = True
        structure, threads = self.source.kernels[name]
        assert type(arguments).__name__ == structure
        values = (ctypes.c_void_p * 1)(ctypes.addressof(arguments))
        stream = ctypes.c_void_p(torch.cuda.current_stream(self.device).cuda_stream)
        code = self._cuda.cuLaunchKernel(
            self._functions[name], blocks, 1, 1, threads, 1, 1, 0, stream, values, None
        )  # fmt: skip
        self._check(code, f"start the kernel {name}")

    def _check(self, code: int, what: str) -> None:
        if code:
            text = ctypes.c_char_p()
            self._cuda.cuGetErrorString(code, ctypes.byref(text))
            reason = (text.value or b"unknown error").decode()
            raise UserError(
                f"the CUDA rasterizer cannot {what}: {reason} (error {code} of the NVIDIA driver); "
                "update the driver, or use the CPU"
            )
