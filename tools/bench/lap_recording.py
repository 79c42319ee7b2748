"""A simulated lap through a furnished home, the input of endurance benchmarks."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from beamsplat.tools.simulator.recording import simulate
from beamsplat.tools.simulator.settings import CameraSettings, SimulationSettings


def lap_recording(folder: Path, log: Callable[[str], None], camera: CameraSettings | None = None) -> Path:
    """Return the bag of one simulated lap in `folder`; simulate the lap if it is missing.

    Args:
        folder: parent of the recording's folder.
        log: receives the name of each stage of the simulation.
        camera: None: the usual one of the simulator.
    """
    lap = folder / "lap"
    if not lap.exists():  # the simulator writes a complete folder or none
        stages: list[str] = []

        def progress(stage: str, done: int, total: int) -> None:
            if stages[-1:] != [stage]:
                stages.append(stage)
                log(f"simulator: {stage}")

        simulate(
            SimulationSettings(laps=1, camera=camera or CameraSettings()),
            lap,
            jobs=os.cpu_count() or 1,
            replace=False,
            progress=progress,
        )
    return lap / "bag"
