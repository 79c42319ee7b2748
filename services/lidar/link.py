"""Serial ports and TCP sockets as a driver needs them: bytes that have come, an error once it is gone."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from typing import Protocol

import serial

from beamsplat.common.errors import UserError

_CHUNK = 4096
_BITS_PER_BYTE = 10  # start, eight, stop


class LinkError(OSError):
    """The device is not there, not ours to open, or does not answer; the text says what to do."""


class DeviceLink(Protocol):
    """An open connection to a device."""

    byte_time_s: float  # how long a byte is on its way; 0 where that is not known

    def read(self, timeout_s: float) -> bytes:
        """What has come, waiting up to `timeout_s` for the first byte; b"" if nothing.

        Raises:
            LinkError: the connection has ended.
        """

    def write(self, data: bytes) -> None:
        """Sends all of it. Raises LinkError."""

    def set_motor(self, on: bool) -> None:
        """Switches what the adapter's DTR line holds, where there is one."""

    def close(self) -> None:
        """Ends the connection."""


class SerialLink:
    """A serial port (or a pseudo-terminal)."""

    def __init__(self, path: str, baud: int) -> None:
        """Opens it, without the exclusive right: a second reader would take bytes away, so it is refused.

        Raises:
            LinkError: no such port, no permission, or in use.
        """
        try:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=1.0, exclusive=True)
        except PermissionError as error:
            raise LinkError(_no_permission(path)) from error
        except (OSError, ValueError) as error:
            if getattr(error, "errno", None) == 13:
                raise LinkError(_no_permission(path)) from error
            raise LinkError(f"{path} cannot be opened: {_reason(error)}") from error
        self.byte_time_s = _BITS_PER_BYTE / baud

    def read(self, timeout_s: float) -> bytes:
        try:
            if not select.select([self._port.fileno()], [], [], timeout_s)[0]:
                return b""
            data = self._port.read(_CHUNK)
        except (OSError, TypeError, ValueError) as error:  # TypeError: closed below pyserial's feet
            raise LinkError(f"{self._port.name} is gone: {_reason(error)}") from error
        if not data:  # readable, but nothing to read: hung up
            raise LinkError(f"{self._port.name} is gone: it was unplugged")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, ValueError) as error:
            raise LinkError(f"{self._port.name} takes no commands: {_reason(error)}") from error

    def set_motor(self, on: bool) -> None:
        with contextlib.suppress(OSError):  # a pseudo-terminal has no such line
            self._port.dtr = not on

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


class TcpLink:
    """A device with a network socket."""

    def __init__(self, host: str, port: int, timeout_s: float = 1.0) -> None:
        """Connects.

        Raises:
            LinkError: nobody answers there.
        """
        try:
            self._socket = socket.create_connection((host, port), timeout=timeout_s)
        except OSError as error:
            raise LinkError(f"tcp/{host}:{port} does not answer: {_reason(error)}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.byte_time_s = 0.0
        self._name = f"tcp/{host}:{port}"

    def read(self, timeout_s: float) -> bytes:
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return b""
            data = self._socket.recv(_CHUNK)
        except (OSError, ValueError) as error:
            raise LinkError(f"{self._name} is gone: {_reason(error)}") from error
        if not data:
            raise LinkError(f"{self._name} has closed the connection")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise LinkError(f"{self._name} takes no commands: {_reason(error)}") from error

    def set_motor(self, on: bool) -> None:
        pass

    def close(self) -> None:
        self._socket.close()


def open_link(device: str, baud: int) -> DeviceLink:
    """The device at a path ("/dev/ttyUSB0") or an address ("tcp/192.168.0.10:10940").

    Raises:
        LinkError: it cannot be opened now.
        UserError: an address of another form.
    """
    if not device.startswith("tcp/"):
        return SerialLink(device, baud)
    host, _, port = device.removeprefix("tcp/").rpartition(":")
    if not host or not port.isdigit():
        raise UserError(f"device = {device!r}: a network device is written tcp/HOST:PORT")
    return TcpLink(host.strip("[]"), int(port))


def drain(link: DeviceLink, quiet_s: float = 0.05, at_most_s: float = 0.5) -> None:
    """Reads away what a device is still sending, until it has been quiet or that has lasted."""
    deadline = time.monotonic() + at_most_s
    while time.monotonic() < deadline and link.read(quiet_s):
        pass


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _no_permission(path: str) -> str:
    return (
        f"{path} may not be opened by this user: `sudo usermod -aG dialout $USER`, then log in anew "
        "(`beamsplat doctor` explains)"
    )
