"""What each host, each login and each HTTP request may do, tried on real routers and a real page.

The result is compared with what is expected here, with the rules of the routers, and with docs/security_table.md.
"""

import pytest

from beamsplat.common.security.logins import OPERATOR, SUPERVISOR
from beamsplat.common.topics import TOPICS
from beamsplat.services.nodes import NODES
from tests.tools.keys.access_tries import (
    ADMINISTRATION,
    LOCAL,
    OPERATIONS,
    PATTERN,
    edge_router,
    keys,
    local_router,
    query_names,
)
from tests.tools.keys.security_table import DOCUMENT, REQUESTS, policy_allows, render, try_all, try_requests

EVERYTHING = set(OPERATIONS)
SEES = {"read", "watch"}
TOPIC_KINDS = ("up", "bulk", "down", "host")

# Role of another host -> class of key -> operations, on the keys of its own robot(s). What is not listed is denied.
ROBOT = {
    **{f"{kind}{part}": {"put", "delete"} for kind in ("up", "bulk") for part in ("", " end")},
    **{f"{kind} history": {"put", "delete", "answer", "announce"} for kind in ("up", "bulk")},
    "down": SEES, "down end": SEES, "down history": SEES | {"ask"},
    "health": {"put", "delete"} | SEES,
}  # fmt: skip
READER = {
    **{f"{kind}{part}": SEES for kind in TOPIC_KINDS for part in ("", " end")},
    **{f"{kind} history": SEES | {"ask"} for kind in TOPIC_KINDS},
    "health": SEES, "alive": SEES, "failed": SEES, "unknown": SEES, "request": SEES, "operator": SEES,
    "reading query": SEES | {"ask"}, "changing query": SEES, PATTERN: {"read"},
}  # fmt: skip
CHANGER = {**READER, "changing query": SEES | {"ask"}}
NOTHING: dict[str, set[str]] = {}
EDGE_ROLES = {
    "robot": ROBOT, "another_robot": NOTHING, "monitor": READER, "monitor_of_another": NOTHING, "operator": CHANGER,
    "operator_of_another": NOTHING, "edge": NOTHING, "removed": NOTHING,
}  # fmt: skip


def expected_of_host(subject, key):
    if subject == LOCAL:
        return EVERYTHING
    return EDGE_ROLES[subject].get(key.kind, set())


def expected_of_login(user, key):
    """A node publishes its own topics, reports its own health, answers for itself, and reads everything."""
    if user in (SUPERVISOR, OPERATOR):
        return EVERYTHING
    if key.kind in ("foreign", "administration"):
        return set()
    if key.kind == PATTERN:
        return {"read"}
    topic = key.text.removeprefix("end/").removesuffix("/@adv")
    if topic in TOPICS:
        row = TOPICS[topic]
        mine = row.uplink == "down" if user == "uplink" else user in row.producers
        publishes = {"put", "delete"} if mine else set()
        if key.kind.endswith("history"):
            return SEES | {"ask"} | publishes | ({"answer", "announce"} if mine else set())
        return SEES | publishes
    family, node, *_ = [*key.text.split("/"), ""]
    if family == "health":
        return SEES | ({"put", "delete"} if user in (node, "uplink") else set())
    if family == "alive":
        return SEES | ({"announce"} if user == node else set())
    if family == "query":
        asks = {"ask"} if key.kind == "reading query" or user == "page" else set()
        return SEES | asks | ({"answer"} if user == node else set())
    if family == "control":
        return SEES | ({"answer"} if user == node else set())
    assert key.kind in ("unknown", "failed", "operator")
    return SEES


def differences(subjects, effects, expected):
    """Return lines: subject, operation and key where what had an effect is not what is expected."""
    wrong = []
    for subject in subjects:
        for key in keys():
            wanted = expected(subject, key)
            if key.kind == PATTERN:  # one answer or token for all keys does not exist
                wanted = wanted - {"answer", "announce", "watch"}
            found = {operation for operation in OPERATIONS if (subject, operation, key.key) in effects}
            wrong += [
                f"{subject}: {operation} {key.text}: {'had an effect' if operation in found else 'had none'}"
                for operation in sorted(found ^ wanted)
            ]
    return "\n".join(wrong)


@pytest.fixture(scope="module")
def edge(tmp_path_factory):
    with edge_router(tmp_path_factory.mktemp("edge")) as router:
        return router, try_all(router)


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    with local_router(tmp_path_factory.mktemp("local")) as router:
        return router, try_all(router)


@pytest.fixture(scope="module")
def requests():
    return try_requests()


def test_each_host_may_do_what_its_role_says(edge):
    router, effects = edge
    wrong = differences(router.subjects, effects, expected_of_host)
    assert not wrong, wrong
    asks = {subject for subject in router.subjects if (subject, "ask", ADMINISTRATION.key) in effects}
    assert asks == {LOCAL}


def test_each_login_may_do_what_the_topic_table_says(local):
    router, effects = local
    assert set(router.subjects) == {*NODES, SUPERVISOR, OPERATOR}
    wrong = differences(router.subjects, effects, expected_of_login)
    assert not wrong, wrong
    asks = {subject for subject in router.subjects if (subject, "ask", ADMINISTRATION.key) in effects}
    assert asks == {SUPERVISOR, OPERATOR}


@pytest.mark.parametrize("which", ["edge", "local"])
def test_the_effects_are_those_that_the_rules_allow(request, which):
    router, effects = request.getfixturevalue(which)

    def expected(subject, key):
        return {o for o in OPERATIONS if policy_allows(router.policy, subject, o, key)}

    wrong = differences(router.subjects, effects, expected)
    assert not wrong, wrong


def test_hosts_and_processes_without_credentials_are_refused(edge, local):
    assert edge[0].refused == {"certificate of another authority": True, "no certificate": True}
    assert local[0].refused == {"no login": True, "wrong password": True, "unknown user": True}


def test_every_query_is_tried():
    read = {"snapshot", "render", "state", "poses", "keyframe", "params"}
    assert {*read, "swap", "restart", "unknown"} <= set(query_names())


def test_every_request_to_the_page_is_checked(requests):
    for (method, path), found in requests.items():
        assert found["right token, foreign host name"] == 421, (method, path)
        assert found["right token, page of another origin"] == 403, (method, path)
        statuses = [found[case] for case in list(REQUESTS)[:3]]
        if (method, path) == ("POST", "/command"):
            assert statuses == [401, 401, 200]
        elif path == "any":
            assert statuses == [405] * 3
        else:
            assert method == "GET"
            missing = any(word in path for word in ("picture", "chunk", "keyframe", "viewer"))
            assert statuses == [404 if missing else 400 if path.endswith("render") else 200] * 3
    assert ("GET", "/events") in requests
    assert ("GET", "/status") in requests


def test_the_documented_table_is_up_to_date(edge, local, requests):
    assert DOCUMENT.read_text() == render(edge, local, requests), (
        "run: python -m tests.tools.keys.security_table"
    )
