"""Which cameras and lidars answer: the very nodes that will run are asked for their first message."""

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

CAMERA_S = 6.0  # a network camera takes its time for the first picture
LIDAR_S = {"ldrobot": 3.0, "rplidar": 8.0, "hokuyo": 5.0}  # all baud rates of a kind, and a turn


class Found(NamedTuple):
    """A sensor that answered."""

    options: dict[str, Any]  # of its node
    says: str  # its status: model, rates, losses
    first: Message


class Silent(NamedTuple):
    """A place where nothing answered, and what was heard instead."""

    where: str
    says: str


def camera_places(dev: Path = Path("/dev")) -> list[str]:
    """V4L2 devices of this machine, by their lasting names where they have one."""
    return _lasting(sorted(dev.glob("video[0-9]*")), dev / "v4l" / "by-id")


def lidar_places(dev: Path = Path("/dev")) -> list[str]:
    """Serial ports at which a lidar could be, by their lasting names where they have one."""
    return _lasting(sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")]), dev / "serial" / "by-id")


def _lasting(devices: list[Path], names: Path) -> list[str]:
    by_device = {link.resolve(): link for link in sorted(names.glob("*"), reverse=True)}
    return [str(by_device.get(device.resolve(), device)) for device in devices]


def find_camera(source: str) -> Found | Silent:
    """The camera at an index, path or address."""
    return _first("camera", {"kind": "opencv", "source": source}, source, Image, CAMERA_S)


def find_lidar(device: str, kinds: tuple[str, ...] = tuple(LIDAR_S)) -> Found | Silent:
    """The lidar at a serial port or tcp/HOST:PORT, whichever kind answers."""
    if device.startswith("tcp/"):
        kinds = ("hokuyo",)
    heard = []
    for kind in kinds:
        answer = _first("lidar", {"kind": kind, "device": device}, device, Scan, LIDAR_S[kind])
        if isinstance(answer, Found):
            return answer
        heard.append(f"{kind}: {answer.says}")
        if "cannot be opened" in answer.says or "permission" in answer.says:
            break  # it is the same for all kinds
    return Silent(device, "; ".join(heard))


def answers_of(
    places: Iterable[str], find: Callable[[str], Found | Silent], say: Callable[[str], None]
) -> list[Found]:
    """What answers at any of the places; `say` hears of each what it is."""
    found = []
    for place in places:
        say(f"trying {place} ...")
        answer = find(place)
        say(f"  {answer.says}")
        if isinstance(answer, Found):
            found.append(answer)
    return found


def _first(
    service: str, options: dict[str, Any], where: str, wanted: type[Message], patience_s: float
) -> Found | Silent:
    with messages(service, options, wanted) as stream:
        deadline = time.monotonic() + patience_s
        for message, says in stream:
            if message is not None:
                return Found(options, says, message)
            if time.monotonic() > deadline:
                return Silent(where, says)
    return Silent(where, "it has ended")


@contextmanager
def messages(
    service: str, options: dict[str, Any], wanted: type[Message]
) -> Iterator[Iterator[tuple[Message | None, str]]]:
    """What a sensor's node says, (message or None, its status), as long as it is looked at.

    Raises:
        UserError: options that do not fit.
    """
    node = make_node(NODES[service], options, "setup")
    try:
        node.configure()
        with closing(node.source()) as source:
            yield (
                (item.message if item is not None and isinstance(item.message, wanted) else None, node.detail)
                for item in source
            )
    finally:
        node.close()


class Watched:
    """A sensor that is read in a thread of its own, so that the next message is one of now."""

    def __init__(self, service: str, options: dict[str, Any], wanted: type[Message]) -> None:
        self._service = service
        self._changed = threading.Condition()
        self._message: Message | None = None
        self._says = ""
        self._ended = False
        self._thread = threading.Thread(target=self._read, args=(options, wanted), daemon=True)

    def __enter__(self) -> Watched:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended = True
        self._thread.join(10.0)

    def _read(self, options: dict[str, Any], wanted: type[Message]) -> None:
        with messages(self._service, options, wanted) as stream:
            for message, says in stream:
                if self._ended:
                    return
                self._says = says
                if message is not None:
                    with self._changed:
                        self._message = message
                        self._changed.notify_all()

    def next(self, patience_s: float = 20.0) -> Any:
        """The first message that comes from now on.

        Raises:
            UserError: none comes.
        """
        with self._changed:
            self._message = None
            if not self._changed.wait_for(lambda: self._message is not None, patience_s):
                raise UserError(f"{self._service}: says nothing any more: {self._says}")
            return self._message
