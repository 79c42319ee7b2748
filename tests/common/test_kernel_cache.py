"""Compiled kernels are used where the disk is full or read-only, and kernels are compiled where there are none."""

import os
import subprocess
import sys

import pytest

from beamsplat.tools.system.node_process import CHILD_ENVIRONMENT
from tests.common.files.small_disk import SmallDisk

KERNEL = """
from beamsplat.common.compiled import kernel
@kernel
def double(x):
    return 2 * x
print(double({argument}), sum(double.stats.cache_hits.values()))
"""


@pytest.mark.parametrize("fault", ["full", "read-only"])
def test_kernels_start_on_a_full_or_read_only_disk(tmp_path, fault):
    disk = SmallDisk(tmp_path / "disk", 2)
    environment = os.environ | CHILD_ENVIRONMENT | {"HOME": str(disk.path / "home")}

    def run(argument="1"):
        done = subprocess.run([sys.executable, disk.path / "code.py", argument], env=environment, text=True,
                              capture_output=True, check=False)  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    try:
        (disk.path / "code.py").write_text(KERNEL.format(argument="eval(__import__('sys').argv[1])"))
        assert run() == ["2", "0"]
        if fault == "full":
            disk.fill()
        else:
            disk.set_read_only(True)
        assert run() == ["2", "1"]  # compiled before
        assert run("1.5") == ["3.0", "0"]  # compiled now, and not stored
    finally:
        disk.close()
