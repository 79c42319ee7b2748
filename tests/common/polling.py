"""Waiting for a condition with a time limit."""

import time


def wait_until(condition, timeout_s=30.0):
    """Poll until `condition()` is true; fail after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {timeout_s} s"
        time.sleep(0.01)


def poll(supervisor, until, timeout_s):
    """Run the supervisor until `until()` is true; fail after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        supervisor.poll()
        if until():
            return
        time.sleep(0.02)
    raise AssertionError(f"not within {timeout_s} s")


def publish_until_received(publication, message, received, times=3, timeout_s=30.0, later_ns=0):
    """Publish `message` repeatedly, stamped `later_ns` later each time, until `received` has `times` entries."""
    deadline = time.monotonic() + timeout_s
    while len(received) < times and time.monotonic() < deadline:
        publication.put(message)
        message = message.model_copy(update={"stamp_ns": message.stamp_ns + later_ns})
        time.sleep(0.05)
    assert len(received) >= times
