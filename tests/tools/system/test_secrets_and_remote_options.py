"""No secret leaves a process in params, health, log or error; other hosts may set listed options only."""

import json
from urllib.parse import quote

import pytest

from beamsplat.common.config.deployment import Deployment, load_deployment
from beamsplat.common.errors import UserError
from beamsplat.common.runtime.registry import make_node
from beamsplat.common.zenoh.queries import ask
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import faults
from tests.tools.system.test_swap import System

SECRET = "pa55-w0rd"


CAMERA = {"source": f"http://user:{SECRET}@127.0.0.1:9/stream?token={SECRET}"}


@pytest.fixture
def system(tmp_path, free_endpoint):
    nodes = {"camera": CAMERA, "depth": {}, "mapping": {"save": str(tmp_path / "map")}}
    with System(tmp_path, free_endpoint, nodes, table=NODES) as made:
        yield made


def remote_swap(system, node, *changes):
    (answer,) = ask(system.asker, "r1", node, "swap", {"set": quote(json.dumps(changes)), "cold": "1"}, 30.0)
    return answer.text


def test_a_password_in_a_camera_address_is_shown_nowhere(tmp_path, free_endpoint):
    with System(tmp_path, free_endpoint, {"camera": CAMERA}, table=NODES) as system:
        system.wait(lambda: "NOT CONNECTED" in json.dumps(system.board.snapshot()))
        assert SECRET not in json.dumps(system.board.snapshot())
        shown = system.ask("camera", "params")
        assert SECRET not in shown
        assert "127.0.0.1:9" in shown
        with pytest.raises(UserError) as refused:
            system.swap("camera", f'rate_hz="http://user:{SECRET}@host/"', cold="1")
        assert SECRET not in str(refused.value)
    for log in (tmp_path / "logs").iterdir():
        assert SECRET not in log.read_text(), log


@pytest.mark.parametrize(
    ("node", "change"),
    [
        ("mapping", "save=/etc/cron.d"), ("mapping", "session=/tmp/x"), ("camera", "source=/dev/sda"),
        ("depth", "source=os:system"), ("depth", "kind=os:system"), ("depth", "options.model=/tmp/x"),
        ("mapping", "essential=false"),
    ],
)  # fmt: skip
def test_another_host_sets_only_options_that_are_listed(system, node, change):
    option = change.partition("=")[0]
    before = system.supervisor.deployment
    with pytest.raises(UserError, match=rf"{node}\.{option}.*beamsplat swap") as refused:
        remote_swap(system, node, change)
    assert f"--set {change.partition('=')[0]}" in str(refused.value)
    assert system.supervisor.deployment == before


def test_another_host_changes_thresholds_and_the_depth_source_and_the_operator_everything(system, tmp_path):
    assert "starts again" in remote_swap(system, "depth", "source=stixel", "floor_known=false")
    assert "starts again" in system.swap("mapping", f"save={tmp_path / 'other'}", cold="1")


def test_errors_of_options_show_no_secret(tmp_path):
    deployment = Deployment(nodes={"page": {"token": "short-1"}, "camera": {"source": 3, "jpeg_quality": 0}})
    text = " ".join(fault.text for fault in faults(deployment))
    assert "token" in text
    assert "short-1" not in text
    with pytest.raises(UserError) as wrong:
        load_deployment(tmp_path / "none.toml")
    assert "none.toml" in str(wrong.value)
    with pytest.raises(UserError) as wrong:
        make_node(NODES["camera"], {"sourc": f"rtsp://u:{SECRET}@h/"}, "file")
    assert SECRET not in str(wrong.value)
