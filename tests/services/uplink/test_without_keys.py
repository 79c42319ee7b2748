"""An uplink whose connection fails at once waits between its attempts."""

import itertools
import time

from beamsplat.common.runtime.live_settings import LiveSettings
from beamsplat.services.uplink.node import UplinkConfig, UplinkNode

SECONDS = 1.0
MOST = 25  # items of a source that waits 0.1 s or longer for each; without a wait it yields thousands


def yielded(node, seconds=SECONDS):
    """Return how many items the node's source yields in `seconds`; all of them are None."""
    deadline = time.monotonic() + seconds
    items = list(itertools.takewhile(lambda _: time.monotonic() < deadline, node.source()))
    assert set(items) == {None}
    return len(items)


def test_an_uplink_without_keys_says_so_and_does_not_occupy_a_core(tmp_path):
    node = UplinkNode(UplinkConfig(edge="tls/127.0.0.1:1"))
    node.live_settings = LiveSettings("r1", (), tmp_path)
    node.configure()
    assert yielded(node) < MOST
    assert "no link for" in node.detail
    assert "keys" in node.detail
    assert {figure.name: figure.value for figure in node.figures.report()} == {"link_up": 0.0}
