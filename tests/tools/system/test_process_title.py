"""A process of a node is called after it."""

import multiprocessing
import sys
from pathlib import Path

import psutil
import pytest

from beamsplat.tools.system.process_title import set_process_title

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="titles are set on Linux only")


def _titled(queue, stop):
    set_process_title("beamsplat:localization")
    queue.put(Path("/proc/self/comm").read_text())
    stop.wait(20)


def test_a_child_of_a_fork_server_is_called_after_its_node():
    context = multiprocessing.get_context("forkserver")
    queue, stop = context.Queue(), context.Event()
    process = context.Process(target=_titled, args=(queue, stop))
    process.start()
    try:
        assert queue.get(timeout=20) == "beamsplat:local\n"  # 15 characters: the kernel keeps no more
        assert psutil.Process(process.pid).cmdline() == ["beamsplat:localization"]
    finally:
        stop.set()
        process.join(10)
    assert process.exitcode == 0
