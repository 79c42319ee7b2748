"""Returning of freed memory to the system.

glibc keeps what is freed between blocks in use. Arrays of some hundred kilobytes that come and go then make a
process grow for hours, although what it uses stays the same.
"""

from __future__ import annotations

import ctypes

_malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # of glibc; other C libraries have none


def trim_heap() -> None:
    """Return all free pages of the heap to the system; takes some milliseconds."""
    if _malloc_trim is not None:
        _malloc_trim(ctypes.c_size_t(0))
