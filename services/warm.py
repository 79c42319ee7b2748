"""Compiles the numeric kernels once, into the cache beside their sources: no service does it later."""

from __future__ import annotations

import importlib
import time

from rich.console import Console

# Each function runs its library's kernels once, on tiny inputs of the types that are used.
WARMERS = (
    "services.localization.lidar2d.warm:warm",
    "services.fusion.warm:warm",
    "common.raster.warm:warm",
    "services.mapping.warm:warm",
    "services.mapping.formats.mesh:warm",
    "services.localization.camera.warm:warm",
    "services.camera.jpeg:warm",
)


def warm() -> None:
    """Compiles all kernels into their cache, so that no service starts cold (about a minute, once).

    Example: beamsplat warm
    """
    console = Console(stderr=True)
    for entry in WARMERS:
        module, _, function = entry.partition(":")
        started = time.perf_counter()
        with console.status(f"compiling {module}"):
            getattr(importlib.import_module(module), function)()
        console.print(f"{module}: ready after {time.perf_counter() - started:.1f} s")
