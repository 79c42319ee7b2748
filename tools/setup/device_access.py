"""Cameras and serial ports of this machine: are they there, who may open them, does somebody hold them?"""

from __future__ import annotations

import fcntl
import getpass
import grp
import os
import socket
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import psutil

_CONNECT_S = 0.5
# Programs that open every new serial port to see whether a modem or a Braille display is there.
_PROBERS = {
    "ModemManager": "sudo systemctl disable --now ModemManager",
    "brltty": "sudo systemctl mask brltty-udev.service; sudo apt remove brltty",
}


class Remark(NamedTuple):
    """One line about a device: verdict is ok, note or fault."""

    subject: str
    verdict: str
    text: str
    remedy: str = ""


class User(NamedTuple):
    """Who wants to open devices."""

    name: str
    groups: frozenset[str]  # of this session
    enrolled: frozenset[str]  # by /etc/group: in force at the next login

    @staticmethod
    def now() -> User:
        """Whoever runs this."""
        name = getpass.getuser()
        groups = {_group_name(gid) for gid in os.getgroups()}
        return User(name, frozenset(groups), frozenset(g.gr_name for g in grp.getgrall() if name in g.gr_mem))


def wanted_devices(nodes: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """(option, device) of the cameras and lidars in a deployment's raw tables."""
    found = []
    lidar, camera = nodes.get("lidar"), nodes.get("camera")
    if lidar is not None:
        default = "tcp/192.168.0.10:10940" if lidar.get("kind") == "hokuyo" else "/dev/ttyUSB0"
        found.append(("lidar.device", str(lidar.get("device", default))))
    if camera is not None and camera.get("kind") != "none":
        source = str(camera.get("source", "0"))
        found.append(("camera.source", f"/dev/video{source}" if source.isdigit() else source))
    return found


def examine_devices(
    wanted: Iterable[tuple[str, str]],
    dev: Path = Path("/dev"),
    user: User | None = None,
    may_open: Callable[[Path], bool] = lambda path: os.access(path, os.R_OK | os.W_OK),
) -> Iterator[Remark]:
    """What is to say of the devices a deployment wants, and of the others that are plugged in."""
    user = user or User.now()
    serial = sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")])
    video = sorted(dev.glob("video[0-9]*"))
    said: set[Path] = set()
    for option, device in wanted:
        if device.startswith("tcp/"):
            yield _network(option, device)
        elif not device.startswith(str(dev)):
            continue  # a stream or a file: the camera itself says what is wrong with it
        elif not (path := Path(device)).exists():
            others = video if option.startswith("camera") else serial
            yield Remark(device, "fault", f"{option}: no such device", _missing(others, dev))
        else:
            said.add(path.resolve())
            yield _openable(path, user, may_open, needed=True)
    for path in [*serial, *video]:
        if path.resolve() not in said:
            yield _openable(path, user, may_open, needed=False)
    if serial or any(option == "lidar.device" for option, _ in wanted):
        yield from _probers()


def _openable(path: Path, user: User, may_open: Callable[[Path], bool], *, needed: bool) -> Remark:
    """May this user open it, and is it free?"""
    bad = "fault" if needed else "note"
    if may_open(path):
        holder = _holder(path)
        if holder:
            return Remark(str(path), bad, f"is held by {holder}", f"stop it: `fuser -v {path}` shows it")
        return Remark(str(path), "ok", f"may be opened{_by_id(path)}")
    group = _group_name(path.stat().st_gid)
    if group in user.enrolled and group not in user.groups:
        return Remark(
            str(path), bad, f"{user.name} is in the group {group}, but not yet in this session",
            f"log out and in again, or `newgrp {group}` in this terminal",
        )  # fmt: skip
    if group in user.groups:
        return Remark(
            str(path), bad, f"the group {group} has no right to it",
            f"sudo chmod g+rw {path}; for good, a udev rule with MODE=\"0660\"",
        )  # fmt: skip
    return Remark(
        str(path), bad, f"belongs to the group {group}, in which {user.name} is not",
        f"sudo usermod -aG {group} {user.name}, then log out and in again",
    )  # fmt: skip


def _missing(others: list[Path], dev: Path) -> str:
    there = f"there are: {', '.join(map(str, others))}" if others else "nothing of that kind is plugged in"
    if Path("/.dockerenv").exists() or Path("/run/.containerenv").exists():
        return f"{there}; this is a container: give it the device with --device={dev}/..."
    return f"{there}; `sudo dmesg | tail` tells what happened when it was plugged in"


def _network(option: str, device: str) -> Remark:
    host, _, port = device.removeprefix("tcp/").rpartition(":")
    if not host or not port.isdigit():
        return Remark(device, "fault", f"{option}: no address", "write tcp/HOST:PORT")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_S).close()
    except OSError as error:
        return Remark(
            device, "fault", f"{option}: does not answer ({error})",
            "give this host an address in the same network (Hokuyo: 192.168.0.x), and check cable and power",
        )  # fmt: skip
    return Remark(device, "ok", "answers")


def _holder(path: Path) -> str:
    """Who has locked a serial port; "" if nobody."""
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
    """The name that survives replugging."""
    names = [
        link for link in (path.parent / "serial" / "by-id").glob("*") if link.resolve() == path.resolve()
    ]
    return f"; its lasting name is {names[0]}" if names else ""


def _probers() -> Iterator[Remark]:
    running = {process.info["name"] for process in psutil.process_iter(["name"])}
    for name, remedy in _PROBERS.items():
        if name in running:
            yield Remark(name, "note", "runs, and may talk to a lidar when it is plugged in", remedy)


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
