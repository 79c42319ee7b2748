"""The decorator of every compiled function, and a cache that notices when one of its helpers changes.

Numba's cache looks only at the file of the compiled function, but constants and inlined functions come from
other files: after an update of one of them, old machine code would run with the new rest.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit

_SHARED = Path(__file__).parent / "raster"  # whose helpers are inlined elsewhere too


@cache
def _digest(folder: Path) -> str:
    """Return the SHA-256 of the sources in a folder and of the shared helpers."""
    sources = sorted({*folder.glob("*.py"), *_SHARED.glob("*.py"), Path(__file__)})
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def kernel(
    function: Callable[..., Any] | None = None, *, fastmath: bool | set[str] = False, sources: str = ""
) -> Any:
    """Compile a function without the GIL and with a cache on disk; use as `@kernel` or `@kernel(...)`.

    Division follows NumPy (Python's check for zero prevents vectorisation). `sources` is a digest of all that
    the machine code is made from; by default of the function's folder and of `common/raster`.
    """
    if function is None:
        return lambda f: kernel(f, fastmath=fastmath, sources=sources)
    compiled = njit(nogil=True, cache=True, error_model="numpy", fastmath=fastmath)(function)
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        stamp = sources or _digest(Path(function.__code__.co_filename).parent)
        file._source_stamp = (file._source_stamp, stamp)
    return compiled


inner = njit(error_model="numpy")  # inlined into kernels by LLVM
inlined = njit(inline="always", error_model="numpy")
