"""NVRTC: compiles CUDA C++ to machine code without a CUDA toolkit, through ctypes. It needs no GPU.

torch's wheels for CUDA bring libnvrtc; so does the package `nvidia-cuda-nvrtc`, and the CUDA of a Jetson.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import glob
import hashlib
import logging
import os
import sys
import tempfile
from pathlib import Path

import torch

from beamsplat.common.errors import UserError
from beamsplat.common.raster.cuda.source import KernelSource

log = logging.getLogger("beamsplat")

INSTALL = "pip install nvidia-cuda-nvrtc"
_PRELUDE = '#define KERNEL(threads) extern "C" __global__ void __launch_bounds__(threads)\n'
_OPTIONS = ("--std=c++17", "--use_fast_math")
_OLDEST = (12, 0)  # NVRTC version that the kernels are tested with


class Nvrtc:
    """The compiler library.

    Args:
        path: file of libnvrtc; default: that of torch, of the package nvidia-cuda-nvrtc, or of the system.

    Raises:
        UserError: there is none, or it is too old.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._library = _load(path)
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._check(self._library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
        self.version = (major.value, minor.value)
        if self.version < _OLDEST:
            raise UserError(f"NVRTC {self.name} is too old for the CUDA kernels: {INSTALL}")

    @property
    def name(self) -> str:
        """Version as text, such as "13.0"."""
        return ".".join(map(str, self.version))

    @property
    def known(self) -> list[int]:
        """Architectures that it compiles for, such as 90."""
        count = ctypes.c_int()
        self._check(self._library.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
        found = (ctypes.c_int * count.value)()
        self._check(self._library.nvrtcGetSupportedArchs(found))
        return list(found)

    def architecture(self, capability: tuple[int, int]) -> str:
        """Return the target for a GPU: "sm_XX", or "compute_XX" (PTX) if it is newer than this NVRTC.

        Args:
            capability: compute capability of the GPU (major, minor).

        Raises:
            UserError: the GPU is older than all that this NVRTC knows.
        """
        return best_architecture(capability, self.known, self.name)

    def compile(self, source: KernelSource, architecture: str, *options: str) -> tuple[bytes, str]:
        """Compile the kernels; return machine code (PTX for "compute_XX") and the compiler's log.

        Raises:
            UserError: the compiler reports an error.
        """
        n, program = self._library, ctypes.c_void_p()
        text = (_PRELUDE + source.text).encode()
        self._check(n.nvrtcCreateProgram(ctypes.byref(program), text, b"beamsplat.cu", 0, None, None))
        try:
            flags = [o.encode() for o in (f"--gpu-architecture={architecture}", *_OPTIONS, *options)]
            failed = n.nvrtcCompileProgram(program, len(flags), (ctypes.c_char_p * len(flags))(*flags))
            log_text = self._text(program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
            if failed:
                first = next((line for line in log_text.splitlines() if "error" in line), log_text[:200])
                raise UserError(
                    f"NVRTC {self.name} cannot compile the kernels for {architecture} ({first.strip()}): "
                    f"{INSTALL} --upgrade, or use the CPU"
                )
            return self._text(program, "CUBIN" if architecture.startswith("sm_") else "PTX"), log_text
        finally:
            n.nvrtcDestroyProgram(ctypes.byref(program))

    def _text(self, program: ctypes.c_void_p, what: str) -> bytes:
        size = ctypes.c_size_t()
        self._check(getattr(self._library, f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
        room = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, f"nvrtcGet{what}")(program, room))
        return room.raw

    def _check(self, code: int) -> None:
        if code:
            self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
            name = (self._library.nvrtcGetErrorString(code) or b"").decode()
            raise UserError(f"NVRTC failed with {name or code}: {INSTALL} --upgrade, or use the CPU")


def best_architecture(capability: tuple[int, int], known: list[int], version: str) -> str:
    """Return the target for a GPU if an NVRTC has the `known` ones, such as 90; see `Nvrtc.architecture`."""
    wanted = 10 * capability[0] + capability[1]
    older = [arch for arch in known if arch <= wanted]
    if not older:
        raise UserError(
            f"this GPU (compute capability {capability[0]}.{capability[1]}) is too old for NVRTC {version}, "
            f"which starts at {min(known) / 10:.1f}: use the CPU"
        )
    return f"sm_{wanted}" if wanted in older else f"compute_{max(older)}"


def _load(path: Path | None) -> ctypes.CDLL:
    for place in _places() if path is None else [str(path)]:
        with contextlib.suppress(OSError):
            # Up to version 13.0, NVRTC looks for its builtins by name only: load them before.
            if "/" in place:
                for builtins in sorted(glob.glob(f"{os.path.dirname(place)}/libnvrtc-builtins.so.*")):
                    ctypes.CDLL(builtins, ctypes.RTLD_GLOBAL)
            return ctypes.CDLL(place)
    raise UserError(f"libnvrtc, which compiles the CUDA kernels, is not installed: {INSTALL}, or use the CPU")


def _places() -> list[str]:
    """Return the files to try, those of torch's own CUDA version first."""
    found = [
        place for folder in sys.path for place in glob.glob(f"{folder}/nvidia/*/lib/libnvrtc.so.1[0-9]")
    ]  # fmt: skip
    major = (torch.version.cuda or "").partition(".")[0]
    found.sort(key=lambda place: (not place.endswith(f".so.{major}"), place))
    toolkit = glob.glob("/usr/local/cuda/lib64/libnvrtc.so") + glob.glob(
        "/usr/local/cuda/targets/*/lib/libnvrtc.so"
    )
    return [*found, "libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so", *toolkit]


@functools.cache
def nvrtc() -> Nvrtc:
    """Return the compiler of this machine.

    Raises:
        UserError: there is none.
    """
    return Nvrtc()


def compiled(source: KernelSource, capability: tuple[int, int], compiler: Nvrtc | None = None) -> bytes:
    """Return the machine code for a GPU, from the cache on disk or compiled now and stored there.

    The key of the cache has the source, the architecture, the options and the version of NVRTC.

    Raises:
        UserError: there is no compiler, or it fails.
    """
    compiler = compiler or nvrtc()
    architecture = compiler.architecture(capability)
    key = "\n".join((_PRELUDE + source.text, architecture, compiler.name, *_OPTIONS))
    file = cache_folder() / f"{architecture}-{hashlib.sha256(key.encode()).hexdigest()[:20]}.bin"
    with contextlib.suppress(OSError):
        if code := file.read_bytes():
            return code
    code, _ = compiler.compile(source, architecture)
    try:
        _write(file, code)
    except OSError as error:
        log.warning(
            "compiled CUDA kernels cannot be stored and are compiled again at the next start: %s", error
        )
    return code


def cache_folder() -> Path:
    """Return the folder of compiled kernels: in $BEAMSPLAT_CACHE, else in ~/.cache/beamsplat."""
    root = os.environ.get("BEAMSPLAT_CACHE")
    return (Path(root) if root else Path.home() / ".cache" / "beamsplat") / "cuda"


def _write(file: Path, code: bytes) -> None:
    """Write a file that another process never sees half."""
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=file.name)
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(code)
        os.replace(name, file)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
