"""`bench gpu` on the CPU build of the kernels: the figures are there, and the checks hold."""

import json

import pytest

from beamsplat.common.raster.layout import GROUPS
from beamsplat.tools.bench.gpu import bench_gpu
from tests.common.raster.cuda.shim import needs_compiler, shim_kernels


@needs_compiler
@pytest.mark.slow
def test_the_figures_are_written_after_each_part(tmp_path):
    said = []
    result = bench_gpu(
        tmp_path / "gpu", shim_kernels(), None, said.append, counts=(2000,), sizes=((64, 48),), repeats=3
    )
    assert json.loads((tmp_path / "gpu" / "gpu.json").read_text()) == result
    errors = result["correctness"]
    assert errors.pop("psnr_db") > 100.0
    assert set(errors) == {*GROUPS, "pose"}
    assert max(errors.values()) < 1e-3
    (row,) = result["steps"]
    assert row["same_bits_twice"]
    assert not row["overflowed"]
    assert row["step_ms"] > row["forward_ms"] > 0.0
    assert len(said) == 2
