"""Check the cameras and serial ports of this machine: existence, permissions, use by other programs."""

from __future__ import annotations

import fcntl
import getpass
import grp
import os
import socket
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import psutil

_CONNECT_S = 0.5  # timeout for network lidars
# Programs that open every new serial port to search for modems or Braille displays -> how to disable them.
_INTERFERING = {
    "ModemManager": "sudo systemctl disable --now ModemManager",
    "brltty": "sudo systemctl mask brltty-udev.service; sudo apt remove brltty",
}


class DeviceFinding(NamedTuple):
    """One result of the check of a device, with a remedy if there is a fault."""

    subject: str
    verdict: Literal["ok", "note", "fault"]
    text: str
    remedy: str = ""


class UserAccount(NamedTuple):
    """A user, and the groups by which the user has access to devices."""

    name: str
    groups: frozenset[str]  # of this session
    enrolled: frozenset[str]  # by /etc/group: effective after the next login

    @staticmethod
    def current() -> UserAccount:
        """Return the user of this process."""
        name = getpass.getuser()
        groups = {_group_name(gid) for gid in os.getgroups()}
        return UserAccount(
            name, frozenset(groups), frozenset(g.gr_name for g in grp.getgrall() if name in g.gr_mem)
        )


def wanted_devices(nodes: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Return (option, device) of camera and lidar in a deployment, such as ("lidar.device", "/dev/ttyUSB0").

    `nodes` are the option tables of the deployment's nodes, by name.
    """
    found = []
    lidar, camera = nodes.get("lidar"), nodes.get("camera")
    if lidar is not None:
        default = "tcp/192.168.0.10:10940" if lidar.get("kind") == "hokuyo" else "/dev/ttyUSB0"
        found.append(("lidar.device", str(lidar.get("device", default))))
    if camera is not None and camera.get("kind") != "none":
        source = str(camera.get("source", "0"))
        found.append(("camera.source", f"/dev/video{source}" if source.isdigit() else source))
    return found


def diagnose_devices(
    wanted: Iterable[tuple[str, str]],
    dev: Path = Path("/dev"),
    user: UserAccount | None = None,
    may_open: Callable[[Path], bool] = lambda path: os.access(path, os.R_OK | os.W_OK),
) -> Iterator[DeviceFinding]:
    """Check access to the devices of a deployment and to other connected devices; yield the findings.

    Args:
        wanted: (option, device) pairs from `wanted_devices`.
        dev: folder of device files.
        user: user whose permissions are checked; None: the current user.
        may_open: access test, replaceable for tests.
    """
    user = user or UserAccount.current()
    serial = sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")])
    video = sorted(dev.glob("video[0-9]*"))
    reported: set[Path] = set()
    for option, device in wanted:
        if device.startswith("tcp/"):
            yield _check_network(option, device)
        elif not device.startswith(str(dev)):
            continue  # a stream or a file: its errors are in the camera node's status
        elif not (path := Path(device)).exists():
            others = video if option.startswith("camera") else serial
            yield DeviceFinding(device, "fault", f"{option}: no such device", _what_is_there(others, dev))
        else:
            reported.add(path.resolve())
            yield _check_access(path, user, may_open, needed=True)
    for path in [*serial, *video]:
        if path.resolve() not in reported:
            yield _check_access(path, user, may_open, needed=False)
    if serial or any(option == "lidar.device" for option, _ in wanted):
        yield from _interfering_programs()


def _check_access(
    path: Path, user: UserAccount, may_open: Callable[[Path], bool], *, needed: bool
) -> DeviceFinding:
    """Return a finding on one device file: permissions of the user, use by other programs.

    A problem is a "fault" if the deployment needs the device (`needed`), else a "note".
    """
    bad: Literal["fault", "note"] = "fault" if needed else "note"
    if may_open(path):
        holder = _locked_by(path)
        if holder:
            return DeviceFinding(
                str(path), bad, f"is in use by {holder}", f"stop it: `fuser -v {path}` shows it"
            )
        return DeviceFinding(str(path), "ok", f"accessible{_by_id(path)}")
    group = _group_name(path.stat().st_gid)
    if group in user.enrolled and group not in user.groups:
        return DeviceFinding(
            str(path), bad, f"{user.name} is in the group {group}, but not yet in this login session",
            f"log out and in again, or `newgrp {group}` in this terminal",
        )  # fmt: skip
    if group in user.groups:
        return DeviceFinding(
            str(path), bad, f"the group {group} has no permission to open it",
            f"sudo chmod g+rw {path}; permanently: a udev rule with MODE=\"0660\"",
        )  # fmt: skip
    return DeviceFinding(
        str(path), bad, f"belongs to the group {group}, in which {user.name} is not",
        f"sudo usermod -aG {group} {user.name}, then log out and in again",
    )  # fmt: skip


def _what_is_there(others: list[Path], dev: Path) -> str:
    there = f"connected: {', '.join(map(str, others))}" if others else "no device of this kind is connected"
    if Path("/.dockerenv").exists() or Path("/run/.containerenv").exists():
        return f"{there}; this is a container: pass the device to it with --device={dev}/..."
    return f"{there}; `sudo dmesg | tail` shows what happened when it was connected"


def _check_network(option: str, device: str) -> DeviceFinding:
    host, _, port = device.removeprefix("tcp/").rpartition(":")
    if not host or not port.isdigit():
        return DeviceFinding(device, "fault", f"{option}: invalid address", "write tcp/HOST:PORT")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()
    except OSError as error:
        return DeviceFinding(
            device, "fault", f"{option}: does not answer ({error})",
            "set an address of this host in the same network (Hokuyo: 192.168.0.x); check cable and power",
        )  # fmt: skip
    return DeviceFinding(device, "ok", "answers")


def _locked_by(path: Path) -> str:
    """Return the program that has locked a serial port; "" if it is not locked."""
    if "tty" not in path.name:
        return ""
    try:
        handle = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        return "another program" if error.errno == 16 else ""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return "another program"
    finally:
        os.close(handle)
    return ""


def _by_id(path: Path) -> str:
    """Return a text with the name of a serial port that stays when it is reconnected; "" without one."""
    names = [
        link for link in (path.parent / "serial" / "by-id").glob("*") if link.resolve() == path.resolve()
    ]
    return f"; its stable name is {names[0]}" if names else ""


def _interfering_programs() -> Iterator[DeviceFinding]:
    running = {process.info["name"] for process in psutil.process_iter(["name"])}
    for name, remedy in _INTERFERING.items():
        if name in running:
            yield DeviceFinding(
                name, "note", "is running, and may send data to a lidar when it is connected", remedy
            )


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
