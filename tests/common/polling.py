"""Waiting for a system to get somewhere."""

import time


def poll(supervisor, until, timeout_s):
    """Supervises until `until()` holds; fails after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        supervisor.poll()
        if until():
            return
        time.sleep(0.02)
    raise AssertionError(f"not within {timeout_s} s")


def publish_until_received(publication, message, heard, times=3, timeout_s=5.0):
    """Publishes until `heard` holds so many messages."""
    deadline = time.monotonic() + timeout_s
    while len(heard) < times and time.monotonic() < deadline:
        publication.put(message)
        time.sleep(0.05)
    assert len(heard) >= times
