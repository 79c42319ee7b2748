"""Threads that receive from the channel of a Zenoh subscriber or queryable."""

from __future__ import annotations

import atexit
import contextlib
import threading
import time
from collections.abc import Callable
from typing import Protocol, TypeVar

import zenoh

T_co = TypeVar("T_co", covariant=True)
T = TypeVar("T")
_EXIT_S = 1.0  # for the threads to end, at the end of the interpreter
_receiving: dict[threading.Thread, zenoh.Session] = {}


class Receiver(Protocol[T_co]):
    """A subscriber or queryable with a channel; `recv` waits for the next item."""

    def recv(self) -> T_co: ...


def receive_in_thread(
    session: zenoh.Session,
    name: str,
    receiver: Receiver[T],
    handle: Callable[[T], None],
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Call `handle` with each item of `receiver`, in a thread called `name`, until the session is closed.

    An exception of `handle` is not caught here: it ends the thread, and with it the process of a node
    (tools/system/node_process.py), which is restarted. A sample that cannot be decoded is no exception:
    `handle` counts it.

    Args:
        session: the session of `receiver`, over which `handle` publishes.
        stopped: asked before each item is handled; True ends the thread, and the item is not handled.
    """

    def receive() -> None:
        while True:
            try:
                item = receiver.recv()
            except zenoh.ZError:  # the session was closed, or the receiver undeclared
                return
            if stopped():
                return
            try:
                handle(item)
            except zenoh.ZError:
                if session.is_closed():  # meanwhile: what `handle` wanted to publish cannot be sent
                    return
                raise

    def receive_until_closed() -> None:
        try:
            receive()
        finally:
            with contextlib.suppress(KeyError):
                del _receiving[thread]

    thread = threading.Thread(target=receive_until_closed, name=name, daemon=True)
    _receiving[thread] = session
    thread.start()


@atexit.register
def _join_threads() -> None:
    """Wait for the threads whose session is closed.

    A thread that returns from `recv` while the interpreter ends is unwound through Zenoh's Rust code, which
    aborts the process: "FATAL: exception not rethrown".
    """
    deadline = time.monotonic() + _EXIT_S
    for thread, session in list(_receiving.items()):
        if session.is_closed():
            thread.join(max(0.0, deadline - time.monotonic()))
