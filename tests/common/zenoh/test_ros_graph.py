"""Type hashes and subscribers of a robot from its liveliness tokens, however many and however wrong they are."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.common.zenoh.rmw import NO_TYPE_HASH, TYPE_HASH, RmwEntity, RmwQos
from beamsplat.common.zenoh.ros_graph import RosGraph
from beamsplat.common.zenoh.ros_publishers import ros_topic
from tests.services.reachable import reachable

CLOUD = "sensor_msgs/msg/PointCloud2"
TOPIC = ros_topic("beamsplat/cloud", CLOUD, RmwQos())


def token(kind="MS", node_id=1, name="rviz2", topic="/beamsplat/cloud", type_name=CLOUD, type_hash=TOPIC.type_hash,
          latched=False, zid="ab", entity_id=7):  # fmt: skip
    return RmwEntity(0, zid, node_id, entity_id, kind, name, topic=topic, type_name=type_name, type_hash=type_hash,
                     qos=RmwQos(transient_local=latched)).token()  # fmt: skip


def node_token(node_id, zid="ab"):
    return RmwEntity(0, zid, node_id, node_id, "NN", "rviz2").token()


def test_the_kinds_of_hashes_are_those_of_the_nodes_that_are_there():
    graph = RosGraph([TOPIC])
    assert graph.hash_kinds() == {TYPE_HASH}
    rosout = {"topic": "/rosout", "type_name": "rcl_interfaces/msg/Log", "kind": "MP"}
    graph.add(token(node_id=1, type_hash=NO_TYPE_HASH, **rosout))
    assert graph.hash_kinds() == {NO_TYPE_HASH}
    graph.add(token(node_id=2, type_hash="RIHS01_" + "a" * 64, **rosout))
    assert graph.hash_kinds() == {NO_TYPE_HASH, TYPE_HASH}
    graph.remove(token(node_id=1, type_hash=NO_TYPE_HASH, **rosout))  # a topic of the node, not the node
    assert graph.hash_kinds() == {NO_TYPE_HASH, TYPE_HASH}
    graph.remove(node_token(1))
    graph.remove(node_token(1))
    assert graph.hash_kinds() == {TYPE_HASH}
    graph.add(token(node_id=9, name="beamsplat", type_hash=NO_TYPE_HASH))  # our own
    graph.remove(node_token(2))
    assert graph.hash_kinds() == {TYPE_HASH}  # that of the last nodes


def test_subscribers_with_our_type_and_hash_can_take_messages_and_others_are_named():
    graph = RosGraph([TOPIC])
    good = [token(entity_id=1), token(entity_id=2, type_hash=NO_TYPE_HASH, latched=True)]
    other_type = token(entity_id=3, name="nav", type_name="nav_msgs/msg/Path")
    other_hash = token(entity_id=4, name="old", type_hash="RIHS01_" + "c" * 64)
    publisher, elsewhere = token("MP", entity_id=5), token(entity_id=6, topic="/other")
    for entity in [*good, other_type, other_hash, publisher, elsewhere, good[0]]:
        graph.add(entity)
    assert [s.transient_local for s in graph.takers("/beamsplat/cloud")] == [False, True]
    assert graph.obstacles("/beamsplat/cloud") == [
        f"/nav expects nav_msgs/msg/Path on /beamsplat/cloud, whose type is {CLOUD}",
        f"/old has another definition of {CLOUD} on /beamsplat/cloud (RIHS01_cccccccccccc, ours is RIHS01_9198cabf7da3)",
    ]
    for entity in (good[0], other_type):
        graph.remove(entity)
    assert len(graph.takers("/beamsplat/cloud")) == 1
    assert len(graph.obstacles("/beamsplat/cloud")) == 1


@given(st.lists(st.text(max_size=100), max_size=20))
def test_any_text_is_no_error(texts):
    graph = RosGraph([TOPIC])
    for text in texts:
        graph.add(text)
        graph.add(f"@ros2_lv/0/{text}/0/1/MS/%/%/x/%beamsplat%cloud/a::msg::dds_::B_/{text}/::,1:,:,:,,")
        graph.remove(text)


def test_tokens_do_not_fill_the_memory():
    graph = RosGraph([TOPIC])

    def flood(first):
        for number in range(first, first + 3000):
            graph.add(
                token(node_id=number, entity_id=number, name=f"n{number}", type_name=f"a/msg/T{number}")
            )

    flood(0)
    before = reachable(graph)
    flood(3000)
    after = reachable(graph)
    assert not {path: size for path, size in after.items() if size > before[path]}
    assert np.isfinite(len(graph.obstacles("/beamsplat/cloud")))
