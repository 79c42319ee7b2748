"""A bug report holds what is needed to look into a fault, and no secret."""

import json
import threading
import time
import zipfile

import pytest
from typer.testing import CliRunner

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Health
from beamsplat.common.redaction import Redactor
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.tools.cli.main import app
from beamsplat.tools.system.bug_report import LOG_BYTES

TOKEN, PASSWORD = "correct-horse-battery", "hunter2hunter2"


@pytest.fixture
def deployment(tmp_path, free_endpoint):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "camera.log").write_text(
        "x" * LOG_BYTES + f"\nERROR opening rtsp://admin:{PASSWORD}@10.0.0.7/stream\n"
        f"request with {TOKEN}\nAuthorization: Bearer abcdef123456\n"
        "-----BEGIN PRIVATE KEY-----\nMIIEvQ\n-----END PRIVATE KEY-----\nthe end\n"
    )
    (tmp_path / "operator.login").write_text("operator:secret\n")
    file = tmp_path / "robot.toml"
    file.write_text(
        f'robot = "test"\nstate_dir = "{tmp_path}"\n[router]\nlisten = ["{free_endpoint}"]\n'
        f'[nodes.page]\ntoken = "{TOKEN}"\ncertificate_key = "/etc/page.key"\n'
        f'[nodes.camera]\nsource = "rtsp://admin:{PASSWORD}@10.0.0.7/stream?token=abc123xyz"\n'
    )
    return file


def collected(file, out):
    done = CliRunner().invoke(app, ["bug-report", str(file), "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    with zipfile.ZipFile(out) as bundle:
        return {name: bundle.read(name).decode() for name in bundle.namelist()}


def test_a_report_has_everything_but_secrets(deployment, tmp_path):
    parts = collected(deployment, tmp_path / "report.zip")
    assert set(parts) == {
        "versions.json", "deployment.json", "doctor.json", "health.json", "logs/camera.log",
    }  # fmt: skip
    whole = "\n".join(parts.values())
    for secret in (TOKEN, PASSWORD, "abc123xyz", "abcdef123456", "MIIEvQ", "page.key"):
        assert secret not in whole, secret
    options = json.loads(parts["deployment.json"])
    assert options["robot"] == "test"
    assert options["nodes"]["page"]["token"] == "REMOVED"
    assert options["nodes"]["camera"]["source"].endswith("@10.0.0.7/stream?token=REMOVED")
    versions = json.loads(parts["versions.json"])
    assert {"beamsplat", "python", "platform", "packages", "memory_mb"} <= versions.keys()
    assert versions["packages"]["numpy"]
    assert {"subject", "verdict", "text", "remedy"} <= json.loads(parts["doctor.json"])[0].keys()
    assert "error" in json.loads(parts["health.json"])  # nothing runs
    assert parts["logs/camera.log"].endswith("the end\n")
    assert len(parts["logs/camera.log"]) <= LOG_BYTES


def test_the_health_of_a_running_system_is_in_it(deployment, tmp_path, free_endpoint):
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as session:
        bus = Bus(session, "test", "replay", "ab" * 8, 1)

        stop = threading.Event()

        def report():
            while not stop.wait(0.2):
                bus.publish_health(
                    Health(stamp_ns=1, node="replay", instance="ab" * 8, epoch=1, state="active")
                )

        thread = threading.Thread(target=report)
        thread.start()
        time.sleep(0.3)
        try:
            parts = collected(deployment, tmp_path / "report.zip")
        finally:
            stop.set()
            thread.join()
    assert json.loads(parts["health.json"])["nodes"]["replay"]["state"] == "active"


def test_names_of_options_that_hold_secrets():
    table = {"api_key": "k1234", "keys": ["a1234", "b1234"], "monkey": "m", "keyframes": 3, "password": ""}
    redactor = Redactor()
    assert redactor.table(table) == {
        "api_key": "REMOVED", "keys": "REMOVED", "monkey": "m", "keyframes": 3, "password": "",
    }  # fmt: skip
    assert redactor.text("k1234 b1234 m") == "REMOVED REMOVED m"


def test_a_name_without_zip_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"expected a name ending in .zip"):
        CliRunner().invoke(app, ["bug-report", "--out", str(tmp_path / "report")], catch_exceptions=False)
