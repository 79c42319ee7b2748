"""The reason of a crash is the error, not what happened to be logged last."""

import logging
import time

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.tools.system.log_tail import LogPosition, last_error
from beamsplat.tools.system.node_process import start_logging
from beamsplat.tools.system.supervisor import Supervisor

INFO = "2026-11-28 07:00:00,123 INFO    beamsplat.mapping: 10 keyframes"
ERROR = "2026-11-28 07:00:01,123 ERROR   beamsplat: nodes.depth: the model is missing: pull it"
TRACEBACK = """Traceback (most recent call last):
  File "/x/node.py", line 3, in step
    raise ValueError("bad")
ValueError: shapes (3,) and (4,) differ

During handling of the above exception, another exception occurred:

Traceback (most recent call last):
  File "/x/live.py", line 9, in run
    step()
beamsplat.common.errors.UserError: the step failed
more text of the exception"""


def test_the_last_exception_or_error_line_is_shown(tmp_path):
    log = tmp_path / "x.log"

    def shown(*lines, since=None):
        log.write_text("\n".join(lines) + "\n")
        return last_error(log, since)

    assert shown(INFO, TRACEBACK, INFO, "warning: leaked semaphore") == (
        "beamsplat.common.errors.UserError: the step failed"
    )
    assert shown(TRACEBACK, ERROR, INFO) == "nodes.depth: the model is missing: pull it"
    assert shown(ERROR, TRACEBACK) == "beamsplat.common.errors.UserError: the step failed"
    assert shown(ERROR, "Fatal Python error: Segmentation fault", "", "Thread 0x1:") == (
        "Fatal Python error: Segmentation fault"
    )
    assert shown(INFO) == "10 keyframes"
    assert (
        shown(TRACEBACK, INFO, since=LogPosition(log.stat().st_ino, len(TRACEBACK))) == "10 keyframes"
    )  # of an earlier process
    assert shown("") == f"nothing in {log}"
    assert "no log" in last_error(tmp_path / "absent.log")


def test_it_reads_what_our_processes_write(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(logging.root, "handlers", [])
    start_logging()
    try:
        raise RuntimeError("the disk is full")
    except RuntimeError:
        logging.getLogger("beamsplat.x").exception("step failed")
    logging.getLogger("beamsplat.x").error("refused: no rig")
    logging.getLogger("beamsplat.x").info("closing")
    text = capfd.readouterr().err
    (tmp_path / "log").write_text(text)
    assert last_error(tmp_path / "log") == "refused: no rig"
    (tmp_path / "log").write_text(text[: text.rindex("\n", 0, text.index("refused"))])
    assert last_error(tmp_path / "log") == "RuntimeError: the disk is full"


CRASHING = "tests.tools.system.crashing:Crashing"


def test_the_supervisor_reports_the_exception(tmp_path, free_endpoint):
    deployment = Deployment(
        router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path, nodes={"clock": {"kind": CRASHING}}
    )
    said = []
    with Supervisor(deployment, on_event=said.append) as supervisor:
        deadline = time.monotonic() + 20
        while not said and time.monotonic() < deadline:
            supervisor.poll()
            time.sleep(0.05)
    assert "clock died (exit code 1: ZeroDivisionError: " in said[0]
