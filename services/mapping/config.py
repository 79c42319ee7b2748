"""What can be chosen about the mapping service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig

Steps = Annotated[int, Field(ge=0, le=100_000)]


class MappingConfig(NodeConfig):
    """Work is fixed: so many steps a keyframe, so many a tick. `threads` are the rasterizer's."""

    nice: Annotated[int, Field(ge=0, le=19)] = 5  # whoever feeds the map comes before it
    half_steps: Steps = 18  # per keyframe, at half size
    full_steps: Steps = 5
    tick_steps: Steps = 6  # per tick while no keyframe waits, at full size
    mend_steps: Steps = 30  # after anchors have moved: seams
    final_steps: Steps = 0  # when the data have ended, on all keyframes
    calm_backlog: Annotated[int, Field(ge=1)] = 5  # more keyframes wait on the robot: fewer steps for each
    max_gaussians: Annotated[int, Field(ge=1000)] | None = None  # 300 000; with memory_mb 20 million, on disk
    max_keyframes: Annotated[int, Field(ge=4)] = 800
    refine_pose: bool = True
    refine_exposure: bool = True
    chunk_every: Annotated[int, Field(ge=1)] = 2  # keyframes between two versions of the newest chunk
    chunk_error_px: Annotated[float, Field(gt=0.0)] = 1.0  # finer detail, seen from the robot, is not sent
    seed: int = 0
    save: Path | None = None  # folder for splats.ply and keyframes.tum, written at the end of the data
    session: Path | None = None  # folder that the map lives in: saved while mapping, resumed at the start
    memory_mb: Annotated[float, Field(gt=0.0)] | None = None  # of this process; what is more rests on disk
    session_every_s: Annotated[float, Field(gt=0.0)] = 30.0  # between checkpoints, by the data's clock

    def gaussians(self) -> int:
        """The most Gaussians that the map may have."""
        return self.max_gaussians or (300_000 if self.memory_mb is None else 20_000_000)
