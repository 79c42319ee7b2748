"""The engines of the mapper: which one is used, and what is said about it."""

import pytest

from beamsplat.common.engines.choice import cuda_obstacle
from beamsplat.common.errors import UserError
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.engines.choice import make_engine
from beamsplat.services.mapping.node import MappingNode
from beamsplat.services.mapping.profiles import PROFILES, settings_for
from beamsplat.services.mapping.settings import MapperSettings
from tests.services.mapping.session import maps

WITHOUT_GPU = pytest.mark.skipif(cuda_obstacle() is None, reason="this machine has a GPU")


@WITHOUT_GPU
def test_a_mapper_that_is_to_use_a_gpu_says_what_is_missing_before_it_starts():
    with pytest.raises(
        UserError, match=r'mapping.engine = "cuda": .+; or set mapping.engine = "auto"'
    ) as caught:
        MappingNode(MappingConfig(engine="cuda")).check_resources()
    assert len(str(caught.value).splitlines()) == 1


def test_options_that_are_not_set_follow_the_engine():
    for_cpu, for_gpu = (MappingConfig(half_steps=7).for_engine(name) for name in ("cpu", "cuda"))
    assert (for_cpu.half_steps, for_gpu.half_steps) == (7, 7)
    defaults = MapperSettings()
    assert (for_cpu.full_steps, for_cpu.stride_px) == (defaults.full_iterations, defaults.stride_px)
    assert for_cpu.max_gaussians == defaults.max_gaussians
    assert for_gpu.full_steps >= 100
    assert for_gpu.stride_px < for_cpu.stride_px
    assert for_gpu.max_gaussians > for_cpu.max_gaussians
    assert MappingConfig(max_gaussians=5000).for_engine("cuda").max_gaussians == 5000
    assert settings_for("cpu") == defaults


def test_with_a_budget_that_the_engine_keeps_the_map_may_be_large():
    budget = MappingConfig(gpu_memory_mb=2000.0)
    assert budget.for_engine("cuda").max_gaussians == 20_000_000
    assert budget.for_engine("cpu").max_gaussians == 300_000  # "auto" without a GPU: no budget is kept
    assert MappingConfig(memory_mb=1000.0).for_engine("cpu").max_gaussians == 20_000_000


def test_strides_of_the_options_are_those_of_the_mapper():
    node = maps.make_node(stride_px=9, fine_stride_px=4)
    assert (node._mapper.settings.stride_px, node._mapper.settings.fine_stride_px) == (9, 4)


@WITHOUT_GPU
def test_the_options_that_take_effect_are_those_of_the_cpu():
    options = MappingNode(MappingConfig(tick_steps=3)).options()
    assert (options.tick_steps, options.full_steps) == (3, PROFILES["cpu"].full_steps)
    assert options.max_gaussians == PROFILES["cpu"].max_gaussians


@WITHOUT_GPU
def test_without_a_gpu_auto_is_the_cpu_and_the_status_says_so():
    assert make_engine("auto", 2).description == make_engine("cpu", 2).description == "CPU, 2 threads"
    node = maps.make_node(half_steps=1, full_steps=1, engine="auto")
    maps.feed(node, range(1))
    assert node.detail.endswith("; CPU, 1 thread")


@WITHOUT_GPU
def test_a_budget_of_gpu_memory_without_a_gpu_is_said_to_have_no_effect(caplog):
    assert make_engine("auto", 1, 2000.0).device_budget_bytes is None
    assert "mapping.gpu_memory_mb = 2000 has no effect without a GPU" in caplog.text
