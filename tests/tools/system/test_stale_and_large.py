"""What was recorded and is played back, and what is too large, by somebody with a robot's valid certificate."""

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import psutil
import pytest

from beamsplat.common.messages import Odometry
from beamsplat.common.messages.header import DecodeError
from beamsplat.common.messages.instances import process_of
from beamsplat.common.runtime.mailbox import Mailbox
from beamsplat.common.runtime.node import Input
from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import SecurityConfig
from beamsplat.common.topics import LIMIT_KB, TOPICS, topic
from beamsplat.common.zenoh.bus import Bus, open_link, open_router, open_session
from beamsplat.common.zenoh.streams import decode_sample
from beamsplat.tools.keys.pki import CertificateAuthority
from tests.common.nodes import Sink
from tests.conftest import free_port
from tests.tools.keys.test_security import wait
from tests.tools.system.hostile import open_hostile

POSE = "localization/odometry"


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    made = CertificateAuthority.create(tmp_path_factory.mktemp("authority"))
    made.issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    made.issue("r1", HostRole(role="robot", robot="r1"))
    return made.folder / "hosts"


@pytest.fixture
def edge(keys):
    near, far = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
    with open_router((near, far), security=SecurityConfig(keys=keys / "edge")):
        yield near, far


def pose(number):
    return Odometry(stamp_ns=number, T_odom_body=np.eye(4), covariance=np.eye(3))


class Listener:
    """A node's inputs as the live runner takes them: with counters, which `top` shows as bad."""

    def __init__(self, session):
        self.mailbox, self.why = Mailbox(Sink), []
        self._bus = Bus(session, "r1", "recorder", "cd" * 8, 1)
        self._bus.subscribe(Input(POSE), self.mailbox.put, lambda t, reason: self.why.append(reason), print)

    @property
    def count(self):
        return self.mailbox.counts[POSE]

    def taken(self):
        return len(self.mailbox)


def test_messages_that_were_heard_and_are_said_again_are_counted_as_stale(keys, edge):
    """Once more from the same epoch, and those of a predecessor after its successor has begun."""
    with (
        open_session(edge[:1]) as local,
        open_link(edge[1], 2.0, SecurityConfig(keys=keys / "r1")) as robot,
        open_hostile(edge[1], keys / "r1") as hostile,
    ):
        captured = []
        ear = local.declare_subscriber(f"beamsplat/r1/{POSE}", captured.append)
        listener = Listener(local)
        time.sleep(0.5)
        processes = [process_of(b"seed", "localization", epoch) for epoch in (1, 2)]
        says = [Bus(robot, "r1", p.node, p.instance, p.epoch).publish(POSE) for p in processes]
        for number in range(20):
            says[number // 10].put(pose(number))
        wait(lambda: listener.taken() == 20 and len(captured) == 20)
        ear.undeclare()
        for sample in captured:
            hostile.put(
                sample.key_expr, sample.payload, encoding=sample.encoding, attachment=sample.attachment
            )
        wait(lambda: listener.count.stale == 20)
        says[1].put(pose(20))
        wait(lambda: listener.taken() == 21)
        assert listener.why == []


def test_the_highest_epoch_with_the_keys_of_the_robot_does_not_silence_its_stream(keys, edge):
    with (
        open_session(edge[:1]) as local,
        open_link(edge[1], 2.0, SecurityConfig(keys=keys / "r1")) as robot,
        open_link(edge[1], 2.0, SecurityConfig(keys=keys / "r1")) as hostile,
    ):
        listener = Listener(local)
        time.sleep(0.5)
        first, second = (process_of(b"seed", "localization", epoch) for epoch in (1, 2))
        says = Bus(robot, "r1", first.node, first.instance, first.epoch).publish(POSE)
        for number in range(10):
            says.put(pose(number))
        wait(lambda: listener.taken() == 10)
        claims = Bus(hostile, "r1", "localization", "ab" * 8, 2**32 - 1).publish(POSE)
        for number in range(10):
            claims.put(pose(1000 + number))
        wait(lambda: listener.count.refused == 10)
        for number in range(10, 20):
            says.put(pose(number))
        wait(lambda: listener.taken() == 20)
        # The robot's own next process takes over at once, as after a restart.
        restarted = Bus(robot, "r1", second.node, second.instance, second.epoch).publish(POSE)
        restarted.put(pose(20))
        wait(lambda: listener.taken() == 21)
        assert (listener.count.stale, listener.count.refused, listener.why) == (0, 10, [])


def record(port, target, tape):
    """Passes one connection on to `target`, and keeps what the one who connects says."""
    listener = socket.create_server(("127.0.0.1", port))

    def carry(a, b, keep):
        while data := a.recv(65536):
            if keep:
                tape.extend(data)
            b.sendall(data)

    def run():
        near, _ = listener.accept()
        far = socket.create_connection(("127.0.0.1", target))
        threading.Thread(target=carry, args=(far, near, False), daemon=True).start()
        carry(near, far, True)
        far.close()
        listener.close()

    threading.Thread(target=run, daemon=True).start()


def test_the_bytes_of_a_whole_connection_played_back_open_nothing(keys, edge):
    tape, port, target = bytearray(), free_port(), int(edge[1].rpartition(":")[2])
    record(port, target, tape)
    with open_session(edge[:1]) as local:
        heard = []
        ear = local.declare_subscriber("beamsplat/**", heard.append)
        with open_link(f"tls/127.0.0.1:{port}", 2.0, SecurityConfig(keys=keys / "r1")) as robot:
            time.sleep(0.3)
            for _ in range(10):
                robot.put(f"beamsplat/r1/{POSE}", b"x" * 100)
            wait(lambda: len(heard) == 10)
        assert len(tape) > 1000
        with socket.create_connection(("127.0.0.1", target)) as again:
            again.settimeout(5.0)
            again.sendall(bytes(tape))
            with contextlib.suppress(OSError):
                while again.recv(4096):  # until it ends the connection, or waits for what the tape cannot say
                    pass
        time.sleep(0.5)
        assert len(heard) == 10
        with open_link(edge[1], 2.0, SecurityConfig(keys=keys / "r1")) as robot:  # the door still works
            time.sleep(0.3)
            robot.put(f"beamsplat/r1/{POSE}", b"x")
            wait(lambda: len(heard) == 11)
        ear.undeclare()


def test_a_message_of_200_mb_stays_outside_and_does_not_fill_the_routers_memory(keys, edge):
    """The router runs in this process: what it takes shows here."""
    process = psutil.Process(os.getpid())
    with open_session(edge[:1]) as local:
        heard = []
        ear = local.declare_subscriber("beamsplat/**", heard.append)
        before, most, done = process.memory_info().rss, [0], threading.Event()

        def watch():
            while not done.wait(0.02):
                most[0] = max(most[0], process.memory_info().rss)

        threading.Thread(target=watch, daemon=True).start()
        command = [
            sys.executable,
            "-m",
            "tests.tools.system.hostile",
            edge[1],
            str(keys / "r1"),
            "--megabytes",
        ]
        subprocess.run([*command, "200"], check=True, timeout=120)
        done.set()
        assert heard == []
        assert most[0] - before < 3 * LIMIT_KB * 1000
        subprocess.run([*command, "20"], check=True, timeout=120)  # what may be so large for some topic
        wait(lambda: [len(s.payload) for s in heard] == [20_000_000])
        with pytest.raises(DecodeError, match="without a header"):
            decode_sample(heard[0], topic("keyframes/frame"))
        ear.undeclare()


def test_what_is_too_large_for_its_topic_is_refused_before_it_is_decoded(keys, edge):
    with open_session(edge[:1]) as local, open_hostile(edge[1], keys / "r1") as hostile:
        captured = []
        ear = local.declare_subscriber(f"beamsplat/r1/{POSE}", captured.append)
        listener = Listener(local)
        time.sleep(0.5)
        says = Bus(hostile, "r1", "localization", "ab" * 8, 1).publish(POSE)
        says.put(pose(1))
        wait(lambda: captured)
        ear.undeclare()
        (sample,) = captured
        large = bytes(TOPICS[POSE].limit_kb * 1000 + 1)
        hostile.put(sample.key_expr, large, encoding=sample.encoding, attachment=sample.attachment)
        wait(lambda: listener.why)
        assert listener.why == ["0.1 MB on localization/odometry, the limit is 0.064 MB (common/topics.py)"]
        assert listener.taken() == 1


def test_every_topic_that_crosses_has_a_limit_of_its_own():
    crossing = [row for row in TOPICS.values() if row.uplink]
    assert all(0 < row.limit_kb < LIMIT_KB for row in crossing)
    assert topic("camera/image").limit_kb == LIMIT_KB
