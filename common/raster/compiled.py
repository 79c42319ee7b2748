"""The decorators of the kernels, and a cache that notices when any of these files changes.

Numba's cache looks only at the file of the compiled function, but constants and inner functions come from the
other files of this package: after an update of one of them, old machine code would run with the new rest.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit


def _digest() -> str:
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


_SOURCES = _digest()


def kernel(function: Callable[..., Any], sources: str = _SOURCES) -> Any:
    """Compiles without the GIL, with NumPy's division (Python's check for zero stops vectorisation), cached.

    `sources` stands for everything the machine code was made from.
    """
    compiled = njit(nogil=True, cache=True, error_model="numpy")(function)
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        file._source_stamp = (file._source_stamp, sources)
    return compiled


inner = njit(error_model="numpy")  # inlined into kernels by LLVM
inlined = njit(inline="always", error_model="numpy")
