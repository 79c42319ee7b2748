"""The decorator of all Numba kernels, with an on-disk cache that is invalidated when a helper changes.

Numba's cache checks only the file of the compiled function. Constants and inlined functions come from other
files too, so after a change of such a file Numba alone would load outdated machine code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

from numba import njit

_F = TypeVar("_F", bound=Callable[..., Any])
_SHARED = Path(__file__).parent / "raster"  # its helpers are inlined into kernels of other folders too


@cache
def _digest(folder: Path) -> str:
    """Return the SHA-256 digest of the sources in a folder and of the shared helpers."""
    sources = sorted({*folder.glob("*.py"), *_SHARED.glob("*.py"), Path(__file__)})
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


@overload
def kernel(function: _F, *, fastmath: bool | set[str] = False, sources: str = "") -> _F: ...


@overload
def kernel(*, fastmath: bool | set[str] = False, sources: str = "") -> Callable[[_F], _F]: ...


def kernel(
    function: Callable[..., Any] | None = None, *, fastmath: bool | set[str] = False, sources: str = ""
) -> Any:
    """Compile a function to run without the GIL, with an on-disk cache; use as `@kernel` or `@kernel(...)`.

    Division by zero follows NumPy, because Python's check for zero prevents vectorisation.

    Args:
        function: the function to compile.
        fastmath: as in numba.njit.
        sources: digest of all sources that the machine code depends on; by default those in the function's
            folder and in `common/raster`.
    """
    if function is None:
        return lambda f: kernel(f, fastmath=fastmath, sources=sources)
    compiled = njit(nogil=True, cache=True, error_model="numpy", fastmath=fastmath)(function)
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if file is not None and hasattr(file, "_source_stamp"):
        stamp = sources or _digest(Path(function.__code__.co_filename).parent)
        file._source_stamp = (file._source_stamp, stamp)
    return compiled


def inner(function: _F) -> _F:
    """Compile a helper function of kernels; LLVM may inline it into them."""
    compiled: Any = njit(error_model="numpy")(function)
    return compiled


def inlined(function: _F) -> _F:
    """Compile a helper function of kernels that Numba always inlines."""
    compiled: Any = njit(inline="always", error_model="numpy")(function)
    return compiled
