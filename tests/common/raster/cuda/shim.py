"""The CUDA kernels on the CPU: the same source through g++ and `shim.h`.

With BEAMSPLAT_CUDA_TESTS=gpu, the tests run on the GPU instead, with wider tolerances: its fast functions are less
accurate.
"""

import contextlib
import ctypes
import fcntl
import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
import torch

from beamsplat.common.raster.cuda.driver import CudaKernels
from beamsplat.common.raster.cuda.source import KernelSource, kernel_source
from beamsplat.services.mapping.renderers.cuda import CudaRenderer

OPTIONS = ("-O2", "-std=c++17", "-fPIC", "-shared", "-ffp-contract=off", "-U_FORTIFY_SOURCE", "-w")
HEADER = Path(__file__).with_name("shim.h")

ON_GPU = os.environ.get("BEAMSPLAT_CUDA_TESTS") == "gpu"
LOOSE = 30.0 if ON_GPU else 1.0  # factor of tolerances

needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None, reason="needs g++, which compiles the CUDA kernels for the CPU"
)
needs_kernels = pytest.mark.skipif(
    shutil.which("g++") is None and not ON_GPU,
    reason="needs g++, which compiles the CUDA kernels for the CPU",
)


class ShimKernels:
    """The kernels as a library of the CPU."""

    def __init__(self, tile):
        self.device = torch.device("cpu")
        self.source = kernel_source(tile)
        self.description = "CPU build"
        self._library = ctypes.CDLL(str(_built(self.source)))
        for name, structure in self.source.structures.items():
            assert getattr(self._library, f"size_of_{name}")() == ctypes.sizeof(structure), name

    def launch(self, name, blocks, arguments):
        assert type(arguments).__name__ == self.source.kernels[name][0]
        getattr(self._library, f"launch_{name}")(blocks, ctypes.byref(arguments))

    @contextlib.contextmanager
    def backwards(self):
        """Run threads and blocks in reverse order: a race between threads changes the results."""
        self._library.run_backwards(1)
        try:
            yield
        finally:
            self._library.run_backwards(0)


@functools.cache
def shim_kernels(tile=8):
    return ShimKernels(tile)


@functools.cache
def kernels_under_test(tile=8):
    return CudaKernels(tile) if ON_GPU else shim_kernels(tile)


class ShimRenderer(CudaRenderer):
    """The renderer "cuda" on the CPU."""

    def __init__(self):
        super().__init__(shim_kernels())


def _built(source: KernelSource) -> Path:
    """Return the library, compiled once per source and kept; other processes wait for the one that compiles."""
    entries = "".join(
        f'extern "C" void launch_{name}(int blocks, const {structure} *s) '
        f"{{ shim::launch({name}, blocks, {threads}, *s); }}\n"
        for name, (structure, threads) in source.kernels.items()
    ) + "".join(
        f'extern "C" int size_of_{name}() {{ return sizeof({name}); }}\n' for name in source.structures
    )
    text = f"{HEADER.read_text()}\n{source.text}\n{entries}"
    key = hashlib.sha256("\n".join((text, *OPTIONS)).encode()).hexdigest()[:20]
    folder = Path(tempfile.gettempdir()) / f"beamsplat-cuda-{os.getuid()}"
    library = folder / f"{key}.so"
    folder.mkdir(mode=0o700, exist_ok=True)
    with (folder / f"{key}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not library.exists():
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                cpp, out = Path(scratch) / "kernels.cpp", Path(scratch) / "kernels.so"
                cpp.write_text(text)
                subprocess.run(["g++", *OPTIONS, "-o", str(out), str(cpp)], check=True)
                os.replace(out, library)
    return library
