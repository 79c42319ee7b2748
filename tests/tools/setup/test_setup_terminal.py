"""`beamsplat setup` in a terminal with emulated devices: it ends with a deployment that runs."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from beamsplat.common.geometry.rig import load_rig
from beamsplat.common.geometry.transforms import se3_to_se2
from beamsplat.common.zenoh.bus import open_session
from beamsplat.tools.system.health_table import HealthTable
from tests.services.lidar.devices import EmulatedPort
from tests.tools.setup.emulated_desk import (
    T_BODY_CAMERA,
    T_BODY_LIDAR,
    Desk,
    DeskCamera,
    DeskLidar,
    K,
    boards_before_the_lidar,
)

pexpect = pytest.importorskip("pexpect", reason="needs pexpect: pip install -e '.[dev]'")
COMMAND = [sys.executable, "-m", "beamsplat"]
BOARDS = 6


@pytest.fixture
def environment(tmp_path):
    return {**os.environ, "TERM": "xterm-256color", "XDG_STATE_HOME": str(tmp_path / "state")}


@pytest.mark.slow
def test_setup_ends_with_a_running_system(tmp_path, environment, free_endpoint):
    robot, rig, lidar = (tmp_path / name for name in ("robot.toml", "rig.toml", "ttyUSB0"))
    desk = Desk(24, boards_before_the_lidar(BOARDS))
    with DeskCamera(desk) as camera, EmulatedPort(DeskLidar(desk), str(lidar)):
        arguments = ["setup", "--out", str(robot), "--rig", str(rig), "--camera", camera.url,
                     "--device", str(tmp_path / "nothing"), "--device", str(lidar)]  # fmt: skip
        child = pexpect.spawn(
            COMMAND[0],
            [*COMMAND[1:], *arguments],
            env=environment,
            dimensions=(60, 120),
            timeout=90,
            encoding="utf-8",
        )
        child.logfile_read = open(tmp_path / "said.txt", "w")  # noqa: SIM115
        child.expect("480x360 pixels")
        child.expect("nothing.*No such file")
        child.expect("LDROBOT")
        child.expect("from the centre to the edge: 4 m")
        _answer(child, "upside down", "n")
        for question, answer in (("forward", ""), ("left", ""), ("up", ""), ("looks down", "5")):
            _answer(child, f"camera: {question}", answer)
        for question, answer in (("forward", "0.03"), ("left", ""), ("up", ""), ("turned to the left", "")):
            _answer(child, f"lidar: {question}", answer)
        _answer(child, "printed chessboard", "y")
        _answer(child, "Side of a square", "")
        _answer(child, "Hold it in front of the camera", "")
        child.expect("view 12 of 12", timeout=200)
        child.expect(r"reprojection error (\d\.\d+) px over 12 views")
        assert float(child.match[1]) < 0.3
        _answer(child, f"Do that now, {BOARDS} times", "y")
        for number in range(BOARDS):
            child.expect(f"board {number + 1} of {BOARDS}")
            desk.hold(number)
            time.sleep(0.5)  # both sensors see this board now
            child.sendline("")
            child.expect("accepted, distance 0.[67]")
        child.expect(r"turned by (\d\.\d+) degrees, \+- (\d\.\d+)")
        child.expect("fits together")
        child.expect(pexpect.EOF)
        child.close()
        assert child.exitstatus == 0
        _is_right(load_rig(rig))
        assert (tmp_path / "chessboard.pdf").read_bytes().startswith(b"%PDF")
        checked = subprocess.run([*COMMAND, "check", robot], capture_output=True, text=True, env=environment)
        assert checked.returncode == 0, checked.stderr
        desk.T_body_board = None
        _runs(robot, environment, free_endpoint)


def _answer(child, question, answer):
    child.expect(re.escape(question))
    child.expect("[:?] ")
    child.sendline(answer)


def _is_right(rig):
    camera = rig.camera.model()
    np.testing.assert_allclose([camera.fx_px, camera.fy_px], K[[0, 1], [0, 1]], rtol=0.01)
    np.testing.assert_allclose(camera.T_body_camera, T_BODY_CAMERA, atol=1e-6)
    error = se3_to_se2(rig.lidar.model().T_body_lidar) - se3_to_se2(T_BODY_LIDAR)
    assert np.abs(error[:2]).max() < 0.02
    assert abs(error[2]) < np.radians(1.0)


def _runs(robot, environment, endpoint):
    """Run `beamsplat run`: every node becomes active, and the robot localizes."""
    overrides = [f"--set=router.listen={json.dumps([endpoint])}", "--set=page.port=0"]
    running = subprocess.Popen(
        [*COMMAND, "run", str(robot), *overrides], env=environment, stderr=subprocess.PIPE
    )
    try:
        with open_session((endpoint,), wait_s=60.0) as session:
            board = HealthTable(session, "robot1")
            wanted = dict.fromkeys(("camera", "lidar", "localization", "depth", "fusion", "page"), "active")
            deadline = time.monotonic() + 90.0
            while not (board.states() == wanted and _sent(board, "localization/odometry") > 10):
                assert time.monotonic() < deadline, board.states()
                assert running.poll() is None, running.stderr.read().decode()
                time.sleep(0.2)
    finally:
        running.send_signal(signal.SIGINT)
        running.communicate(timeout=30)
    assert running.returncode == 0


def _sent(board, topic):
    outputs = board.records["localization"].health.outputs
    return next((o.sent for o in outputs if o.topic == topic), 0)
