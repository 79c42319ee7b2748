"""Keyframes and mapper as processes on a real router: the map is made, ends, and survives a killed mapper."""

import os
import signal

import pytest
from plyfile import PlyData
from typer.testing import CliRunner

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import open_session
from beamsplat.common.zenoh.streams import decode_sample
from beamsplat.tools.cli.main import app
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll
from tests.services.mapping.room_drive import TABLE


@pytest.fixture
def deployment(tmp_path, free_endpoint):
    def make(pictures, mapping=None, **keyframes):
        return Deployment(
            robot="test", router=RouterConfig(listen=(free_endpoint,)), rate=1.0, state_dir=tmp_path / "state",
            nodes={
                "replay": {"kind": "room", "pictures": pictures},
                "localization": {"kind": "known"},
                "fusion": {"kind": "true"},
                "keyframes": {"distance_m": 0.15, **keyframes},
                "mapping": {"save": str(tmp_path / "map"), "half_steps": 4, "full_steps": 3, "tick_steps": 2,
                            **(mapping or {})},
            },
        )  # fmt: skip

    return make


def detail(board, node):
    record = board.records.get(node)
    return "" if record is None else record.health.detail


def state(board, node):
    record = board.records.get(node)
    return "" if record is None else record.health.state


@pytest.mark.slow
def test_the_live_system_maps_and_ends(deployment, tmp_path):
    live = deployment(14)
    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: state(board, "mapping") == "drained", 90)
        poll(supervisor, lambda: " 0 not acknowledged" in detail(board, "keyframes"), 5)
        received = {i.topic: i for i in board.records["mapping"].health.inputs}["keyframes/frame"]
        assert received.received >= 6
        assert received.lost == received.undecodable == 0
    assert PlyData.read(tmp_path / "map" / "splats.ply")["vertex"].count > 1000


@pytest.mark.slow
def test_unacknowledged_keyframes_are_sent_again_after_a_kill(deployment):
    """The successor starts with an empty map: later keyframes reach it, unanswered ones come again."""
    live = deployment(60, retry_s=1.0)
    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: "3 keyframes" in detail(board, "mapping"), 90)
        first = supervisor.children["mapping"].process.pid
        os.kill(first, signal.SIGKILL)
        poll(supervisor, lambda: supervisor.children["mapping"].process.pid != first, 5)
        poll(supervisor, lambda: state(board, "mapping") == "drained", 120)
        poll(supervisor, lambda: " 0 not acknowledged" in detail(board, "keyframes"), 10)


@pytest.mark.slow
def test_export_from_a_running_mapper(deployment, tmp_path):
    """Without a session on disk: `export` asks, while keyframes go on coming."""
    live = deployment(60)
    file = tmp_path / "robot.toml"
    file.write_text(f'robot = "test"\n[router]\nlisten = {list(live.router.listen)}\n[nodes.mapping]\n')

    def export(to, *words):
        out = tmp_path / f"now.{to}"
        words = ("export", str(file), "--to", to, "--out", str(out), *words)
        result = CliRunner().invoke(app, words, catch_exceptions=False)
        assert result.exit_code == 0
        return out, result.stdout

    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: "4 keyframes" in detail(board, "mapping"), 90)
        whole, _ = export("ply")
        coarse, said = export("spz", "--detail-m", "0.2")
        poll(supervisor, lambda: state(board, "mapping") == "drained", 120)
    made = PlyData.read(whole)["vertex"].count
    assert 1000 < made < PlyData.read(tmp_path / "map" / "splats.ply")["vertex"].count
    assert coarse.stat().st_size < 0.5 * whole.stat().st_size
    assert "dB PSNR against the whole map" in said


def heard(session, name):
    """Ids on a topic, as they come."""
    ids = []
    row = topic(name)
    session.declare_subscriber(
        f"beamsplat/test/{name}", lambda s: ids.append(decode_sample(s, row).message.id)
    )
    return ids


@pytest.mark.slow
def test_queued_keyframes_survive_a_restart_and_reach_a_mapper_started_later(deployment):
    live = deployment(70, durable=True, retry_s=0.5, window=2)
    others = tuple(name for name in live.nodes if name != "mapping")
    with Supervisor(live, ("router",), table=TABLE), open_session(live.router.listen) as session:
        sent, answered = heard(session, "keyframes/frame"), heard(session, "keyframes/ack")
        board = HealthTable(session, "test")
        with Supervisor(live, ("mapping",), table=TABLE) as edge:
            robot = Supervisor(live, others, table=TABLE)
            with robot:
                poll(robot, lambda: len(answered) >= 2, 90)
                edge.stop()  # from now on nobody answers
                poll(robot, lambda: len(set(sent)) >= len(answered) + 4, 60)
                first = robot.children["keyframes"].process.pid
                os.kill(first, signal.SIGKILL)
                poll(robot, lambda: robot.children["keyframes"].process.pid != first, 5)
                poll(robot, lambda: "sent again" in detail(board, "keyframes"), 60)
                unanswered = set(sent) - set(answered)
                assert len(unanswered) >= 4
                with Supervisor(live, ("mapping",), table=TABLE):
                    poll(robot, lambda: state(board, "keyframes") == "drained", 120)
                    poll(robot, lambda: state(board, "mapping") == "drained", 30)
                    assert not set(sent) - set(answered)
                    assert "0 not acknowledged" in detail(board, "keyframes")
                    received = {i.topic: i for i in board.records["mapping"].health.inputs}["keyframes/frame"]
                    assert received.lost == 0
                    assert received.received >= len(unanswered)
    assert not list((live.run_dir / "keyframes").iterdir())


@pytest.mark.slow
def test_a_killed_mapper_with_a_session_loses_no_keyframe(deployment, tmp_path):
    """kill -9 in the middle of the drive: the successor resumes, and ends with every keyframe that was sent."""
    live = deployment(60, {"session": str(tmp_path / "session"), "session_every_s": 2.0}, retry_s=1.0)
    live = live.model_copy(update={"rate": 0.5})  # the successor must be there before the drive ends
    with Supervisor(live, table=TABLE) as supervisor, open_session(live.router.listen) as session:
        board = HealthTable(session, "test")
        poll(supervisor, lambda: "saved at " in detail(board, "mapping"), 90)
        first = supervisor.children["mapping"].process.pid
        os.kill(first, signal.SIGKILL)
        poll(supervisor, lambda: supervisor.children["mapping"].process.pid != first, 5)
        poll(supervisor, lambda: state(board, "mapping") == "drained", 120)
        poll(supervisor, lambda: " 0 not acknowledged" in detail(board, "keyframes"), 10)
        said = dict(words.split(" ", 1)[::-1] for words in detail(board, "keyframes").split(", "))
    folder = SessionFolder(tmp_path / "session")  # the path leaves the room: there nothing has a depth
    kept = int(said["keyframes"]) - int(said.get("refused", 0))
    assert folder.manifest()["keyframes"] == len(folder.keyframe_ids()) == kept > 8
