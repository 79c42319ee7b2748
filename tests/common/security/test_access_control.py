"""What each role and each node may do, evaluated from the generated rules as Zenoh does, against the topic table."""

import functools

import pytest
import zenoh

from beamsplat.common.security.access_control import HostRole, access_control, local_access_control
from beamsplat.common.topics import TOPICS
from beamsplat.services.nodes import NODES

HOSTS = {
    "robot": HostRole(role="robot", robot="r1"),
    "monitor": HostRole(role="monitor"),
    "operator": HostRole(role="operator"),
    "monitor_of_r1": HostRole(role="monitor", robot="r1"),
    "edge": HostRole(role="edge"),
}
QUERIES = ("snapshot", "render", "state", "poses", "keyframe", "params", "swap", "set_params", "restart")
READ_ONLY = {"snapshot", "render", "state", "poses", "keyframe", "params"}


@functools.cache
def covers(pattern, key):
    return zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(key))


class Policy:
    """Evaluates an `access_control` configuration for one subject."""

    def __init__(self, config, subject):
        assert config["enabled"]
        assert config["default_permission"] == "deny"
        ids = {rule for p in config["policies"] if subject in p["subjects"] for rule in p["rules"]}
        self.rules = [rule for rule in config["rules"] if rule["id"] in ids]
        assert all(rule["permission"] == "allow" for rule in self.rules)

    def may(self, flow, message, key):
        """Return whether a message passes: `ingress` = from the subject to the router."""
        return any(
            flow in rule["flows"]
            and message in rule["messages"]
            and any(covers(k, key) for k in rule["key_exprs"])
            for rule in self.rules
        )

    def topics(self, flow, message, robot="r1", prefix="", suffix=""):
        """Return the topics on which a message passes."""
        return {t for t in TOPICS if self.may(flow, message, f"beamsplat/{robot}/{prefix}{t}{suffix}")}

    def queries(self, robot="r1", node="mapping"):
        return {q for q in QUERIES if self.may("ingress", "query", f"beamsplat/{robot}/query/{node}/{q}")}


def topics_with(*uplinks):
    return {name for name, row in TOPICS.items() if row.uplink in uplinks}


UP, DOWN, ALL = topics_with("up", "bulk"), topics_with("down"), set(TOPICS)


def role(name):
    return Policy(access_control(HOSTS), name)


@pytest.mark.parametrize("prefix", ["", "end/"])
@pytest.mark.parametrize("suffix", ["", "/@adv/pub/1/2/_"])
def test_a_robot_publishes_what_goes_up_and_receives_what_comes_down(prefix, suffix):
    robot = role("robot")
    where = {"prefix": prefix, "suffix": suffix}
    assert robot.topics("ingress", "put", **where) == UP
    assert robot.topics("egress", "put", **where) == DOWN
    assert robot.topics("ingress", "declare_subscriber", **where) == DOWN


def test_a_robot_has_no_access_to_another_robot():
    robot = role("robot")
    for message in ("put", "delete", "reply", "query", "declare_subscriber", "liveliness_token"):
        assert robot.topics("ingress", message, robot="r2") == set()
    for message in ("put", "reply", "declare_subscriber", "liveliness_token"):
        assert robot.topics("egress", message, robot="r2") == set()
    assert not robot.may("ingress", "put", "beamsplat/r2/health/camera")


def test_a_robot_reports_health_and_receives_the_health_of_the_edge_but_asks_no_node():
    robot = role("robot")
    assert robot.may("ingress", "put", "beamsplat/r1/health/camera")
    assert robot.may("egress", "put", "beamsplat/r1/health/mapping")
    assert robot.queries() == set()
    assert not robot.may("ingress", "query", "beamsplat/r1/control/mapping/0123456789abcdef/retire")
    assert not robot.may("ingress", "put", "another/key")


@pytest.mark.parametrize(("name", "queries"), [("monitor", READ_ONLY), ("operator", set(QUERIES))])
def test_a_monitor_and_an_operator_read_everything_write_nothing_and_ask(name, queries):
    reader = role(name)
    for robot in ("r1", "r2"):
        for message in ("put", "delete", "reply", "declare_queryable", "liveliness_token"):
            assert reader.topics("ingress", message, robot=robot) == set()
        assert reader.topics("ingress", "declare_subscriber", robot=robot) == ALL
        assert reader.topics("egress", "put", robot=robot) == ALL
        assert reader.topics("egress", "put", robot=robot, suffix="/@adv/pub/1/2/_") == ALL
        assert reader.queries(robot) == queries
        assert not reader.may("ingress", "put", f"beamsplat/{robot}/health/camera")
        assert not reader.may(
            "ingress", "query", f"beamsplat/{robot}/control/mapping/0123456789abcdef/retire"
        )


def test_a_monitor_of_one_robot_reads_no_other():
    reader = role("monitor_of_r1")
    assert reader.topics("egress", "put", robot="r1") == ALL
    assert reader.topics("egress", "put", robot="r2") == set()
    assert reader.queries("r1") == READ_ONLY
    assert reader.queries("r2") == set()


def test_the_edge_server_and_unknown_hosts_have_no_rule():
    for name in ("edge", "stranger"):
        assert role(name).rules == []


def test_hosts_are_identified_by_certificate_and_processes_of_the_host_by_the_loopback_interface():
    subjects = {s["id"]: s for s in access_control(HOSTS)["subjects"]}
    assert subjects.pop("local") == {"id": "local", "interfaces": ["lo"], "link_protocols": ["tcp"]}
    assert set(subjects) == set(HOSTS) - {"edge"}
    for name, subject in subjects.items():
        assert subject["cert_common_names"] == [name]
        assert "tcp" not in subject["link_protocols"]
    local = role("local")
    assert local.topics("ingress", "put") == local.topics("egress", "put") == ALL


USERS = (*NODES, "supervisor", "operator")


@functools.cache
def user(name):
    return Policy(local_access_control(USERS), name)


@pytest.mark.parametrize("node", [n for n in NODES if n != "uplink"])
def test_a_node_publishes_its_own_topics_and_reads_all(node):
    own = {name for name, row in TOPICS.items() if node in row.producers}
    for prefix in ("", "end/"):
        assert user(node).topics("ingress", "put", prefix=prefix) == own
        assert user(node).topics("ingress", "put", prefix=prefix, suffix="/@adv/pub/1/2/_") == own
    assert user(node).topics("ingress", "declare_subscriber") == ALL
    assert user(node).topics("egress", "put") == ALL
    assert {n for n in NODES if user(node).may("ingress", "put", f"beamsplat/r1/health/{n}")} == {node}
    tokens = {
        n for n in NODES if user(node).may("ingress", "liveliness_token", f"beamsplat/r1/alive/{n}/00ff")
    }
    assert tokens == {node}


def test_the_uplink_node_publishes_what_comes_down_and_the_health_of_remote_nodes():
    uplink = user("uplink")
    assert uplink.topics("ingress", "put") == DOWN
    assert {n for n in NODES if uplink.may("ingress", "put", f"beamsplat/r1/health/{n}")} == set(NODES)


@pytest.mark.parametrize("node", NODES)
def test_only_the_page_may_send_every_query_and_only_the_supervisor_hand_over_requests(node):
    assert user(node).queries() == (set(QUERIES) if node == "page" else READ_ONLY)
    assert not user(node).may("ingress", "query", "beamsplat/r1/control/mapping/0123456789abcdef/retire")
    assert user("supervisor").may("ingress", "query", "beamsplat/r1/control/mapping/0123456789abcdef/retire")


def test_supervisor_and_operator_may_do_everything_on_their_host():
    for name in ("supervisor", "operator"):
        assert user(name).topics("ingress", "put") == ALL
        assert user(name).queries() == set(QUERIES)
        assert user(name).may("ingress", "query", "@/router/admin")


def test_every_rule_of_a_policy_exists_exactly_once():
    for config in (access_control(HOSTS), local_access_control(USERS)):
        ids = [rule["id"] for rule in config["rules"]]
        assert len(ids) == len(set(ids))
        assert {rule for p in config["policies"] for rule in p["rules"]} == set(ids)
        assert {s for p in config["policies"] for s in p["subjects"]} == {s["id"] for s in config["subjects"]}
