"""Shared memory between processes of one host: small pools, and messages that do not fit into them."""

from pathlib import Path

import numpy as np
import pytest

from beamsplat.common.messages import Image
from beamsplat.common.runtime.node import Input
from beamsplat.common.zenoh.bus import SHM_POOL_BYTES
from tests.common.polling import publish_until_received


def _image(size_bytes):
    data = np.random.default_rng(size_bytes).integers(0, 255, size_bytes).astype(np.uint8)
    return Image(stamp_ns=size_bytes, width_px=640, height_px=480, encoding="jpeg", data=data)


def _pools_bytes():
    """Return the sizes of Zenoh's pools that this process has mapped, by name, without those of kilobytes."""
    sizes = {}
    for line in Path("/proc/self/maps").read_text().splitlines():
        if line.endswith(".zenoh"):
            first, last = (int(part, 16) for part in line.split(maxsplit=1)[0].split("-"))
            sizes[line.split()[-1]] = last - first  # sender and receiver are in this process: mapped twice
    return {name: size for name, size in sizes.items() if size > 2_000_000}


@pytest.mark.parametrize("size_bytes", [100_000, SHM_POOL_BYTES // 2, SHM_POOL_BYTES + 4_000_000])
def test_messages_arrive_whole_whether_they_fit_into_the_pool_or_not(make_bus, size_bytes):
    producer, consumer, received = make_bus("replay"), make_bus("monitor"), []
    consumer.subscribe(Input("camera/image", "every"), received.append, pytest.fail, lambda *_: None)
    image = _image(size_bytes)
    publish_until_received(producer.publish("camera/image"), image, received)
    assert np.array_equal(received[0].message.data, image.data)


def test_a_pool_takes_no_more_memory_than_its_size(make_bus):
    before = _pools_bytes()  # a process keeps those of earlier sessions, also of other tests
    producer, consumer, received = make_bus("replay"), make_bus("monitor"), []
    consumer.subscribe(Input("camera/image", "every"), received.append, pytest.fail, lambda *_: None)
    publish_until_received(producer.publish("camera/image"), _image(100_000), received)
    pools = [size for name, size in _pools_bytes().items() if name not in before]
    assert pools  # else the messages do not cross shared memory
    assert max(pools) < SHM_POOL_BYTES + 1_000_000
