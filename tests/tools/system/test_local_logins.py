"""Logins of a host's own processes: what each may say on its router, and the whole system under that
policy.
"""

import os
import subprocess
import sys
import time

import pytest
import zenoh

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.errors import UserError
from beamsplat.common.security.access_control import local_access_control
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.security.logins import OPERATOR, SUPERVISOR, USERS, Login, login_of, make_logins
from beamsplat.common.topics import TOPICS, topic
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.common.zenoh.queries import ask
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.health_table import HealthTable
from beamsplat.tools.system.supervisor import Supervisor
from tests.common.polling import poll, publish_until_received
from tests.common.samples import sample_messages
from tests.common.topic_listener import TopicListener
from tests.conftest import free_port
from tests.services.mapping.room_drive import TABLE
from tests.tools.keys.test_security import publish_until, subscribe_keys, wait

POSE = "localization/odometry"


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """(endpoint, security) of a router that asks for logins."""
    security = SecurityConfig(local=tmp_path_factory.mktemp("state") / "logins")
    make_logins(security.local, (*NODES, SUPERVISOR, OPERATOR))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with open_router((endpoint,), security=security):
        yield endpoint, security


def enter(guarded, name):
    return open_session(guarded[:1], 2.0, login=login_of(guarded[1], name))


def test_without_a_login_or_with_a_wrong_one_nobody_comes_in(guarded):
    for login in (None, Login("camera", "guess"), Login("nobody", "x")):
        with pytest.raises(UserError, match="no router answers"):
            open_session(guarded[:1], 0.0, login=login).close()
    enter(guarded, "camera").close()


def test_a_camera_writes_its_own_topics_and_no_pose(guarded):
    own = {f"beamsplat/r1/{n}" for n, row in TOPICS.items() if "camera" in row.producers}
    own |= {"beamsplat/r1/health/camera"}
    others = {f"beamsplat/r1/{n}" for n, row in TOPICS.items() if "camera" not in row.producers}
    others |= {"beamsplat/r1/health/localization", "beamsplat/other", "x", f"beamsplat/r1/end/{POSE}"}
    with enter(guarded, OPERATOR) as ears, enter(guarded, "camera") as camera:
        heard, kept = subscribe_keys(ears, "**")
        publish_until(lambda: set(heard) >= own, camera, [*others, *own])
        assert set(heard) == own
        kept.undeclare()


def test_a_camera_takes_over_no_query_and_commands_nobody(guarded):
    def answer(query):
        with query:
            query.reply(query.key_expr, b"true")

    with enter(guarded, "mapping") as mapper, enter(guarded, "camera") as camera:
        restart = "beamsplat/r1/query/mapping/restart"
        kept = [s.declare_queryable(restart, answer) for s in (camera, mapper)]
        time.sleep(0.5)
        with enter(guarded, "page") as page:
            time.sleep(0.5)
            assert len(list(page.get(restart, target=zenoh.QueryTarget.ALL, timeout=2.0))) == 1
        for name, allowed in {"camera": 0, "monitor": 0, OPERATOR: 1}.items():
            with enter(guarded, name) as asker:
                time.sleep(0.3)
                assert len(list(asker.get(restart, timeout=2.0))) == allowed, name
                assert list(asker.get("beamsplat/r1/control/mapping/ab/retire", timeout=2.0)) == []
        assert kept


@pytest.mark.parametrize("name", list(TOPICS))
def test_every_topic_reaches_a_monitor_with_what_was_said_before(guarded, name):
    """Latched values and caches too: their `@adv` keys need rules of their own."""
    row = topic(name)
    message = next(m for m in sample_messages() if type(m) is row.message)
    with enter(guarded, row.producers[-1]) as producer, enter(guarded, "monitor") as monitor:
        publication = Bus(producer, "r1", row.producers[-1], "ab" * 8, 1).publish(name)
        publication.put(message)
        heard = []
        take = lambda s: heard.append(decode_sample(s, row).message)  # noqa: E731
        kept = declare_subscription(monitor, f"beamsplat/r1/{name}", row, "every", take)
        if row.delivery == "latched":
            wait(lambda: len(heard) == 1)  # said before anybody listened
        publish_until_received(publication, message, heard)
        assert kept


@pytest.mark.slow
def test_the_whole_system_runs_under_the_policy_and_top_shows_it(tmp_path, free_endpoint):
    security = SecurityConfig(local=tmp_path / "logins")
    live = Deployment(
        robot="r1", router=RouterConfig(listen=(free_endpoint,)), state_dir=tmp_path / "state", security=security,
        nodes={
            "replay": {"kind": "room", "pictures": 20}, "localization": {"kind": "known"},
            "fusion": {"kind": "true"}, "keyframes": {"distance_m": 0.15},
            "mapping": {"half_steps": 3, "full_steps": 2},
        },
    )  # fmt: skip
    file = tmp_path / "live.toml"
    file.write_text(
        f'robot = "r1"\n[router]\nlisten = ["{free_endpoint}"]\n[security]\nlocal = "{tmp_path / "logins"}"\n'
        "[nodes.mapping]\n"
    )
    with Supervisor(live, table=TABLE) as supervisor:
        with open_session((free_endpoint,), login=login_of(security, SUPERVISOR)) as session:
            board = HealthTable(session, "r1")
            poses = TopicListener(session, POSE)
            wait_for = lambda: board.states().get("mapping") == "drained"  # noqa: E731
            poll(supervisor, wait_for, 120)
            assert set(board.records) == set(live.nodes)
            poll(supervisor, lambda: "0 not ack" in board.records["keyframes"].health.detail, 10)
            assert len(poses.messages) >= 15
            assert list(ask(session, "r1", "mapping", "snapshot", {}, 10.0))
        top = [sys.executable, "-m", "beamsplat", "top", str(file), "--seconds", "3"]
        shown = subprocess.run(
            top, capture_output=True, text=True, check=True, timeout=60, env=os.environ
        ).stdout
        assert "mapping" in shown
        assert "keyframes" in shown
        assert all(c.restarts == 0 for c in supervisor.children.values())


def test_logins_are_kept_secret_and_faults_are_named(tmp_path):
    folder = tmp_path / "logins"
    security = SecurityConfig(local=folder)
    with pytest.raises(UserError, match="beamsplat run"):
        login_of(security, "camera")
    make_logins(folder, ("camera",))
    first = login_of(security, "camera")
    make_logins(folder, ("camera", "mapping"))
    assert login_of(security, "camera") == first
    assert login_of(security, "mapping").password != first.password
    assert all(p.stat().st_mode & 0o077 == 0 for p in (folder, *folder.iterdir()))
    assert login_of(SecurityConfig(), "camera") is None
    with pytest.raises(UserError, match="can be reached from other hosts"):
        open_router(("tcp/0.0.0.0:0",), security=SecurityConfig(local=folder, plain=True))
    for text, words in (("", "empty"), ("nonsense", "no valid logins")):
        (folder / USERS).write_text(text)
        with pytest.raises(UserError, match=words):
            make_logins(folder, ("camera",))
    (folder / "camera.login").chmod(0o644)
    with pytest.raises(UserError, match="can be read by others"):
        login_of(security, "camera")


def test_the_policy_comes_from_the_topic_table():
    policy = local_access_control(("camera", OPERATOR))
    assert policy["default_permission"] == "deny"
    (writes,) = [r for r in policy["rules"] if r["id"] == "camera publish"]
    data = {k.removeprefix("beamsplat/*/") for k in writes["key_exprs"] if "@adv" not in k}
    assert {k for k in data if k in TOPICS} == {n for n, row in TOPICS.items() if "camera" in row.producers}
