"""Driver of SLAMTEC RPLIDAR (A, S and C series): identifies the model, starts its best supported stream."""

from __future__ import annotations

import struct
import time

from beamsplat.services.lidar import rplidar_packets as rp
from beamsplat.services.lidar.driver import LidarDriver
from beamsplat.services.lidar.link import DeviceLink, LinkError, drain
from beamsplat.services.lidar.rplidar_stream import RplidarStream
from beamsplat.services.lidar.samples import StampedScan

_ANSWER_S = 0.4  # time to wait for an answer
_TRIES = 4
_MOTOR_PWM = 660  # SLAMTEC's default for the A2 and A3
_PWM_MODELS = (2, 3)
# Sample period (s) of each stream type, used where the device does not report it.
_SAMPLE_S = {rp.STANDARD: 500e-6, rp.CAPSULED: 250e-6, rp.HQ: 62.5e-6, rp.ULTRA: 62.5e-6, rp.DENSE: 100e-6}
# Upper four bits of the model number -> name and maximum range (m) of the data sheet.
_MODELS = {
    1: ("A1", 12.0), 2: ("A2", 16.0), 3: ("A3", 25.0), 4: ("C1", 12.0), 6: ("S1", 40.0), 7: ("S2", 30.0),
    8: ("S3", 40.0),
}  # fmt: skip


class RplidarDriver(LidarDriver):
    """Driver of one RPLIDAR.

    `mode`: "auto" uses the device's typical mode if its packets are supported, else express, else standard.
    """

    bauds = (115200, 460800, 256000, 1000000)  # A1 and A2; C1; A3 and S1; S2 and S3

    def __init__(self, mode: str = "auto") -> None:
        super().__init__(no_checksum=mode == "standard")
        self.mode = mode
        self._stream: RplidarStream  # set by `start`
        self._byte_time_s = 0.0
        self._leftover = b""

    def start(self, link: DeviceLink) -> None:
        self.reset()
        self._byte_time_s = link.byte_time_s
        link.set_motor(True)
        link.write(rp.request(rp.STOP))
        time.sleep(0.01)  # the protocol requires 1 ms; bytes in transit arrive meanwhile
        drain(link)
        info = _request(link, rp.request(rp.GET_INFO), rp.INFO)
        model, firmware = info[0], info[2] + info[1] / 100.0
        name, self.range_max_m = _MODELS.get(model >> 4, (f"model {model:#04x}", 40.0))
        self.range_min_m = 0.05
        self.model = f"RPLIDAR {name}, firmware {firmware:.2f}"
        status, code = struct.unpack_from("<BH", _request(link, rp.request(rp.GET_HEALTH), rp.HEALTH))
        if status == 2:
            link.write(rp.request(rp.RESET))  # only a reset ends the protection stop
            raise LinkError(
                f"{self.model} reports fault {code:#06x} and was reset; replace it if the fault persists"
            )
        if model >> 4 in _PWM_MODELS:
            link.write(rp.request(rp.SET_MOTOR_PWM, struct.pack("<H", _MOTOR_PWM)))
        self._start_best_stream(link, model)

    def feed(self, data: bytes, at_ns: int) -> list[StampedScan]:
        data, self._leftover = self._leftover + data, b""
        parts = self._stream.feed(data)
        for part in parts:
            self.noise.update(part is not None)
        if any(part is not None for part in parts):
            delay_s = rp.PACKET_BYTES[self._stream.kind] * self._byte_time_s
            self.clock.update(self._stream.newest_s, at_ns - round(delay_s * 1e9))
        return self.stamp_revolutions([part for part in parts if part is not None])

    def stop(self, link: DeviceLink) -> None:
        link.write(rp.request(rp.STOP))
        link.set_motor(False)

    def _start_best_stream(self, link: DeviceLink, model: int) -> None:
        """Start the first stream that the device accepts, in order of preference."""
        attempts: list[tuple[bytes, float | None]] = []
        if self.mode == "auto" and model >> 4 not in (1,):  # the A1 has no modes
            attempts += _typical_mode(link)
        if self.mode in ("auto", "express"):
            attempts.append((rp.request(rp.EXPRESS_SCAN, bytes(5)), None))
        if self.mode in ("auto", "standard"):
            attempts.append((rp.request(rp.SCAN), None))
        for message, sample_s in attempts:
            kind, self._leftover = _start_stream(link, message)
            if kind is not None:
                self._stream = RplidarStream(kind, sample_s or self._rate(link, kind), self.counters)
                return
        raise LinkError(f'{self.model} does not start a stream in mode {self.mode!r}; try mode = "standard"')

    def _rate(self, link: DeviceLink, kind: int) -> float:
        return _SAMPLE_S[kind]


def _typical_mode(link: DeviceLink) -> list[tuple[bytes, float | None]]:
    """Return [(request, sample period s)] for the device's typical mode; [] if it is not supported."""
    mode = _read_configuration(link, rp.CONF_TYPICAL_MODE)
    if mode is None or len(mode) < 2:
        return []
    number = mode[:2]
    kind = _read_configuration(link, rp.CONF_ANSWER_TYPE, number)
    if not kind or kind[0] not in (rp.CAPSULED, rp.DENSE, rp.HQ, rp.ULTRA):
        return []
    sample_us = _read_configuration(link, rp.CONF_US_PER_SAMPLE, number)
    sample_s = struct.unpack_from("<I", sample_us)[0] / 256e6 if sample_us and len(sample_us) >= 4 else None
    # As in SLAMTEC's SDK: mode 1 is requested as 0, the default.
    working_mode = number[:1] if number[0] > 1 else b"\0"
    return [(rp.request(rp.EXPRESS_SCAN, working_mode + bytes(4)), sample_s)]


def _read_configuration(link: DeviceLink, entry: int, payload: bytes = b"") -> bytes | None:
    """Return an entry of the device's configuration; None if the device does not answer (old firmware)."""
    try:
        answer = _request(
            link, rp.request(rp.GET_LIDAR_CONF, struct.pack("<I", entry) + payload), rp.CONF, tries=2
        )
    except LinkError:
        return None
    return answer[4:] if answer[:4] == struct.pack("<I", entry) else None


def _request(link: DeviceLink, message: bytes, kind: int, tries: int = _TRIES) -> bytes:
    """Send a request; return the data of its single response.

    Raises:
        LinkError: no answer.
    """
    for _ in range(tries):
        link.write(message)
        data, deadline = b"", time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline:
            data += link.read(0.05)
            found = rp.find_descriptor(data, (kind,))
            if found is not None and found[0].length <= 256:
                descriptor, start = found
                if len(data) >= start + descriptor.length:
                    return data[start : start + descriptor.length]
    raise LinkError("no RPLIDAR answers at this baud rate")


def _start_stream(link: DeviceLink, message: bytes) -> tuple[int | None, bytes]:
    """Send a request; return the type of the started stream (None: none started) and its first bytes."""
    for _ in range(_TRIES):
        link.write(message)
        data, deadline = b"", time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline:
            data += link.read(0.05)
            found = rp.find_descriptor(data, tuple(rp.PACKET_BYTES))
            if found is not None:
                return found[0].kind, data[found[1] :]
        link.write(rp.request(rp.STOP))
        drain(link)
    return None, b""
