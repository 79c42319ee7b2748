"""A thread team for kernels without GIL; the threads divide the work by an atomic counter.

Numba's `parallel=True` is not used: its fallback threading layer aborts the process if two Python threads use
it at the same time, and with its static work distribution all threads wait for the slowest core.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np


class ThreadTeam:
    """A team of `count` threads, including the calling one; `ThreadTeam(1)` starts no thread."""

    def __init__(self, count: int = 1) -> None:
        if count < 1:
            raise ValueError(f"a team needs at least one thread, got {count}")
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1, thread_name_prefix="raster") if count > 1 else None

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """Call kernel(counter, *args) in each thread, wait for all, and raise a thread's exception here.

        `counter` is a new int64 [1], zero, from which the threads take work with `atomic_next`.
        """
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
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()
