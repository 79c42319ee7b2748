"""Serial ports and TCP sockets for drivers: received bytes, and an error when the connection ends."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from typing import Protocol

import serial

from beamsplat.common.errors import UserError

_CHUNK = 4096  # bytes of one read
_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit


class LinkError(OSError):
    """Error: the device is missing, permission is denied, or it does not answer; the text has the remedy."""


class DeviceLink(Protocol):
    """Interface of an open connection to a device."""

    byte_time_s: float  # transmission time of a byte; 0 if unknown

    def read(self, timeout_s: float) -> bytes:
        """Return received bytes; wait up to `timeout_s` for the first byte; b"" if none arrives.

        Raises:
            LinkError: the connection has ended.
        """

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises LinkError."""

    def set_motor(self, on: bool) -> None:
        """Switch the motor on or off by the DTR line of the serial adapter, if the link has one."""

    def close(self) -> None:
        """Close the connection."""


class SerialLink:
    """A serial port (or a pseudo-terminal)."""

    def __init__(self, path: str, baud: int) -> None:
        """Open the port exclusively, because a second reader would receive part of the bytes.

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
        except (OSError, TypeError, ValueError) as error:  # TypeError: pyserial's descriptor was closed
            raise LinkError(f"{self._port.name} is disconnected: {_reason(error)}") from error
        if not data:  # readable without data: end of file
            raise LinkError(f"{self._port.name} is disconnected: it was unplugged")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, ValueError) as error:
            raise LinkError(f"cannot write to {self._port.name}: {_reason(error)}") from error

    def set_motor(self, on: bool) -> None:
        with contextlib.suppress(OSError):  # a pseudo-terminal has no such line
            self._port.dtr = not on

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


class TcpLink:
    """A connection to a device with a network socket."""

    def __init__(self, host: str, port: int, timeout_s: float = 1.0) -> None:
        """Connect.

        Raises:
            LinkError: nothing answers at the address.
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
            raise LinkError(f"{self._name} is disconnected: {_reason(error)}") from error
        if not data:
            raise LinkError(f"{self._name} has closed the connection")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise LinkError(f"cannot write to {self._name}: {_reason(error)}") from error

    def set_motor(self, on: bool) -> None:
        pass

    def close(self) -> None:
        self._socket.close()


def open_link(device: str, baud: int) -> DeviceLink:
    """Open the device at a path ("/dev/ttyUSB0") or an address ("tcp/192.168.0.10:10940").

    Raises:
        LinkError: it cannot be opened now.
        UserError: the address is invalid.
    """
    if not device.startswith("tcp/"):
        return SerialLink(device, baud)
    host, _, port = device.removeprefix("tcp/").rpartition(":")
    if not host or not port.isdigit():
        raise UserError(f"device = {device!r}: write the address of a network device as tcp/HOST:PORT")
    return TcpLink(host.strip("[]"), int(port))


def drain(link: DeviceLink, quiet_s: float = 0.05, at_most_s: float = 0.5) -> None:
    """Discard received bytes until the device has been silent for `quiet_s`, at most for `at_most_s`."""
    deadline = time.monotonic() + at_most_s
    while time.monotonic() < deadline and link.read(quiet_s):
        pass


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _no_permission(path: str) -> str:
    return (
        f"this user has no permission to open {path}: run `sudo usermod -aG dialout $USER`, then log in "
        "again (`beamsplat doctor` explains)"
    )
