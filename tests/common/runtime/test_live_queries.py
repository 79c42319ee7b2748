"""Queries to a live node on a real router: whatever one raises is an error answer, and the node goes on."""

import threading

import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer, Health
from beamsplat.common.runtime.live import Live
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Node
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.common.zenoh.queries import ask, command
from tests.common.polling import wait_until


class Answering(Node):
    """Answers queries, some of them with a fault."""

    name = "depth"
    inputs = ("camera/image",)
    outputs = ()

    def on_camera_image(self, message):
        return iter(())

    def on_query_text(self, parameters):
        yield Answer(stamp_ns=0, text="here")

    def on_query_division(self, parameters):
        yield Answer(stamp_ns=0, text=str(1 / int(parameters["by"])))

    def on_query_early(self, parameters):
        raise RuntimeError("no generator")

    def on_query_refused(self, parameters):
        raise UserError("by=7: expected 8")
        yield


@pytest.fixture
def live(tmp_path, free_endpoint):
    """A session beside a running node, and the health reports of the node."""
    with open_router((free_endpoint,)):
        node = Live(Answering(Answering.Config()), LiveSettings("test", (free_endpoint,), tmp_path))
        thread = threading.Thread(target=node.run)
        thread.start()
        session = open_session((free_endpoint,))
        reports: list[Health] = []
        with Bus(session, "test", "top", "ab" * 8, 0) as bus:
            bus.watch_health(reports.append, print)
            yield session, reports
            node.stop()
            thread.join(10.0)
        assert not thread.is_alive()


def test_a_fault_in_a_query_is_its_answer_and_is_counted_where_the_user_looks(live):
    session, reports = live
    for query, parameters, words in (
        ("division", {"by": "0"}, "ZeroDivisionError: division by zero"),
        ("division", {}, "KeyError: 'by'"),
        ("early", {}, "RuntimeError: no generator"),
        ("refused", {}, "depth rejected refused: by=7: expected 8"),
    ):
        with pytest.raises(UserError, match=words):
            list(ask(session, "test", "depth", query, parameters, 5.0))
    assert [a.text for a in ask(session, "test", "depth", "text", {}, 5.0)] == ["here"]
    expected = "3 queries failed (last: early: RuntimeError: no generator)"
    wait_until(lambda: any(expected in report.detail for report in reports), 5.0)


@pytest.mark.parametrize(
    "after", ["", "[]", "{", "null", '{"said": {"a": null}}', '{"said": {"a": Infinity}}', '{"handled": {"a": 3}}',
              '{"handled": {"a": {"b": ["x", []]}}}', '{"said": 3}', "[" * 50_000],
)  # fmt: skip
def test_a_control_request_with_garbage_is_refused_and_changes_nothing(tmp_path, free_endpoint, after):
    with open_router((free_endpoint,)):
        settings = LiveSettings("test", (free_endpoint,), tmp_path, standby=True, instance="ef" * 8)
        node = Live(Answering(Answering.Config()), settings)
        thread = threading.Thread(target=node.run)
        thread.start()
        with open_session((free_endpoint,)) as session:
            assert command(session, "test", ("depth", "ef" * 8), "reached", {}, 10.0) == "{}"
            with pytest.raises(UserError, match="rejected activate"):
                command(session, "test", ("depth", "ef" * 8), "activate", {"after": after}, 5.0)
            assert node.running.handover.standby
            for verb in ("retired", "*", "activate/x"):
                with pytest.raises(UserError):
                    command(session, "test", ("depth", "ef" * 8), verb, {}, 1.0)
            assert command(session, "test", ("depth", "ef" * 8), "reached", {}, 5.0) == "{}"
        node.stop()
        thread.join(10.0)
        assert not thread.is_alive()
