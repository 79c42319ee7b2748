"""What a campaign makes of what it observes, and hostile clients on a real router."""

import random
import socket
import threading
import time

import pytest

from beamsplat.common.messages.header import Header
from beamsplat.common.topics import TOPICS
from beamsplat.common.zenoh.bus import Bus, open_router, open_session
from beamsplat.tools.bench.faults.campaign import NO_CAUSE, explained
from beamsplat.tools.bench.faults.hostile import (
    HalfOpenConnections,
    HeardMessages,
    hostile_queries,
    send_garbage,
)
from beamsplat.tools.bench.faults.kinds import DECK, deck
from beamsplat.tools.bench.faults.timeline import timeline
from beamsplat.tools.bench.faults.watch import FORGED_INSTANCE, Gap, KeyframeWatch, PoseWatch
from tests.common.polling import wait_until
from tests.common.samples import sample_messages

ROBOT = "r1"


def message(name):
    return next(m for m in sample_messages() if type(m) is TOPICS[name].message)


@pytest.fixture
def session(free_endpoint):
    with open_router((free_endpoint,)), open_session((free_endpoint,)) as opened:
        yield opened


def test_a_deck_has_every_kind_and_depends_on_its_seed():
    assert sorted(k.__name__ for k in deck(random.Random(1))) == sorted(
        kind.__name__ for kind, count in DECK for _ in range(count)
    )
    assert deck(random.Random(1)) == deck(random.Random(1)) != deck(random.Random(2))


def test_only_valid_poses_of_the_real_process_end_a_gap(session):
    watch, row = PoseWatch(), "localization/odometry"
    kept = session.declare_subscriber(f"beamsplat/{ROBOT}/{row}", watch.take)
    real = Bus(session, ROBOT, "localization", "ab" * 8, 1).publish(row)
    forged = Bus(session, ROBOT, "localization", FORGED_INSTANCE, 1).publish(row)
    pose = message(row).model_copy(update={"status": "ok"})
    lost = pose.model_copy(update={"status": "lost"})
    real.put(pose)
    wait_until(lambda: watch.last_s > 0.0)
    watch.began -= 5.0  # as if 5 s had passed
    before = watch.last_s
    forged.put(pose)
    real.put(lost)
    wait_until(lambda: watch.rejected == {"lost": 1})
    assert watch.last_s == before
    assert not watch.gaps
    real.put(pose)
    wait_until(lambda: watch.gaps)
    assert watch.gaps[0].seconds == pytest.approx(5.0, abs=2.0)
    watch.finish()
    assert len(watch.gaps) == 1
    assert watch.gaps[0].rejected == {"lost": 1}
    assert kept


def test_keyframes_are_known_from_the_bus_and_from_the_outbox(session, tmp_path):
    watch = KeyframeWatch(tmp_path)
    (tmp_path / f"{7:020d}.keyframe").touch()
    (tmp_path / ".half.keyframe.1").touch()
    kept = [session.declare_subscriber(f"beamsplat/{ROBOT}/keyframes/frame", watch.take_frame),
            session.declare_subscriber(f"beamsplat/{ROBOT}/keyframes/ack", watch.take_ack)]  # fmt: skip
    frame, ack = message("keyframes/frame"), message("keyframes/ack")
    for instance in (FORGED_INSTANCE, "ab" * 8):
        stamp_ns = 5 if instance == FORGED_INSTANCE else 6
        Bus(session, ROBOT, "keyframes", instance, 1).publish("keyframes/frame").put(
            frame.model_copy(update={"id": stamp_ns, "stamp_ns": stamp_ns})
        )
    acks = Bus(session, ROBOT, "mapping", "cd" * 8, 1).publish("keyframes/ack")
    acks.put(ack.model_copy(update={"id": 6, "status": "ok"}))
    acks.put(ack.model_copy(update={"id": 9, "status": "too dark"}))
    wait_until(lambda: watch.refused)
    assert watch.waiting() == {7}
    assert (watch.made, watch.acknowledged, watch.refused) == ({6, 7}, {6}, {9: "too dark"})
    assert kept


def test_garbage_reaches_every_topic_and_is_never_a_valid_message_of_a_running_process(session):
    keys, headers, lock = set(), [], threading.Lock()

    def take(sample):
        with lock:
            keys.add(str(sample.key_expr).removeprefix(f"beamsplat/{ROBOT}/"))
            if sample.attachment is not None and len(sample.attachment) > 20:
                headers.append(sample.attachment.to_bytes())

    kept = session.declare_subscriber(f"beamsplat/{ROBOT}/**", take)
    heard = HeardMessages(session)
    Bus(session, ROBOT, "replay", "ab" * 8, 3).publish("lidar/scan").put(message("lidar/scan"))
    wait_until(lambda: "lidar/scan" in heard.newest)
    headers.clear()
    rng = random.Random(3)
    wait_until(
        lambda: send_garbage(session, heard, rng, 0.5) and keys >= {*TOPICS, *(f"end/{t}" for t in TOPICS)}
    )
    forged = [Header.unpack(data) for data in headers if data.startswith(b"BS")]
    assert len(forged) > 20
    assert {(header.instance, header.epoch) for header in forged} == {(FORGED_INSTANCE, 0)}
    assert "lidar/scan" in heard.newest  # its own garbage is not heard as a message
    assert kept


def test_hostile_queries_are_sent_to_every_query_and_an_answer_is_counted(session):
    asked = set()

    def answer(query):
        with query:
            asked.add(str(query.key_expr).rpartition("/")[2])
            query.reply_err(b"no")

    kept = session.declare_queryable(f"beamsplat/{ROBOT}/**", answer)
    queries, instances = [("mapping", "snapshot"), ("mapping", "swap")], {"mapping": "ab" * 8}
    wanted = {"snapshot", "swap", "reached", "activate", "nonsense", "retire", "restart"}
    rng = random.Random(2)

    def send():
        sent, unanswered = hostile_queries(session, queries, instances, rng, 0.5)
        assert sent > 0
        assert unanswered == 0
        return asked >= wanted

    wait_until(send)
    assert kept


def test_half_open_connections_are_open_until_they_are_closed():
    with socket.create_server(("127.0.0.1", 0), backlog=64) as server:
        made = HalfOpenConnections(server.getsockname()[1], 20)
        accepted = [server.accept()[0] for _ in range(20)]
        time.sleep(0.1)
        assert made.close() == 20
        for connection in accepted:
            connection.settimeout(5.0)
            while connection.recv(100):
                pass
            connection.close()


def test_a_timeline_shows_faults_gaps_restarts_and_findings():
    picture = timeline(
        90.0, [("kill", 1.0, 1.0, "SIGKILL of <x>"), ("disk full", 20.0, 30.0, "robot's disk")],
        [(1.0, 4.0, "localization was stopped")], [(1.5, "robot: x", True), (2.0, "robot: y", False)],
        [(80.0, "lost")],
    )  # fmt: skip
    assert picture.count("<title>") == 6
    assert "SIGKILL of &lt;x&gt;" in picture


@pytest.mark.parametrize(
    ("faults", "cause", "unexplained_s"),
    [
        ([], NO_CAUSE, 10.0),
        ([(99.0, 104.0, "", 0.0)], NO_CAUSE, 10.0),
        ([(99.0, 104.0, "the sensors failed", 0.0)], "the sensors failed", 6.0),
        ([(99.0, 99.0, "localization was stopped", 20.0)], "localization was stopped", 0.0),
        ([(60.0, 70.0, "localization was stopped", 20.0)], NO_CAUSE, 10.0),
        ([(102.0, 103.0, "a", 0.0), (103.0, 104.0, "localization was stopped", 1.0)], "localization was stopped", 7.0),
        ([(101.0, 106.0, "a", 0.0), (102.0, 103.0, "b", 0.0)], "a", 5.0),
    ],
)  # fmt: skip
def test_of_a_gap_only_the_time_of_faults_and_their_aftermath_is_explained(faults, cause, unexplained_s):
    assert explained(Gap(100.0, 110.0), faults) == (cause, unexplained_s)
