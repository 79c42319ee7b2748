"""Waiting for a supervised system to get somewhere."""

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
