"""Configuration of the mapping service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig

PositiveFinite = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
EngineName = Literal["auto", "cpu", "cuda"]
Steps = Annotated[int, Field(ge=0, le=100_000)]


class MappingConfig(NodeConfig):
    """Options of the mapping service. The work per keyframe and per tick is fixed; part of it can wait.

    `threads` is the number of threads of the CPU engine.
    """

    # What computes the map. "auto": the GPU if there is one with a driver and torch, else the CPU.
    engine: EngineName = "auto"

    nice: Annotated[int, Field(ge=0, le=19)] = 5  # lower CPU priority than the services that feed the map
    half_steps: Remote[Steps] = 18  # per keyframe, at half size
    full_steps: Remote[Steps] = 5
    tick_steps: Remote[Steps] = 6  # per tick without waiting keyframes and owed steps, at full size
    mend_steps: Remote[Steps] = 30  # after anchors have moved, at half size: closes gaps at submap borders
    final_steps: Remote[Steps] = 0  # at the end of the data, on all keyframes
    # Wanted delay from an image to the map, in time of the data: the nearer to it, the fewer steps follow an
    # insertion at once. The others are done while no keyframe waits.
    latency_s: Remote[PositiveFinite] = 1.0
    max_gaussians: Annotated[int, Field(ge=1000)] | None = None  # see `gaussians`
    max_keyframes: Annotated[int, Field(ge=4)] = 800
    refine_pose: Remote[bool] = True
    refine_exposure: Remote[bool] = True
    chunk_every: Remote[Annotated[int, Field(ge=1)]] = 2  # keyframes between two updates of the newest chunk
    chunk_error_px: Remote[PositiveFinite] = 1.0  # smaller detail in the image is not published
    seed: int = 0
    save: Path | None = None  # folder for splats.ply and keyframes.tum, written at the end of the data
    session: Path | None = None  # folder of the saved map: written while mapping, resumed at the start
    memory_mb: PositiveFinite | None = None  # budget of this process; the rest is on disk
    session_every_s: PositiveFinite = 30.0  # between checkpoints, in time of the data

    def gaussians(self) -> int:
        """Return `max_gaussians`, by default 300 000 without `memory_mb`, else 20 million."""
        return self.max_gaussians or (300_000 if self.memory_mb is None else 20_000_000)
