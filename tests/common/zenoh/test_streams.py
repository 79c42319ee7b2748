"""The deliveries of the topic table: latest drops, every keeps the order, latched serves late joiners."""

import threading

from beamsplat.common.messages import GridTile, Image, Rig, WheelOdometry
from beamsplat.common.topics import topic
from beamsplat.common.zenoh.bus import key
from beamsplat.common.zenoh.streams import Subscription, decode_sample
from tests.common.polling import publish_until_received, wait_until
from tests.common.samples import sample_messages

SAMPLES = {type(m): m for m in sample_messages()}


def message(message_type, stamp_ns):
    return SAMPLES[message_type].model_copy(update={"stamp_ns": stamp_ns})


class Listener:
    """A subscription that keeps the stamps; while `hold` is set, it does not return from the first message."""

    def __init__(self, bus, robot, name, delivery=None, hold=False):
        self.stamps, self.faults = [], []
        self.proceed = threading.Event()
        if not hold:
            self.proceed.set()
        row = topic(name)
        self._kept = Subscription(
            bus.session,
            row,
            delivery or row.delivery,
            key(robot, name),
            lambda sample: decode_sample(sample, row),
            self._take,
            lambda *f: self.faults.append(f),
        )

    def _take(self, envelope):
        self.stamps.append(envelope.message.stamp_ns)
        assert self.proceed.wait(10.0)


def test_every_message_arrives_in_order_at_a_slow_subscriber(make_bus, robot):
    producer, consumer = make_bus("replay"), make_bus("localization")
    listener = Listener(consumer, robot, "wheel/odometry", hold=True)
    publication = producer.publish("wheel/odometry")
    publish_until_received(publication, message(WheelOdometry, 0), listener.stamps, times=1)
    for stamp_ns in range(1, 501):
        publication.put(message(WheelOdometry, stamp_ns))
    listener.proceed.set()
    wait_until(lambda: listener.stamps[-1] == 500)
    assert [s for s in listener.stamps if s] == list(range(1, 501))
    assert listener.faults == []


def test_a_slow_subscriber_to_the_latest_receives_the_newest_and_skips_the_rest(make_bus, robot):
    producer, consumer = make_bus("replay"), make_bus("depth")
    slow = Listener(consumer, robot, "camera/image", hold=True)
    every = Listener(consumer, robot, "camera/image", delivery="every")
    publication = producer.publish("camera/image")
    wait_until(lambda: publication.put(message(Image, 0)) and slow.stamps and every.stamps)
    for stamp_ns in range(1, 21):
        publication.put(message(Image, stamp_ns))
    wait_until(lambda: every.stamps[-1] == 20)  # all of them have reached this session
    slow.proceed.set()
    wait_until(lambda: slow.stamps[-1] == 20)
    assert slow.stamps == sorted(slow.stamps)
    assert len(slow.stamps) <= 3  # the first, the newest, and one that the newest may not have replaced yet


def test_a_late_joiner_receives_the_last_latched_message_and_what_follows(make_bus, robot):
    producer = make_bus("camera")
    publication = producer.publish("rig")
    for stamp_ns in (1, 2, 3):
        publication.put(message(Rig, stamp_ns))
    late = Listener(make_bus("fusion"), robot, "rig")
    wait_until(lambda: late.stamps)
    assert late.stamps == [3]
    publication.put(message(Rig, 4))
    wait_until(lambda: late.stamps == [3, 4])


def test_a_latched_message_reaches_a_subscriber_that_was_there_before_its_publisher(make_bus, robot):
    early = Listener(make_bus("fusion"), robot, "rig")
    make_bus("camera").publish("rig").put(message(Rig, 1))  # no other message follows it
    wait_until(lambda: early.stamps == [1])


def test_a_late_joiner_of_every_message_receives_only_what_follows(make_bus, robot):
    producer = make_bus("replay")
    publication = producer.publish("wheel/odometry")
    for stamp_ns in range(1, 11):
        publication.put(message(WheelOdometry, stamp_ns))
    late = Listener(make_bus("recorder"), robot, "wheel/odometry")
    publish_until_received(publication, message(WheelOdometry, 100), late.stamps)
    assert set(late.stamps) == {100}


def test_a_late_joiner_of_tiles_receives_all_that_the_publisher_keeps(make_bus, robot):
    publication = make_bus("localization").publish("localization/grid")
    for stamp_ns in range(1, 301):
        publication.put(message(GridTile, stamp_ns))
    late = Listener(make_bus("monitor"), robot, "localization/grid")
    wait_until(lambda: len(late.stamps) == 300)
    publication.put(message(GridTile, 301))
    wait_until(lambda: late.stamps == list(range(1, 302)))
