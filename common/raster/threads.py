"""A few threads that run GIL-free kernels together. Kernels share their work by an atomic counter.

Numba's own `parallel=True` is not used: its fall-back threading layer aborts the process when two Python
threads enter it at once, and its static split waits for whichever core was taken away.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np


class Team:
    """`count` threads, this one included; `Team(1)` starts none."""

    def __init__(self, count: int = 1) -> None:
        if count < 1:
            raise ValueError(f"a team needs at least one thread, got {count}")
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1, thread_name_prefix="raster") if count > 1 else None

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """kernel(counter, *args) on every thread; returns when all are done, raises what one raised."""
        counter = np.zeros(1, np.int64)
        if self._pool is None:
            kernel(counter, *args)
            return
        others = [self._pool.submit(kernel, counter, *args) for _ in range(self.count - 1)]
        try:
            kernel(counter, *args)
        finally:
            for other in others:
                other.result()

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown()
