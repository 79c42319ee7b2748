"""Logs of processes are bounded, whatever writes into them, and the reason of a crash is still found."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

from beamsplat.tools.system.log_tail import last_error, log_position

ROOT = Path(__file__).resolve().parents[3]
LIMIT = 100_000

_WRITER = """
    import logging, os, sys, time
    from pathlib import Path
    from beamsplat.tools.system import node_process

    node_process.LOG_BYTES, node_process.LOG_CHECK_S = {limit}, 0.02
    log = Path(sys.argv[1])

    def serve(*_, **__):
        for number in range(40):
            os.write(2, b"x" * 9_999 + b"\\n")  # as a library in C writes, past Python's logging
            logging.getLogger("beamsplat.x").error("error %d", number)
            time.sleep(0.05)
        raise RuntimeError("the last one")

    node_process.serve = serve
    node_process.parent_process = lambda: type("Parent", (), {{"sentinel": os.pipe()[0]}})()
    node_process.child(None, "x", log, False, None, {{}}, None)
"""


def test_a_process_that_writes_much_keeps_its_log_bounded(tmp_path):
    log = tmp_path / "x.log"
    log.write_text("2026-11-28 07:00:01,123 ERROR   beamsplat: of an earlier process\n")
    start = log_position(log)
    script = textwrap.dedent(_WRITER).format(limit=LIMIT)
    done = subprocess.run(
        [sys.executable, "-c", script, str(log)], cwd=ROOT, timeout=60, capture_output=True, check=False
    )
    assert done.returncode == 1, done.stderr
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == ["x.log", "x.log.1"]
    assert all(path.stat().st_size < 2 * LIMIT for path in tmp_path.iterdir())
    assert last_error(log, start) == "RuntimeError: the last one"


def test_the_last_error_is_found_before_and_after_the_rotation(tmp_path):
    log, old = tmp_path / "x.log", tmp_path / "x.log.1"
    line = "2026-11-28 07:00:01,123 ERROR   beamsplat: {}\n"
    log.write_text(line.format("earlier"))
    start = log_position(log)
    with log.open("a") as file:
        file.write(line.format("own"))
    assert last_error(log, start) == "own"
    os.rename(log, old)
    log.write_text("")
    assert last_error(log, start) == "own"
    log.write_text(line.format("after the rotation"))
    assert last_error(log, start) == "after the rotation"
    old.write_text("")
    log.write_text("")
    assert "nothing in" in last_error(log, start)
