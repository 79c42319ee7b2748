"""Findings of `doctor` on serial ports and cameras, each with its remedy."""

import grp
import os
import pty
import socket

import pytest
import serial

from beamsplat.tools.setup.device_access import UserAccount, diagnose_devices, wanted_devices

GROUP = grp.getgrgid(os.getgid()).gr_name


@pytest.fixture
def dev(tmp_path):
    for name in ("ttyUSB0", "video0"):
        (tmp_path / name).touch()
    return tmp_path


def _say(dev, wanted, user, right=False):
    return {r.subject: r for r in diagnose_devices(wanted, dev, user, lambda path: right)}


def test_the_devices_a_deployment_names():
    nodes = {"lidar": {"kind": "ldrobot"}, "camera": {"source": "2"}}
    assert wanted_devices(nodes) == [("lidar.device", "/dev/ttyUSB0"), ("camera.source", "/dev/video2")]
    nodes = {"lidar": {"kind": "hokuyo"}, "camera": {"kind": "none", "rig": "x"}}
    assert wanted_devices(nodes) == [("lidar.device", "tcp/192.168.0.10:10940")]
    assert wanted_devices({"replay": {"data": "x"}}) == []


def test_a_user_outside_the_group(dev):
    reported = _say(
        dev, [("lidar.device", str(dev / "ttyUSB0"))], UserAccount("ann", frozenset(), frozenset())
    )
    lidar = reported[str(dev / "ttyUSB0")]
    assert lidar.verdict == "fault"
    assert f"belongs to the group {GROUP}, in which ann is not" in lidar.text
    assert lidar.remedy.startswith(f"sudo usermod -aG {GROUP} ann")
    assert reported[str(dev / "video0")].verdict == "note"  # not used by the deployment


def test_a_user_who_must_log_in_again(dev):
    reported = _say(
        dev, [("camera.source", str(dev / "video0"))], UserAccount("ann", frozenset(), frozenset({GROUP}))
    )
    assert "not yet in this login session" in reported[str(dev / "video0")].text
    assert "log out and in again" in reported[str(dev / "video0")].remedy


def test_a_group_without_permission(dev):
    reported = _say(
        dev, [("camera.source", str(dev / "video0"))], UserAccount("ann", frozenset({GROUP}), frozenset())
    )
    assert "udev rule" in reported[str(dev / "video0")].remedy


def test_an_accessible_device_and_its_stable_name(dev):
    (dev / "serial" / "by-id").mkdir(parents=True)
    (dev / "serial" / "by-id" / "usb-Silicon_Labs_CP2102").symlink_to(dev / "ttyUSB0")
    reported = _say(
        dev,
        [("lidar.device", str(dev / "ttyUSB0"))],
        UserAccount("ann", frozenset(), frozenset()),
        right=True,
    )
    assert reported[str(dev / "ttyUSB0")].verdict == "ok"
    assert "usb-Silicon_Labs_CP2102" in reported[str(dev / "ttyUSB0")].text


def test_a_missing_device_lists_the_connected_ones(dev):
    reported = _say(
        dev,
        [("lidar.device", str(dev / "ttyUSB7"))],
        UserAccount("ann", frozenset(), frozenset()),
        right=True,
    )
    missing = reported[str(dev / "ttyUSB7")]
    assert missing.verdict == "fault"
    assert str(dev / "ttyUSB0") in missing.remedy


def test_a_port_in_use_by_another_program(tmp_path):
    master, slave = pty.openpty()
    try:
        (tmp_path / "ttyUSB0").symlink_to(os.ttyname(slave))
        wanted = [("lidar.device", str(tmp_path / "ttyUSB0"))]
        free = {r.subject: r for r in diagnose_devices(wanted, tmp_path)}[str(tmp_path / "ttyUSB0")]
        assert free.verdict == "ok"
        with serial.Serial(str(tmp_path / "ttyUSB0"), exclusive=True):
            held = {r.subject: r for r in diagnose_devices(wanted, tmp_path)}[str(tmp_path / "ttyUSB0")]
        assert (held.verdict, held.text) == ("fault", "is in use by another program")
    finally:
        os.close(master)
        os.close(slave)


def test_network_lidars(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        (answers,) = diagnose_devices([("camera.source", f"tcp/127.0.0.1:{port}")], tmp_path)
    assert answers.verdict == "ok"
    (silent,) = diagnose_devices([("camera.source", f"tcp/127.0.0.1:{port}")], tmp_path)
    assert silent.verdict == "fault"
    assert "cable and power" in silent.remedy
    (wrong,) = diagnose_devices([("camera.source", "tcp/lidar")], tmp_path)
    assert "tcp/HOST:PORT" in wrong.remedy
