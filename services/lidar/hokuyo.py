"""Driver of Hokuyo lidars with SCIP 2.0 or 2.2 (URG, UBG, UHG, UTM, UST, UXM) over USB, RS-232 or TCP."""

from __future__ import annotations

import time

import numpy as np

from beamsplat.services.lidar.clock import CounterUnwrapper
from beamsplat.services.lidar.driver import LidarDriver
from beamsplat.services.lidar.framing import Framer
from beamsplat.services.lidar.link import DeviceLink, LinkError, drain
from beamsplat.services.lidar.samples import LidarRevolution, StampedScan
from beamsplat.services.lidar.scip import ScipGeometry, ScipScanReply, parameters

_ANSWER_S = 0.6  # time to wait for an answer
_TRIES = 4
_TIME_MODULUS_MS = 1 << 24  # the device's clock has 24 bits (SCIP 2.0)
_MIN_GOOD_RATIO = 0.2  # of a scan's blocks with a correct checksum; scans below are dropped


class HokuyoDriver(LidarDriver):
    """Driver of one Hokuyo lidar; angles are counter-clockwise; `intensity`: also read echo strengths."""

    bauds = (115200, 19200, 750000)
    clockwise = False

    def __init__(self, intensity: bool = False) -> None:
        super().__init__()
        self._intensity = intensity
        self._byte_time_s = 0.0
        self._reply: ScipScanReply  # set by `start`
        self._leftover = b""

    def start(self, link: DeviceLink) -> None:
        self.reset()
        self._byte_time_s = link.byte_time_s
        link.write(b"QT\n")
        drain(link)
        link.write(b"SCIP2.0\n")  # the URG-04LX starts in SCIP 1.1; other models answer "unknown command"
        drain(link)
        geometry = _query_geometry(link)
        self.model = f"Hokuyo {geometry.model.strip()}"
        self.range_min_m, self.range_max_m = geometry.range_min_m, geometry.range_max_m
        self._reply = ScipScanReply(geometry, self._intensity)
        self._framer = Framer(
            self._reply.length, self._reply.has_header, self._reply.has_header, self.counters, 1
        )
        self._time = CounterUnwrapper(_TIME_MODULUS_MS, 1e3)
        self._last_s: float | None = None
        self._missed_scans = 0
        self._leftover = _start_scanning(link, self._reply.command)

    def feed(self, data: bytes, at_ns: int) -> list[StampedScan]:
        data, self._leftover = self._leftover + data, b""
        found = []
        for packet in self._framer.feed(data):
            if packet is None:
                self._missed_scans += 1
                self.counters.dropped_scans += 1
                self.counters.lost_samples += self._reply.geometry.count
                continue
            found += self._scan(packet, at_ns)
        return found

    def stop(self, link: DeviceLink) -> None:
        link.write(b"QT\n")

    def _scan(self, packet: bytes, at_ns: int) -> list[StampedScan]:
        geometry = self._reply.geometry
        beam_s = geometry.period_s / geometry.steps_per_turn
        start_s = self._device_time_s(packet, at_ns)
        if start_s is None:
            self.counters.dropped_scans += 1
            self.counters.lost_samples += geometry.count
            return []
        range_m, intensity, blocks, bad = self._reply.values(packet)
        for i in range(blocks):
            self.noise.update(i >= bad)
        if bad > (1.0 - _MIN_GOOD_RATIO) * blocks:
            self.counters.dropped_scans += 1
            self.counters.lost_samples += geometry.count
            return []
        delay_ns = round(self._reply.length * self._byte_time_s * 1e9)
        if not self.clock.update(start_s + geometry.count * beam_s, at_ns - delay_ns):
            self.counters.dropped_scans += 1  # implausible time
            self.counters.lost_samples += geometry.count
            return []
        step_rad = 2.0 * np.pi / geometry.steps_per_turn
        turn = LidarRevolution(
            time_s=start_s,
            angle_min_rad=(geometry.first_step - geometry.front_step) * step_rad,
            angle_increment_rad=step_rad,
            time_increment_s=beam_s,
            scan_time_s=geometry.period_s,
            range_m=range_m.astype(np.float32),
            intensity=intensity.astype(np.float32) if self._intensity else np.zeros(0, np.float32),
        )
        lost = round(geometry.count * bad / blocks)
        found = self.builder.accept(turn, lost, self.noise.noisy)
        return [
            StampedScan(self.clock.stamp_ns(turn.time_s), turn, self.range_min_m, self.range_max_m)
            for turn in found
        ]

    def _device_time_s(self, packet: bytes, at_ns: int) -> float | None:
        """Return the device time (s) of the first measurement of a reply; None before the first valid time.

        If the checksum of the time is wrong, the time is extrapolated from the previous scan.
        """
        time_ms = self._reply.time_ms(packet)
        missed, self._missed_scans = self._missed_scans + 1, 0
        expected = None if self._last_s is None else self._last_s + missed * self._reply.geometry.period_s
        if time_ms is None:
            self._last_s = expected
            return expected
        self._last_s = self._time(time_ms, at_ns) / 1e3
        return self._last_s


def _query_geometry(link: DeviceLink) -> ScipGeometry:
    """Return the scan geometry that the device reports in its reply to the command PP.

    Raises:
        LinkError: no Hokuyo answers.
    """
    problem = "no Hokuyo lidar answers"
    for _ in range(_TRIES):
        try:
            return ScipGeometry.from_parameters(parameters(_request(link, b"PP\n")))
        except ValueError as error:
            problem = str(error)
    raise LinkError(problem)


def _request(link: DeviceLink, command: bytes) -> bytes:
    """Send a command; return the bytes received until an empty line or the timeout."""
    link.write(command)
    data, deadline = b"", time.monotonic() + _ANSWER_S
    while time.monotonic() < deadline and b"\n\n" not in data[data.find(command[:2]) + 1 :]:
        data += link.read(0.05)
    return data


def _start_scanning(link: DeviceLink, command: bytes) -> bytes:
    """Start continuous scans; return the first received bytes of the scans.

    Raises:
        LinkError: the device rejects the command.
    """
    status = b""
    for _ in range(_TRIES):
        link.write(command + b"\n")
        data, deadline = b"", time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline:
            data += link.read(0.05)
            agreed, first = command + b"\n00P\n\n", command + b"\n99b\n"
            if (at := data.find(agreed)) >= 0:
                return data[at + len(agreed) :]
            if (at := data.find(first)) >= 0:
                return data[at:]
            at = data.find(command + b"\n")
            if at >= 0 and len(data) >= at + 18:
                status = data[at + 16 : at + 18]
        link.write(b"QT\n")
        drain(link)
    raise LinkError(
        f"the Hokuyo lidar does not start to measure (status {status.decode('ascii', 'replace')!r})"
    )
