"""The end of an interpreter that has received over Zenoh."""

import subprocess
import sys
import textwrap

import pytest

from tests.conftest import free_port

SCRIPT = textwrap.dedent(
    """
    import sys
    import zenoh
    from beamsplat.common.zenoh.bus import open_router, open_session
    from beamsplat.common.zenoh.receiving import receive_in_thread

    endpoint = (sys.argv[1],)
    received = []
    with open_router(endpoint), open_session(endpoint) as session:
        kept = [session.declare_subscriber(f"k/{i}", zenoh.handlers.FifoChannel(4)) for i in range(40)]
        for i, subscriber in enumerate(kept):
            receive_in_thread(session, f"receive-{i}", subscriber, received.append)
    print("closed")
    """
)


@pytest.mark.live
def test_an_interpreter_that_ends_after_its_session_is_not_aborted():
    for _ in range(5):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, f"tcp/127.0.0.1:{free_port()}"],
            capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert (done.returncode, done.stdout, done.stderr) == (0, "closed\n", "")
