"""The CUDA kernels through NVRTC without a GPU, and what a user reads where something is missing."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from beamsplat.common.errors import UserError
from beamsplat.common.raster.cuda.driver import CudaKernels, cuda_fault
from beamsplat.common.raster.cuda.rtc import Nvrtc, best_architecture, compiled, nvrtc
from beamsplat.common.raster.cuda.source import filled, kernel_source

_USAGE = re.compile(
    r"Compiling entry function '(?P<name>\w+)'.*?(?P<stores>\d+) bytes spill stores, "
    r"(?P<loads>\d+) bytes spill loads.*?Used (?P<registers>\d+) registers",
    re.DOTALL,
)


def resource_usage(log):
    """Kernel -> (registers, bytes of spill stores and loads), from the log of ptxas."""
    return {
        m["name"]: (int(m["registers"]), int(m["stores"]) + int(m["loads"])) for m in _USAGE.finditer(log)
    }


@pytest.mark.parametrize(
    ("architecture", "tile"),
    [("sm_75", 8), ("sm_87", 8), ("sm_89", 8), ("sm_90", 8), ("sm_90", 16), ("sm_120", 8)],
)
def test_kernels_compile_without_spills(architecture, tile):
    try:
        compiler = nvrtc()
    except UserError as error:
        pytest.skip(f"needs NVRTC: {error}")
    number = int(architecture[3:])
    if best_architecture((number // 10, number % 10), compiler.known, "") != architecture:
        pytest.skip(f"NVRTC {compiler.name} does not know {architecture}")
    source = kernel_source(tile)
    code, log = compiler.compile(source, architecture, "--ptxas-options=-v")
    usage = resource_usage(log)
    assert code[:4] == b"\x7fELF"
    assert usage.keys() == source.kernels.keys()
    assert {name: spilled for name, (_, spilled) in usage.items() if spilled} == {}
    assert usage["backward"][0] <= 64
    assert usage["forward"][0] <= 64


def test_every_kernel_has_its_arguments():
    source = kernel_source(8)
    assert {name: threads for name, (_, threads) in source.kernels.items() if threads != 256} == {
        "forward": 64, "backward": 128, "begin_step": 32,
    }  # fmt: skip
    assert kernel_source(16).kernels["forward"] == ("RasterArguments", 256)
    assert {structure for structure, _ in source.kernels.values()} == source.structures.keys()
    with pytest.raises(ValueError, match="8 or 16 px, not 12"):
        kernel_source(12)


def test_arguments_are_filled_by_name():
    structure = kernel_source(8).structures["MoveArguments"]
    tensor = torch.arange(4.0)
    out = filled(structure, params=tensor, first=None, quat=[1, 2, 3, 4], count=7)
    assert (out.params, out.first, out.count, list(out.quat)) == (
        tensor.data_ptr(),
        None,
        7,
        [1.0, 2.0, 3.0, 4.0],
    )
    with pytest.raises(ValueError, match="contiguous"):
        filled(structure, params=tensor[::2])
    with pytest.raises(KeyError):
        filled(structure, parameters=tensor)


def test_new_gpus_get_ptx_and_old_ones_a_reason():
    known = [75, 80, 86, 90, 100]
    assert best_architecture((9, 0), known, "13.0") == "sm_90"
    assert best_architecture((8, 7), known, "13.0") == "compute_86"
    assert best_architecture((12, 1), known, "13.0") == "compute_100"
    with pytest.raises(UserError, match=r"6\.1.*starts at 7\.5"):
        best_architecture((6, 1), known, "13.0")


class FakeCompiler:
    """Counts how often it compiles."""

    name = "13.0"

    def __init__(self):
        self.calls = []

    def architecture(self, capability):
        return best_architecture(capability, [75, 90], self.name)

    def compile(self, source, architecture):
        self.calls.append((source.tile, architecture))
        return f"{source.tile} {architecture}".encode(), ""


def test_machine_code_is_compiled_once_per_source_architecture_and_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("BEAMSPLAT_CACHE", str(tmp_path))
    compiler = FakeCompiler()
    for _ in range(2):
        assert compiled(kernel_source(8), (9, 0), compiler) == b"8 sm_90"
        assert compiled(kernel_source(16), (9, 0), compiler) == b"16 sm_90"
        assert compiled(kernel_source(8), (7, 5), compiler) == b"8 sm_75"
    assert len(compiler.calls) == 3
    compiler.name = "13.1"
    compiled(kernel_source(8), (9, 0), compiler)
    assert len(compiler.calls) == 4
    assert len(list((tmp_path / "cuda").iterdir())) == 4


def test_a_cache_that_cannot_be_written_is_not_an_error(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BEAMSPLAT_CACHE", str(tmp_path / "file"))
    assert compiled(kernel_source(8), (9, 0), FakeCompiler()) == b"8 sm_90"
    assert "compiled again" in caplog.text


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_machine_without_a_gpu_says_what_to_do():
    assert re.search("built without CUDA.*pip install|nvidia-smi", str(cuda_fault()))
    with pytest.raises(UserError, match="cannot run"):
        CudaKernels()


def test_a_missing_compiler_says_what_to_install(tmp_path):
    with pytest.raises(UserError, match="pip install nvidia-cuda-nvrtc"):
        Nvrtc(tmp_path / "libnvrtc.so.13")


def test_the_mapper_does_not_import_torch():
    code = (
        "import sys, beamsplat.services.mapping.node\n"
        "print(*[m for m in sys.modules if m == 'torch' or m.startswith('beamsplat.common.raster.cuda')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[4],
    )
    assert done.stdout.strip() == ""
