"""`beamsplat warm`: compile the numeric kernels into the cache beside their sources, before services run."""

from __future__ import annotations

import importlib
import time

from rich.console import Console

# Each function runs its library's kernels once, on tiny inputs of the types that are used.
WARMERS = (
    "beamsplat.services.localization.lidar2d.warm:warm",
    "beamsplat.services.fusion.warm:warm",
    "beamsplat.common.raster.warm:warm",
    "beamsplat.services.mapping.warm:warm",
    "beamsplat.common.mapfiles.mesh:warm",
    "beamsplat.services.localization.camera.warm:warm",
    "beamsplat.services.camera.jpeg:warm",
)


def warm() -> None:
    """Compile all numeric kernels into their cache, so that services start fast (about a minute, once).

    Example: beamsplat warm
    """
    console = Console(stderr=True)
    for entry in WARMERS:
        module, _, function = entry.partition(":")
        started = time.perf_counter()
        with console.status(f"compiling {module}"):
            getattr(importlib.import_module(module), function)()
        console.print(f"{module}: ready after {time.perf_counter() - started:.1f} s")
