"""The link between robot and edge, cut and stalled."""

import socket
import threading

import pytest

from beamsplat.tools.bench.faults.link import LinkProxy


@pytest.fixture
def echo():
    """Port of a server that sends back what it receives."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve(connection):
        with connection:
            while data := connection.recv(4096):
                connection.sendall(data)

    def accept():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(connection,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    yield server.getsockname()[1]
    server.close()


def connect(link):
    connection = socket.create_connection(("127.0.0.1", link.port), timeout=5.0)
    connection.settimeout(5.0)
    return connection


def closed(connection):
    """Whether the other side closes or resets a connection that sends nothing."""
    try:
        return connection.recv(10) == b""
    except ConnectionError:
        return True


def test_a_link_forwards_is_cut_stalls_and_comes_back(echo):
    link = LinkProxy(echo)
    with connect(link) as connection:
        connection.sendall(b"one")
        assert connection.recv(10) == b"one"
        link.set("stalled")
        while link.state != "stalled":
            pass
        connection.sendall(b"two")
        connection.settimeout(0.3)
        with pytest.raises(TimeoutError):
            connection.recv(10)
        link.set("up")
        connection.settimeout(5.0)
        assert connection.recv(10) == b"two"
        link.set("cut")
        assert closed(connection)
    with connect(link) as connection:
        assert closed(connection)
    link.set("up")
    while link.state != "up":
        pass
    with connect(link) as connection:
        connection.sendall(b"three")
        assert connection.recv(10) == b"three"


def test_a_target_that_does_not_listen_closes_the_connection():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with connect(LinkProxy(port)) as connection:
        assert closed(connection)
