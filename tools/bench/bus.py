"""`bench bus`: latency of messages through the local router, and the effect of a slow subscriber on others.

The publisher is a separate process; this process subscribes. Messages of our bus and plain Zenoh puts of the
same bytes alternate within one run, so that the ratio of their latencies is meaningful on a busy machine.
"""

from __future__ import annotations

import multiprocessing
import struct
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh

from beamsplat.common.config.deployment import Deployment, RouterConfig
from beamsplat.common.messages import Image, WheelOdometry
from beamsplat.common.messages.header import Header
from beamsplat.common.runtime.mailbox import Envelope, Mailbox
from beamsplat.common.runtime.node import Node, Outputs, subscriptions
from beamsplat.common.zenoh.bus import Bus, open_session
from beamsplat.common.zenoh.receiving import receive_in_thread
from beamsplat.tools.system.supervisor import Supervisor

ROBOT = "bench"
PLAIN_KEY = f"beamsplat/{ROBOT}/plain"
_WARM_UP = 20  # first samples, not counted: connections, shared memory and caches are being set up


class _ImageSubscriber(Node):
    """Node that declares the subscription of the slow subscriber, `camera/image`; it is never run."""

    name = "monitor"
    inputs = ("camera/image",)

    def on_camera_image(self, message: Image) -> Outputs:
        return iter(())


@dataclass
class _Latencies:
    """List of message latencies in ms, to which a receiving thread appends."""

    values: list[float] = field(default_factory=list)

    def add_since(self, then_ns: int) -> None:
        """Append the latency of one message: the time in ms from `then_ns` until now.

        `then_ns` is the value of `time.monotonic_ns()` when the message was published on this host.
        """
        self.values.append((time.monotonic_ns() - then_ns) / 1e6)

    def percentiles(self) -> tuple[float, float]:
        """Return the 50th and the 99th percentile of the latencies in ms, without the first `_WARM_UP` ones.

        Raises:
            RuntimeError: fewer than 10 latencies remain.
        """
        counted = self.values[_WARM_UP:]
        if len(counted) < 10:
            raise RuntimeError(f"only {len(self.values)} messages arrived")
        return float(np.percentile(counted, 50)), float(np.percentile(counted, 99))


def _publish(endpoint: str, go: Event, stop: Event, image_bytes: int, hz: float, plain: bool) -> None:
    """Publish images at `hz` per second and odometry at 100 Hz until `stop` is set.

    This is the main function of the publishing process. With `plain`, every second image is published as a
    plain Zenoh put of the same bytes, without the BeamSplat bus.
    """
    data = np.random.default_rng(0).integers(0, 255, image_bytes).astype(np.uint8)
    body = data.tobytes()
    with Bus(open_session((endpoint,)), ROBOT, "replay", "ab" * 8, 1) as bus:
        images = bus.publish("camera/image")
        drop = zenoh.CongestionControl.DROP
        plain_publisher = bus.session.declare_publisher(PLAIN_KEY, congestion_control=drop)
        odometry_thread = threading.Thread(target=_publish_odometry, args=(bus, stop), daemon=True)
        go.wait()
        odometry_thread.start()
        turn = 0
        due = time.monotonic()
        while not stop.is_set():
            now_ns = time.monotonic_ns()
            if plain and turn % 2:
                plain_publisher.put(body, attachment=struct.pack("<q", now_ns))
            else:
                image = Image(stamp_ns=now_ns, width_px=640, height_px=480, encoding="jpeg", data=data)
                images.put(image)
            turn += 1
            due += 1.0 / hz
            time.sleep(max(0.0, due - time.monotonic()))
        odometry_thread.join()


def _publish_odometry(bus: Bus, stop: Event) -> None:
    odometry = bus.publish("wheel/odometry")
    due = time.monotonic()
    while not stop.is_set():
        odometry.put(
            WheelOdometry(
                stamp_ns=time.monotonic_ns(),
                T_odom_body=np.eye(4),
                velocity_m_s=np.zeros(3),
                angular_velocity_rad_s=np.zeros(3),
            )
        )
        due += 0.01
        time.sleep(max(0.0, due - time.monotonic()))


def bench_bus(
    seconds: float, image_bytes: int, endpoint: str, report: Callable[[str], None]
) -> dict[str, Any]:
    """Measure image latency, then the effect of a slow subscriber on another topic, for `seconds` each.

    Args:
        seconds: duration of each of the two measurements, s.
        image_bytes: size of one image message.
        endpoint: address at which a router is started, such as tcp/127.0.0.1:17447.
        report: receives progress messages.

    Returns:
        Latencies, message counts and memory growth by name; names of quantities end with the unit.
    """
    with tempfile.TemporaryDirectory() as folder:
        deployment = Deployment(
            robot=ROBOT, router=RouterConfig(listen=(endpoint,)), state_dir=Path(folder), nodes={}
        )
        with Supervisor(deployment, ("router",)):
            report(f"{image_bytes / 1e6:g} MB images through the router: our bus and plain Zenoh alternate")
            result = _latency(endpoint, seconds, image_bytes)
            report("a subscriber that needs 200 ms per image, and a 100 Hz topic")
            result |= _slow_subscriber(endpoint, seconds, image_bytes)
    return result


def _with_publisher(
    endpoint: str, image_bytes: int, plain: bool, hz: float, body: Callable[[Bus], Callable[[], None]]
) -> None:
    """Run a publisher process and one subscriber on the bus.

    `body` declares the subscriptions and returns a function, which is called while images are published.
    """
    context = multiprocessing.get_context("spawn")
    go, stop = context.Event(), context.Event()
    process = context.Process(target=_publish, args=(endpoint, go, stop, image_bytes, hz, plain))
    process.start()
    try:
        with Bus(open_session((endpoint,)), ROBOT, "monitor", "cd" * 8, 1) as bus:
            work = body(bus)
            time.sleep(1.0)  # until the declarations have passed the router
            go.set()
            work()
            stop.set()
            process.join(10)
    finally:
        stop.set()
        if process.is_alive():
            process.kill()


def _latency(endpoint: str, seconds: float, image_bytes: int) -> dict[str, float]:
    our_latency, plain = _Latencies(), _Latencies()

    def body(bus: Bus) -> Callable[[], None]:
        bus.subscribe(
            subscriptions(_ImageSubscriber)[0],
            lambda e: our_latency.add_since(e.message.stamp_ns),
            _broken,
            _end,
        )
        subscriber = bus.session.declare_subscriber(PLAIN_KEY, zenoh.handlers.RingChannel(1))

        def handle(sample: zenoh.Sample) -> None:
            sample.payload.to_bytes()
            assert sample.attachment is not None  # sent with each sample
            plain.add_since(struct.unpack("<q", sample.attachment.to_bytes())[0])

        receive_in_thread(bus.session, "plain", subscriber, handle)
        return lambda: time.sleep(seconds)

    _with_publisher(endpoint, image_bytes, True, 60.0, body)
    (p50, p99), (plain_p50, plain_p99) = our_latency.percentiles(), plain.percentiles()
    return {
        "image_p50_ms": p50,
        "image_p99_ms": p99,
        "plain_p50_ms": plain_p50,
        "plain_p99_ms": plain_p99,
        "overhead_p50": p50 / plain_p50,
        "images": len(our_latency.values),
    }


def _slow_subscriber(endpoint: str, seconds: float, image_bytes: int) -> dict[str, float]:
    hz = 30.0
    odometry_latency, ages_in_frames = _Latencies(), []
    mailbox, lock = Mailbox(_ImageSubscriber), threading.Lock()
    memory = []

    def on_image(envelope: Envelope) -> None:
        with lock:
            mailbox.put(envelope)

    def body(bus: Bus) -> Callable[[], None]:
        from beamsplat.common.runtime.node import Input

        bus.subscribe(subscriptions(_ImageSubscriber)[0], on_image, _broken, _end)
        bus.subscribe(
            Input("wheel/odometry"), lambda e: odometry_latency.add_since(e.message.stamp_ns), _broken, _end
        )
        return work

    def work() -> None:
        deadline = time.monotonic() + seconds
        process = psutil.Process()
        while time.monotonic() < deadline:
            with lock:
                envelope = mailbox.pop()
            if envelope is None:
                time.sleep(0.001)
                continue
            ages_in_frames.append((time.monotonic_ns() - envelope.message.stamp_ns) / 1e9 * hz)
            time.sleep(0.2)
            memory.append(process.memory_info().rss / 1e6)

    _with_publisher(endpoint, image_bytes, False, hz, body)
    p50, p99 = odometry_latency.percentiles()
    count = mailbox.counts["camera/image"]
    settled = memory[len(memory) // 3 :]
    return {
        "slow_age_median_frames": float(np.median(ages_in_frames)),
        "slow_age_max_frames": float(np.max(ages_in_frames[2:])),
        "slow_received": count.received,
        "slow_dropped": count.dropped,
        "slow_memory_growth_mb": float(settled[-1] - settled[0]),
        "beside_p50_ms": p50,
        "beside_p99_ms": p99,
        "beside_messages": len(odometry_latency.values),
    }


def _broken(topic: str, reason: str) -> None:
    raise RuntimeError(f"{topic}: {reason}")


def _end(topic: str, header: Header, sent: int) -> None:
    return
