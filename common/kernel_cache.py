"""Where Numba finds compiled kernels on a disk that is full or read-only.

Numba imports this module in supervised processes: their environment variable NUMBA_CACHE_LOCATOR_CLASSES
names the classes below. By itself, Numba raises an error where it cannot write, even if a kernel is compiled.
"""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import Cache, InTreeCacheLocator

log = logging.getLogger("beamsplat")


class ReadableCacheLocator(InTreeCacheLocator):
    """Kernels beside their source, if they can be written there, or some have been written before."""

    def ensure_cache_path(self) -> None:
        try:
            super().ensure_cache_path()
        except OSError:
            if not _has_kernels(Path(self.get_cache_path())):
                raise


class UnwritableCacheLocator(InTreeCacheLocator):
    """No kernels on any disk, and none can be written: they are compiled in memory."""

    def ensure_cache_path(self) -> None:
        pass


@cache
def _has_kernels(folder: Path) -> bool:
    return any(folder.glob("*.nbi"))


_save_overload = Cache.save_overload


def _save_if_possible(self: Any, sig: Any, data: Any) -> None:
    try:
        _save_overload(self, sig, data)
    except OSError as error:
        log.warning("a compiled kernel cannot be stored and is compiled again at the next start: %s", error)


Cache.save_overload = _save_if_possible  # type: ignore[method-assign]
