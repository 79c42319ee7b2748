"""Settings of the mapper by engine: the defaults of options that a deployment does not set.

Those of the CPU were tuned with `beamsplat bench map` for two cores. Those of the GPU spend the time that its
kernels are computed to need (docs/gpu.md): about 0.15 s per keyframe on an H100, 0.5 s on an RTX 4060. They
have not been measured on a GPU.
"""

from __future__ import annotations

from typing import NamedTuple

from beamsplat.services.mapping.settings import MapperSettings


class EngineProfile(NamedTuple):
    """Defaults of the options of these names, see `config.MappingConfig`."""

    half_steps: int
    full_steps: int
    tick_steps: int
    mend_steps: int
    stride_px: int
    fine_stride_px: int
    max_gaussians: int


PROFILES = {
    "cpu": EngineProfile(
        half_steps=18, full_steps=5, tick_steps=6, mend_steps=30, stride_px=5, fine_stride_px=3,
        max_gaussians=300_000,
    ),
    "cuda": EngineProfile(
        half_steps=60, full_steps=240, tick_steps=100, mend_steps=200, stride_px=4, fine_stride_px=2,
        max_gaussians=1_000_000,
    ),
}  # fmt: skip
PAGED_GAUSSIANS = 20_000_000  # the default of `max_gaussians` with a budget of memory: most are on disk


def settings_for(engine: str) -> MapperSettings:
    """Return the settings of a mapper with the engine called `engine`: "cpu" or "cuda"."""
    p = PROFILES[engine]
    return MapperSettings(
        half_iterations=p.half_steps, full_iterations=p.full_steps, stride_px=p.stride_px,
        fine_stride_px=p.fine_stride_px, max_gaussians=p.max_gaussians,
    )  # fmt: skip
