"""Configuration of the mapping service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from beamsplat.common.config.base import Remote
from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.engines.choice import EngineName
from beamsplat.services.mapping.profiles import PAGED_GAUSSIANS, PROFILES
from beamsplat.services.mapping.settings import MapperSettings

PositiveFinite = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Steps = Annotated[int, Field(ge=0, le=100_000)]
Stride = Annotated[int, Field(ge=1, le=64)]
_CPU = PROFILES["cpu"]


class MappingConfig(NodeConfig):
    """Options of the mapping service. The work per keyframe and per tick is fixed; part of it can wait.

    `threads` is the number of threads of the CPU engine. The defaults of the numbers of steps, of the strides
    and of `max_gaussians` are those of the CPU engine; on a GPU they are higher and finer (`profiles.py`).
    """

    # What computes the map. "auto": the GPU if there is one with a driver and torch, else the CPU.
    engine: EngineName = "auto"

    nice: Annotated[int, Field(ge=0, le=19)] = 5  # lower CPU priority than the services that feed the map
    half_steps: Remote[Steps] = _CPU.half_steps  # per keyframe, at half size
    full_steps: Remote[Steps] = _CPU.full_steps
    tick_steps: Remote[Steps] = _CPU.tick_steps  # per tick without waiting keyframes and owed steps
    mend_steps: Remote[Steps] = _CPU.mend_steps  # after anchors have moved, at half size: closes gaps
    final_steps: Remote[Steps] = 0  # at the end of the data, on all keyframes
    # Wanted delay from an image to the map, in time of the data: the nearer to it, the fewer steps follow an
    # insertion at once. The others are done while no keyframe waits.
    latency_s: Remote[PositiveFinite] = 1.0
    stride_px: Remote[Stride] = _CPU.stride_px  # between new Gaussians
    fine_stride_px: Remote[Stride] = _CPU.fine_stride_px  # the same where the image has texture
    # Degree of the spherical harmonics that make colours depend on the viewing direction; 0 = none. Of the
    # exports, only PLY has them.
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 0
    max_gaussians: Annotated[int, Field(ge=1000)] | None = None  # None: see `for_engine`
    max_keyframes: Annotated[int, Field(ge=4)] = 800
    refine_pose: Remote[bool] = True
    refine_exposure: Remote[bool] = True
    chunk_every: Remote[Annotated[int, Field(ge=1)]] = 2  # keyframes between two updates of the newest chunk
    chunk_error_px: Remote[PositiveFinite] = 1.0  # smaller detail in the image is not published
    seed: int = 0
    save: Path | None = None  # folder for splats.ply and keyframes.tum, written at the end of the data
    session: Path | None = None  # folder of the saved map: written while mapping, resumed at the start
    memory_mb: PositiveFinite | None = None  # budget of this process; the rest is on disk
    gpu_memory_mb: PositiveFinite | None = None  # budget of GPU memory; the rest is in memory and on disk
    session_every_s: PositiveFinite = 30.0  # between checkpoints, in time of the data

    def for_engine(self, name: str) -> MappingConfig:
        """Return the options with the defaults of an engine, "cpu" or "cuda", for those that are not set.

        With a budget of memory that the engine keeps, `max_gaussians` is 20 million by default.
        """
        profile = PROFILES[name]
        paged = self.memory_mb is not None or (name == "cuda" and self.gpu_memory_mb is not None)
        if paged:
            profile = profile._replace(max_gaussians=PAGED_GAUSSIANS)
        given = {key for key in self.model_fields_set if getattr(self, key) is not None}
        return self.model_copy(update={k: v for k, v in profile._asdict().items() if k not in given})

    def mapper_settings(self) -> MapperSettings:
        """Return the settings of the mapper by these options, which are those of an engine (`for_engine`)."""
        assert self.max_gaussians is not None  # see `for_engine`
        return MapperSettings(
            half_iterations=self.half_steps, full_iterations=self.full_steps, stride_px=self.stride_px,
            fine_stride_px=self.fine_stride_px, max_gaussians=self.max_gaussians,
            max_keyframes=self.max_keyframes, refine_pose=self.refine_pose,
            refine_exposure=self.refine_exposure,
        )  # fmt: skip
