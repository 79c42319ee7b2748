"""Messages that are too large are refused by their sender, and queries are rejected when too many wait."""

import threading

import numpy as np
import pytest

from beamsplat.common.config.deployment import NodeConfig
from beamsplat.common.errors import UserError
from beamsplat.common.messages import Anchors, Answer, Image
from beamsplat.common.runtime.live import Live
from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.common.runtime.node import Node
from beamsplat.common.topics import LIMIT_KB
from beamsplat.common.zenoh.queries import ask, reply
from tests.common.polling import wait_until


def image(size):
    return Image(stamp_ns=7, width_px=640, height_px=480, encoding="jpeg", data=np.zeros(size, np.uint8))


def anchors(count):
    T = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    return Anchors(stamp_ns=7, anchor_ids=np.arange(count), T_map_anchor=T)


def test_a_message_beyond_the_limit_of_its_topic_is_refused_by_its_sender(make_bus, caplog):
    publication = make_bus("localization").publish("localization/anchors")
    assert publication.put(anchors(1000)).sequence == 0
    for _ in range(3):
        assert publication.put(anchors(40_000)) is None
    assert publication.put(anchors(1000)).sequence == 1  # no gap
    assert (publication.sent, publication.refused) == (2, 3)
    (record,) = caplog.records
    assert "localization/anchors: 5.44 MB in a Anchors with stamp 7, the limit is 4 MB" in record.getMessage()


def test_an_answer_beyond_the_limit_is_an_error(make_bus, robot):
    node, client = make_bus("depth"), make_bus("page")
    node.answer_queries(lambda name, query: reply(query, iter([image(LIMIT_KB * 1000 + 1)])))
    node.announce(("image",))
    with pytest.raises(UserError, match=r"32\.00 MB in a Image with stamp 7, the limit is 32 MB"):
        list(ask(client.session, robot, "depth", "image", {}, 10.0))


class Busy(Node):
    """Does not answer queries while `proceed` is not set."""

    name = "localization"
    outputs = ("localization/odometry",)

    def __init__(self):
        super().__init__(NodeConfig())
        self.proceed = threading.Event()

    def source(self):
        while not self.proceed.wait(0.05):
            pass
        while True:
            self.proceed.wait(0.02)
            yield None

    def on_query_count(self, parameters):
        yield Answer(stamp_ns=0, text="counted")


def test_too_many_waiting_queries_are_rejected_and_counted(router_endpoint, robot, make_bus, tmp_path):
    live = Live(Busy(), LiveSettings(robot, (router_endpoint,), tmp_path))
    thread = threading.Thread(target=live.run)
    thread.start()
    client = make_bus("page").session
    answers = []

    def request():
        try:
            answers.extend(a.text for a in ask(client, robot, "localization", "count", {}, 30.0))
        except UserError as error:
            answers.append(str(error))

    wait_until(lambda: live.running.state == "active")
    askers = [threading.Thread(target=request) for _ in range(100)]
    for asker in askers:
        asker.start()
    wait_until(lambda: len(answers) == 36)
    assert {text for text in answers if "64 queries to answer: ask again later" not in text} == set()
    live.running.node.proceed.set()
    for asker in askers:
        asker.join(30.0)
    assert answers.count("counted") == 64
    assert "36 queries rejected: too many at once" in live.running.detail_text()
    live.stop()
    thread.join(10.0)
