"""Find connected cameras and lidars: run their nodes until the first message arrives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Image, Message, Scan
from beamsplat.common.runtime.registry import make_node
from beamsplat.services.nodes import NODES

CAMERA_TIMEOUT_S = 6.0  # network cameras need seconds for the first image
LIDAR_TIMEOUT_S = {
    "ldrobot": 3.0,
    "rplidar": 8.0,
    "hokuyo": 5.0,
}  # for all baud rates of the kind and one revolution


class FoundSensor(NamedTuple):
    """A sensor that sent a message: options and status of its node, and the message."""

    options: dict[str, Any]  # of its node
    status: str  # of its node: model, rates, losses
    first: Message


class NoAnswer(NamedTuple):
    """A device that sent no message, and the status of the node that tried to read it."""

    where: str
    status: str


def camera_devices(dev: Path = Path("/dev")) -> list[str]:
    """Return the paths of the V4L2 devices (cameras) of this host, from by-id links where available."""
    return _stable_names(sorted(dev.glob("video[0-9]*")), dev / "v4l" / "by-id")


def lidar_devices(dev: Path = Path("/dev")) -> list[str]:
    """Return the paths of the USB serial ports of this host, from by-id links where available."""
    return _stable_names(sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")]), dev / "serial" / "by-id")


def _stable_names(devices: list[Path], names: Path) -> list[str]:
    by_device = {link.resolve(): link for link in sorted(names.glob("*"), reverse=True)}
    return [str(by_device.get(device.resolve(), device)) for device in devices]


def find_camera(source: str) -> FoundSensor | NoAnswer:
    """Run the camera node on `source` (index, device path or stream address) until an image arrives."""
    return _first_message("camera", {"kind": "opencv", "source": source}, source, Image, CAMERA_TIMEOUT_S)


def find_lidar(device: str, kinds: tuple[str, ...] = tuple(LIDAR_TIMEOUT_S)) -> FoundSensor | NoAnswer:
    """Run lidar drivers of all `kinds` on a device, one after the other, until the first scan arrives.

    `device` is a serial port, or tcp/HOST:PORT, where only the driver "hokuyo" is tried.
    """
    if device.startswith("tcp/"):
        kinds = ("hokuyo",)
    heard = []
    for kind in kinds:
        answer = _first_message(
            "lidar", {"kind": kind, "device": device}, device, Scan, LIDAR_TIMEOUT_S[kind]
        )
        if isinstance(answer, FoundSensor):
            return answer
        heard.append(f"{kind}: {answer.status}")
        if "cannot be opened" in answer.status or "permission" in answer.status:
            break  # independent of the kind
    return NoAnswer(device, "; ".join(heard))


def probe_all(
    devices: Iterable[str], find: Callable[[str], FoundSensor | NoAnswer], say: Callable[[str], None]
) -> list[FoundSensor]:
    """Call `find` for each device, and return the sensors found; `say` receives progress messages."""
    found = []
    for device in devices:
        say(f"trying {device} ...")
        answer = find(device)
        say(f"  {answer.status}")
        if isinstance(answer, FoundSensor):
            found.append(answer)
    return found


def _first_message(
    service: str, options: dict[str, Any], where: str, wanted: type[Message], timeout_s: float
) -> FoundSensor | NoAnswer:
    with sensor_messages(service, options, wanted) as stream:
        deadline = time.monotonic() + timeout_s
        for message, status in stream:
            if message is not None:
                return FoundSensor(options, status, message)
            if time.monotonic() > deadline:
                return NoAnswer(where, status)
    return NoAnswer(where, "the stream has ended")


@contextmanager
def sensor_messages(
    service: str, options: dict[str, Any], wanted: type[Message]
) -> Iterator[Iterator[tuple[Message | None, str]]]:
    """Run the node of a sensor; as a context manager, return an iterator over (message, status of the node).

    The message is None if the node has published nothing or another type than `wanted`.

    Args:
        service: "camera" or "lidar".
        options: options of the node.

    Raises:
        UserError: an option is invalid.
    """
    node = make_node(NODES[service], options, "setup")
    try:
        node.configure()
        with closing(node.source()) as source:  # type: ignore[type-var]  # all sources are generators
            yield (
                (item.message if item is not None and isinstance(item.message, wanted) else None, node.detail)
                for item in source
            )
    finally:
        node.close()


class SensorStream:
    """Reader of a sensor that runs in a thread, so that `next` returns a message measured after its call.

    Use it as a context manager.
    """

    def __init__(self, service: str, options: dict[str, Any], wanted: type[Message]) -> None:
        self._service = service
        self._changed = threading.Condition()
        self._message: Message | None = None
        self._status = ""
        self._ended = False
        self._thread = threading.Thread(target=self._read, args=(options, wanted), daemon=True)

    def __enter__(self) -> SensorStream:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended = True
        self._thread.join(10.0)

    def _read(self, options: dict[str, Any], wanted: type[Message]) -> None:
        with sensor_messages(self._service, options, wanted) as stream:
            for message, status in stream:
                if self._ended:
                    return
                self._status = status
                if message is not None:
                    with self._changed:
                        self._message = message
                        self._changed.notify_all()

    def next(self, timeout_s: float = 20.0) -> Any:
        """Wait for the first message of type `wanted` that arrives from now on, and return it.

        Raises:
            UserError: no message arrives within `timeout_s`.
        """
        with self._changed:
            self._message = None
            if not self._changed.wait_for(lambda: self._message is not None, timeout_s):
                raise UserError(f"{self._service}: no message for {timeout_s:g} s: {self._status}")
            return self._message
