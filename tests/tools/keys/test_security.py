"""Access control of an edge's router with real certificates: which hosts may connect, and what each may
do.
"""

import contextlib
import time
from datetime import UTC, datetime

import pytest
import zenoh

from beamsplat.common.errors import UserError
from beamsplat.common.security.access_control import HostRole, access_control, read_hosts
from beamsplat.common.security.keys import (
    CA,
    CERTIFICATE,
    HOSTS,
    KEY,
    HostKeys,
    SecurityConfig,
    check_endpoint,
    is_loopback,
)
from beamsplat.common.topics import TOPICS, topic
from beamsplat.common.zenoh.bridge import Bridge, BridgeSessions
from beamsplat.common.zenoh.bus import Bus, open_link, open_router, open_session
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample
from beamsplat.tools.keys.certificates import (
    certificate_as_pem,
    is_issued_by,
    make_host_certificate,
    read_certificate,
    read_key,
)
from beamsplat.tools.keys.pki import CertificateAuthority
from tests.common.polling import publish_until_received
from tests.common.samples import sample_messages
from tests.conftest import free_port

NAMES = {"edge": "edge", "r1": "robot", "r2": "robot", "watcher": "monitor", "chief": "operator"}


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    made = CertificateAuthority.create(tmp_path_factory.mktemp("authority"))
    for name, role in NAMES.items():
        host = HostRole(role=role, robot=name if role == "robot" else "*")
        made.issue(name, host, ("127.0.0.1", "localhost") if role == "edge" else ())
    return made


@pytest.fixture(scope="module")
def edge(authority):
    """(endpoint for this host's processes, endpoint for others) of a router with access control."""
    near, far = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    with open_router((near, far), security=SecurityConfig(keys=authority.folder / "hosts" / "edge")):
        yield near, far


def link(authority, edge, name):
    return open_link(edge[1], 2.0, SecurityConfig(keys=authority.folder / "hosts" / name))


def wait(until, timeout_s=30.0):
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if until():
            return
        time.sleep(0.02)
    raise AssertionError(f"not within {timeout_s} s")


def publish_until(condition, session, keys):
    """Publish to all `keys`, in this order, until `condition()`: what comes first was denied before the rest arrived."""

    def done():
        for key in keys:
            session.put(key, b"x")
        return condition()

    wait(done)


def subscribe_keys(session, pattern):
    received_keys = []
    subscriber = session.declare_subscriber(pattern, lambda s: received_keys.append(str(s.key_expr)))
    return received_keys, subscriber


# --- authentication ---


def test_a_host_with_a_certificate_connects(authority, edge):
    with link(authority, edge, "r1") as session:
        assert list(session.info.routers_zid())


def copy(authority, name, folder):
    folder.mkdir()
    for file in (CA, CERTIFICATE, KEY):
        data = (authority.folder / "hosts" / name / file).read_bytes()
        (folder / file).write_bytes(data)
        (folder / file).chmod(0o600)
    return folder


def assert_rejected(edge, folder):
    with pytest.raises(UserError, match="no router answers"):
        open_link(edge[1], 2.0, SecurityConfig(keys=folder)).close()


def test_a_host_without_a_certificate_is_rejected(authority, edge, tmp_path):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect", f'{{endpoints: ["{edge[1]}"], timeout_ms: 2000, exit_on_failure: true}}')
    config.insert_json5(
        "transport/link/tls",
        f'{{root_ca_certificate: "{authority.folder / CA}", verify_name_on_connect: true}}',
    )
    with pytest.raises(zenoh.ZError):
        zenoh.open(config).close()
    plain = SecurityConfig(plain=True)
    with pytest.raises(UserError, match="no router answers"):
        open_link(edge[1].replace("tls/", "tcp/"), 1.0, plain).close()


def test_a_certificate_of_another_authority_is_rejected(authority, edge, tmp_path):
    other = CertificateAuthority.create(tmp_path / "other")
    other.issue("r1", HostRole(role="robot", robot="r1"))
    folder = copy(other, "r1", tmp_path / "r1")
    assert_rejected(edge, folder)  # neither side knows the other's authority
    (folder / CA).write_bytes((authority.folder / CA).read_bytes())
    assert_rejected(edge, folder)  # the host would trust the edge; the edge does not trust the host


def test_an_expired_certificate_is_rejected(authority, edge, tmp_path):
    folder = copy(authority, "r1", tmp_path / "r1")
    signer = read_certificate(authority.folder / CA), read_key(authority.folder / "ca.key")
    expired = make_host_certificate(
        "r1", (), read_key(folder / KEY), signer, datetime(2020, 1, 1, tzinfo=UTC), days=31
    )
    (folder / CERTIFICATE).write_bytes(certificate_as_pem(expired))
    assert_rejected(edge, folder)


def test_a_robot_rejects_an_edge_of_another_name(authority, tmp_path):
    authority.issue("elsewhere", HostRole(role="edge"), ("edge.example",))
    near, far = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    with open_router((near, far), security=SecurityConfig(keys=authority.folder / "hosts" / "elsewhere")):
        assert_rejected((near, far), authority.folder / "hosts" / "r1")
    authority.remove("elsewhere")


def test_unprotected_links_to_other_hosts_are_rejected(tmp_path):
    for endpoint in ("tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "udp/[::]:7447"):
        with pytest.raises(UserError, match="unprotected"):
            open_router((endpoint,))
        check_endpoint(endpoint, SecurityConfig(plain=True))
    for endpoint in ("tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:1", "unixsock-stream//run/x"):
        assert is_loopback(endpoint)
    with pytest.raises(UserError, match="needs the host's keys"):
        open_router(("tls/127.0.0.1:7448",))
    with pytest.raises(UserError, match="is missing"):
        open_link("tls/127.0.0.1:7448", 1.0, SecurityConfig(keys=tmp_path))


def test_a_key_that_others_can_read_is_rejected(authority, tmp_path):
    folder = copy(authority, "r1", tmp_path / "r1")
    (folder / KEY).chmod(0o644)
    with pytest.raises(UserError, match="can be read by others"):
        HostKeys.of(SecurityConfig(keys=folder))


# --- what each may do ---


def test_a_robot_may_publish_only_its_own_uplink_topics(authority, edge):
    allowed = [f"beamsplat/r1/{name}" for name, row in TOPICS.items() if row.uplink in ("up", "bulk")]
    allowed += ["beamsplat/r1/health/uplink", "beamsplat/r1/end/keyframes/frame"]
    forbidden = [
        "beamsplat/r2/localization/odometry", "beamsplat/r1/keyframes/ack", "beamsplat/r1/camera/image",
        "beamsplat/r1/mapping/chunk", "beamsplat/other", "anything", "beamsplat/r2/health/uplink",
    ]  # fmt: skip
    with open_session((edge[0],)) as local, link(authority, edge, "r1") as robot:
        received_keys, subscriber = subscribe_keys(local, "**")
        publish_until(lambda: set(received_keys) >= set(allowed), robot, forbidden + allowed)
        assert set(received_keys) == set(allowed)
        subscriber.undeclare()


def test_a_robot_receives_only_its_own_downlink_topics(authority, edge):
    with open_session((edge[0],)) as local, link(authority, edge, "r1") as robot:
        received_keys, subscriber = subscribe_keys(robot, "beamsplat/r1/keyframes/ack")
        others = [
            subscribe_keys(robot, p)
            for p in ("beamsplat/r2/keyframes/ack", "beamsplat/r2/**", "beamsplat/r1/camera/*")
        ]
        queryable = local.declare_queryable(
            "beamsplat/r1/query/mapping/set_params", lambda q: q.reply(q.key_expr, b"1")
        )
        names = ("r2/keyframes/ack", "r1/camera/image", "r1/localization/odometry", "r1/keyframes/ack")
        publish_until(lambda: len(received_keys) >= 3, local, [f"beamsplat/{name}" for name in names])
        assert set(received_keys) == {"beamsplat/r1/keyframes/ack"}
        assert [h for h, _ in others] == [[], [], []]
        assert list(robot.get("beamsplat/r1/query/mapping/set_params", timeout=2.0)) == []
        for thing in (subscriber, queryable, *(k for _, k in others)):
            thing.undeclare()


@pytest.mark.parametrize(("name", "may_change"), [("watcher", False), ("chief", True)])
def test_a_monitor_may_read_everything_and_change_nothing(authority, edge, name, may_change):
    def answer(query):
        with query:
            query.reply(query.key_expr, b"1")

    with open_session((edge[0],)) as local, link(authority, edge, name) as monitor:
        received_keys, subscriber = subscribe_keys(local, "**")
        seen, watching = subscribe_keys(monitor, "beamsplat/*/**")
        answers = [
            local.declare_queryable(f"beamsplat/r1/query/mapping/{q}", answer)
            for q in ("snapshot", "set_params")
        ]
        token = local.liveliness().declare_token("beamsplat/r1/alive/mapping/x")
        published = ["beamsplat/r1/mapping/chunk", "beamsplat/r2/health/mapping"]
        publish_until(lambda: received_keys and set(published) <= set(seen), local, published)
        for _ in range(5):
            monitor.put("beamsplat/r1/keyframes/ack", b"1")
        wait(lambda: len(list(monitor.get("beamsplat/r1/query/mapping/snapshot", timeout=2.0))) == 1)
        assert "beamsplat/r1/keyframes/ack" not in received_keys
        assert len(list(monitor.get("beamsplat/r1/query/mapping/set_params", timeout=2.0))) == may_change
        assert len(list(monitor.liveliness().get("beamsplat/*/alive/**", timeout=2.0))) == 1
        for thing in (subscriber, watching, token, *answers):
            thing.undeclare()


@pytest.mark.parametrize("name", [n for n, row in TOPICS.items() if row.uplink])
def test_every_uplink_topic_passes_access_control_with_its_history(authority, edge, name, free_endpoint):
    """Latched values and caches too: their `@adv` keys need rules of their own."""
    row = topic(name)
    message = next(m for m in sample_messages() if type(m) is row.message)
    with open_router((free_endpoint,)), contextlib.ExitStack() as stack:
        near = stack.enter_context(open_session((free_endpoint,)))
        local = stack.enter_context(open_session((edge[0],)))
        here, there = (local, near) if row.uplink == "down" else (near, local)
        publication = Bus(here, "r1", row.producers[0], "ab" * 8, 1).publish(name)
        publication.put(message)
        sessions = BridgeSessions(stack.enter_context(open_session((free_endpoint,))), link(authority, edge, "r1"),
                      link(authority, edge, "r1"))  # fmt: skip
        stack.enter_context(sessions.edge)
        stack.enter_context(sessions.edge_bulk)
        bridge = Bridge("r1", sessions)
        received_keys = []
        take = lambda s: received_keys.append(decode_sample(s, row).message)  # noqa: E731
        subscriber = [declare_subscription(there, f"beamsplat/r1/{name}", row, "every", take)]
        if row.delivery == "latched":
            wait(lambda: len(received_keys) == 1)  # published before anybody listened
        # Of a robot at rest, one pose per second crosses.
        publish_until_received(publication, message, received_keys, later_ns=2 * 10**9)
        assert bridge.forwarded[name].messages >= len(received_keys)
        assert subscriber


def test_a_removed_robot_connects_but_has_no_rights(authority, tmp_path):
    """Removed from the policy: its certificate is still valid, but gives no access."""
    made = CertificateAuthority.create(tmp_path / "authority")
    made.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    made.issue("r1", HostRole(role="robot", robot="r1"))
    folder = copy(made, "r1", tmp_path / "r1")
    made.remove("r1")
    assert set(read_hosts(made.folder / "hosts" / "edge")) == {"edge"}
    near, far = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    with (
        open_router((near, far), security=SecurityConfig(keys=made.folder / "hosts" / "edge")),
        open_session((near,)) as local,
        open_link(far, 2.0, SecurityConfig(keys=folder)) as robot,
    ):
        received_keys, subscriber = subscribe_keys(local, "**")

        def received_often():
            robot.put("beamsplat/r1/localization/odometry", b"x")
            local.put("beamsplat/r1/tick", b"x")
            return len(received_keys) >= 10

        wait(received_often)
        assert set(received_keys) == {"beamsplat/r1/tick"}
        subscriber.undeclare()


# --- the authority ---


def test_renewed_keys_replace_the_old_and_the_policy_stays(authority, tmp_path):
    made = CertificateAuthority.create(tmp_path)
    folder = made.issue("r1", HostRole(role="robot", robot="r1"), days=1)
    before = {name: (folder / name).read_bytes() for name in (KEY, CERTIFICATE)}
    made.issue("r1", HostRole(role="robot", robot="r1"), days=30)
    assert all((folder / name).read_bytes() != data for name, data in before.items())
    assert (folder / KEY).stat().st_mode & 0o077 == 0
    assert list(made.hosts()) == ["r1"]
    assert is_issued_by(read_certificate(folder / CERTIFICATE), read_certificate(made.folder / CA))
    with pytest.raises(UserError, match="never replaced"):
        CertificateAuthority.create(tmp_path)
    with pytest.raises(UserError, match="no host 'r2'"):
        made.remove("r2")
    with pytest.raises(UserError, match="--address"):
        made.issue("edge", HostRole(role="edge"))
    with pytest.raises(UserError, match="contains no authority"):
        CertificateAuthority(tmp_path / "hosts")


def test_an_invalid_policy_is_rejected(tmp_path):
    with pytest.raises(UserError, match="is missing"):
        read_hosts(tmp_path)
    for text in ('[r1]\nrole = "king"', "[r1", '[r1]\nrole = "robot"\nrobot = "r1/**"', "r1 = 3"):
        (tmp_path / HOSTS).write_text(text)
        with pytest.raises(UserError, match="not a table of hosts"):
            read_hosts(tmp_path)


def test_the_policy_follows_the_topic_table():
    policy = access_control({"r1": HostRole(role="robot", robot="r1")})
    assert policy["default_permission"] == "deny"
    writes = next(r for r in policy["rules"] if r["id"] == "r1 publish")
    assert {
        k for k in writes["key_exprs"] if "@adv" not in k and "/end/" not in k and "/health/" not in k
    } == {f"beamsplat/r1/{name}" for name, row in TOPICS.items() if row.uplink in ("up", "bulk")}


def test_damaged_files_of_an_authority_are_reported(tmp_path):
    made = CertificateAuthority.create(tmp_path)
    for file, text in ((CA, "no certificate can be read"), ("ca.key", "no private key can be read")):
        data = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(data[:100])
        with pytest.raises(UserError, match=f"{file}: {text}"):
            made.issue("r1", HostRole(role="robot", robot="r1"))
        (tmp_path / file).write_bytes(data)
    with pytest.raises(UserError, match="no certificate can be made"):
        made.issue("r" * 65, HostRole(role="robot", robot="r1"))
    with pytest.raises(UserError, match="no certificate can be made"):
        made.issue("edge", HostRole(role="edge"), ("büro.example",))
    assert list(made.hosts()) == []
    assert not (tmp_path / "hosts").exists()
