"""The engines of the mapper: which one is used, and what is said about it."""

import pytest

from beamsplat.common.errors import UserError
from beamsplat.services.mapping.config import MappingConfig
from beamsplat.services.mapping.engines.choice import cuda_obstacle, make_engine
from beamsplat.services.mapping.node import MappingNode
from tests.services.mapping.session import maps

WITHOUT_GPU = pytest.mark.skipif(cuda_obstacle() is None, reason="this machine has a GPU")


@WITHOUT_GPU
def test_a_mapper_that_is_to_use_a_gpu_says_what_is_missing_before_it_starts():
    with pytest.raises(
        UserError, match=r'mapping.engine = "cuda": .+; or set mapping.engine = "auto"'
    ) as caught:
        MappingNode(MappingConfig(engine="cuda")).check_resources()
    assert len(str(caught.value).splitlines()) == 1


@WITHOUT_GPU
def test_without_a_gpu_auto_is_the_cpu_and_the_status_says_so():
    assert make_engine("auto", 2).description == make_engine("cpu", 2).description == "CPU, 2 threads"
    node = maps.make_node(half_steps=1, full_steps=1, engine="auto")
    maps.feed(node, range(1))
    assert node.detail.endswith("; CPU, 1 thread")
