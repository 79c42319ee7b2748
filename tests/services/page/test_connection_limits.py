"""Limits of the page's server against clients that send slowly, read nothing, or open many connections."""

import contextlib
import os
import socket
import ssl

import pytest

from beamsplat.common.security.access_control import HostRole
from beamsplat.common.security.keys import CA, CERTIFICATE, KEY
from beamsplat.services.page import command_requests, listener, server
from beamsplat.services.page.images import EncodedImage
from beamsplat.tools.keys.pki import CertificateAuthority
from tests.common.polling import wait_until
from tests.services.page.test_page_server import TOKEN, Serving


def connect(serving):
    connection = socket.create_connection(("127.0.0.1", serving.port), timeout=10)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    return connection


def was_closed(connection):
    """Return whether the server closed a connection, after reading what it has sent."""
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


@pytest.mark.parametrize("start", [b"", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: "])
def test_a_connection_without_a_complete_request_is_closed(monkeypatch, start):
    monkeypatch.setattr(server, "_IDLE_S", 1.0)
    with Serving() as serving, connect(serving) as slow:

        def drip():
            with contextlib.suppress(OSError):
                slow.send(start and b"x")
            return was_closed(slow)

        slow.sendall(start)
        wait_until(drip)
        assert serving.get("/")[0] == 200


def test_a_request_with_an_incomplete_body_is_answered_and_closed(monkeypatch):
    monkeypatch.setattr(command_requests, "TRANSFER_S", 0.5)
    head = f"POST /command HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {TOKEN}\r\nContent-Length: 99\r\n\r\n{{"
    with Serving() as serving:
        assert serving.ask(head.encode())[0] == 408
        assert serving.orders == []


def test_a_client_that_does_not_read_a_response_is_closed(monkeypatch):
    monkeypatch.setattr(server, "TRANSFER_S", 0.5)
    with Serving() as serving, connect(serving) as deaf:
        serving.state.images["camera"].update(lambda: EncodedImage(bytes(8_000_000), "image/jpeg", {}))
        deaf.sendall(b"GET /picture/camera HTTP/1.1\r\nHost: localhost\r\n\r\n")
        wait_until(lambda: serving.server._listener.busy)
        wait_until(lambda: not serving.server._listener.busy)
        received = 0
        with contextlib.suppress(OSError):
            while data := deaf.recv(65536):
                received += len(data)
        assert received < 8_000_000


def test_an_event_stream_without_events_gets_a_heartbeat(monkeypatch):
    monkeypatch.setattr(server, "_HEARTBEAT_S", 0.2)
    with (
        Serving(robot_hz=0.1) as serving,
        serving.open_event_stream() as stream,
        stream.makefile("rb") as lines,
    ):
        assert any(line == b":\n" for line in lines)


def test_event_streams_leave_connections_for_requests(monkeypatch):
    monkeypatch.setattr(server, "_MAX_VIEWERS", 2)
    with Serving() as serving, contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(serving.open_event_stream())
        wait_until(lambda: len(serving.server.events) == 2)
        assert serving.get("/events")[0] == 503
        assert serving.get("/status")[0] == 200


def test_streams_are_not_replaced_and_idle_connections_are(monkeypatch):
    monkeypatch.setattr(listener, "MAX_CONNECTIONS", 8)
    with Serving() as serving, contextlib.ExitStack() as stack:
        streams = [stack.enter_context(serving.open_event_stream()) for _ in range(4)]
        wait_until(lambda: len(serving.server.events) == 4)
        idle = [stack.enter_context(connect(serving)) for _ in range(50)]
        assert serving.get("/status")[0] == 200
        wait_until(lambda: sum(was_closed(c) for c in idle) >= 45)
        assert len(serving.server.events) == 4
        assert not any(was_closed(stream) for stream in streams)
        assert serving.server.refused()["connections closed because too many were open"] >= 46


def test_connections_without_a_tls_handshake_are_limited(tmp_path):
    folder = CertificateAuthority.create(tmp_path).issue("edge", HostRole(role="edge"), ("127.0.0.1",))
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    client = ssl.create_default_context(cafile=folder / CA)
    before = len(os.listdir("/proc/self/fd"))
    with Serving(tls=tls) as serving, contextlib.ExitStack() as stack:
        for _ in range(300):
            stack.enter_context(socket.create_connection(("127.0.0.1", serving.port), timeout=10))
        raw = stack.enter_context(connect(serving))
        with client.wrap_socket(raw, server_hostname="127.0.0.1") as link:
            link.sendall(b"GET /status HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert link.recv(1024).startswith(b"HTTP/1.1 200")
        assert len(os.listdir("/proc/self/fd")) < before + 300 + listener.MAX_CONNECTIONS + 30


def test_requests_that_are_not_http_are_counted_without_a_traceback_for_each(caplog):
    with Serving() as serving:
        for _ in range(3):
            assert serving.ask(b"GET / SPDY/3\r\n\r\n")[0] == 400
        assert serving.server.refused()["requests were not HTTP"] == 3
    assert caplog.text == ""
