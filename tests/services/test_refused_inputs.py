"""What a node loses or refuses is in its health, by reason, from where the summary of a run takes it.

Drivers and the recorder: in their own tests.
"""

import http.client

import pytest

from beamsplat.common.messages import Health
from beamsplat.common.messages.header import Header
from tests.services.test_bounded_memory import RIG, Player, make, step

HEADER = Header(1, 0, 0, 0, 0, "localization", "0" * 16)
TOKEN = "a-long-enough-token"


def counts_of(node):
    return {entry.reason: entry.count for entry in node.rejections.report()}


@pytest.mark.parametrize(
    ("topics", "reason"),
    [
        (("localization/odometry", "fusion/depth"), "keyframes lost: their image was too old"),
        (("camera/image", "fusion/depth"), "keyframes lost: no pose came for them"),
        (("keyframes/candidate",), "candidates dropped: no calibration yet"),
    ],
)
def test_lost_keyframes(topics, reason, tmp_path, router_endpoint):
    node = make("keyframes", "default", tmp_path, router_endpoint)
    player = Player(node)
    if "candidate" not in topics[0]:
        player.send("rig", RIG, HEADER)
    for number in range(0, 300, 3):  # each is a keyframe
        messages = step(number, 10**18 + number * 10**8, False)
        for topic in topics:
            player.send(topic, messages[topic](), HEADER)
    node.close()
    assert counts_of(node)[reason] >= 30


def test_commands_with_a_wrong_token(tmp_path, router_endpoint):
    node = make("page", "default", tmp_path, router_endpoint, token=TOKEN)
    try:
        server = http.client.HTTPConnection("127.0.0.1", int(node._address.rpartition(":")[2].strip("/")))
        server.request("POST", "/command", "{}", {"Authorization": "Bearer wrong"})
        assert server.getresponse().status == 401
        server.close()
        node.on_health(Health(stamp_ns=1, node="page", instance="a", epoch=1, state="active"))
    finally:
        node.close()
    assert counts_of(node) == {"commands rejected for a wrong token": 1}
