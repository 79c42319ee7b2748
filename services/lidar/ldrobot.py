"""Driver of LDROBOT LD06, LD19 and compatible lidars, which send packets of 47 bytes when powered.

LDROBOT, "LD06 / LD19 Development Manual", chapter 3 (communication protocol): 0x54, 0x2C (twelve points),
speed in degrees per second, start angle in 0.01 degrees, twelve times distance in mm and intensity, end
angle, time in ms (wraps at 30000), CRC-8 with polynomial 0x4D.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from beamsplat.services.lidar.clock import CounterUnwrapper, sample_times_s
from beamsplat.services.lidar.driver import LidarDriver, StartAngleGate
from beamsplat.services.lidar.framing import Framer
from beamsplat.services.lidar.link import DeviceLink
from beamsplat.services.lidar.samples import Samples, StampedScan

PACKET_BYTES = 47
POINTS = 12
_HEAD = b"\x54\x2c"
_LAYOUT = struct.Struct("<2sHH36sHHB")
_TIME_MODULUS_MS = 30000


def _crc_table() -> bytes:
    table = []
    for value in range(256):
        for _ in range(8):
            value = ((value << 1) ^ 0x4D if value & 0x80 else value << 1) & 0xFF
        table.append(value)
    return bytes(table)


_CRC = _crc_table()


def crc8(data: bytes) -> int:
    """Return the CRC-8 with polynomial 0x4D, initial value 0, most significant bit first."""
    value = 0
    for byte in data:
        value = _CRC[value ^ byte]
    return value


class LdrobotPacket(NamedTuple):
    """The decoded values of one packet."""

    speed_deg_s: float
    start_deg: float
    end_deg: float
    time_ms: int
    range_m: np.ndarray  # float64 [12], NaN where the distance is 0 (no valid measurement)
    intensity: np.ndarray  # float64 [12]

    @property
    def step_deg(self) -> float:
        """Return the angle between two consecutive points."""
        return ((self.end_deg - self.start_deg) % 360.0) / (POINTS - 1)


def has_header(packet: bytes) -> bool:
    """Return whether a packet starts with 0x54, 0x2C."""
    return packet.startswith(_HEAD)


def checksum_ok(packet: bytes) -> bool:
    """Return whether a packet's CRC is correct."""
    return crc8(packet[:-1]) == packet[-1]


def parse(packet: bytes) -> LdrobotPacket:
    """Decode one packet of 47 bytes."""
    _, speed, start, points, end, time_ms, _ = _LAYOUT.unpack(packet)
    data = np.frombuffer(points, dtype=[("mm", "<u2"), ("intensity", "u1")])
    range_m = np.where(data["mm"] > 0, data["mm"] / 1000.0, np.nan)
    return LdrobotPacket(
        float(speed), start / 100.0, end / 100.0, time_ms, range_m, data["intensity"].astype(np.float64)
    )


class LdrobotDriver(LidarDriver):
    """Driver of one LDROBOT lidar, which has no commands. Angles are clockwise seen from above."""

    bauds = (230400,)

    def __init__(self) -> None:
        super().__init__()
        self.range_min_m, self.range_max_m = 0.02, 12.0
        self.model = "LDROBOT LD06/LD19"
        self._byte_time_s = 0.0
        self.reset()

    def start(self, link: DeviceLink) -> None:
        self._byte_time_s = link.byte_time_s
        self.reset()

    def reset(self) -> None:
        super().reset()
        self._framer = Framer(PACKET_BYTES, has_header, checksum_ok, self.counters, check_next_header=True)
        self._start_gate = StartAngleGate()
        self._pending_at_ns = 0
        self._time = CounterUnwrapper(_TIME_MODULUS_MS, 1e3)

    def feed(self, data: bytes, at_ns: int) -> list[StampedScan]:
        parts = []
        waiting, arrived_ns, taken = self._framer.pending, self._pending_at_ns, 0
        for number, packet in enumerate(self._framer.feed(data)):
            came_ns = arrived_ns if number < waiting else at_ns
            taken = number + 1
            self.noise.update(packet is not None)
            if packet is None:
                self._start_gate.skip_packets()
                continue
            values = parse(packet)
            last_s = self._time(values.time_ms % _TIME_MODULUS_MS, came_ns) / 1e3
            in_place = self._start_gate.accepts(values.start_deg)
            possible = 0.0 < values.step_deg < 3.0 and values.speed_deg_s > 0.0
            delay_ns = round(PACKET_BYTES * self._byte_time_s * 1e9)
            if not (in_place and possible and self.clock.update(last_s, came_ns - delay_ns)):
                continue  # its samples are counted as lost when the revolution is complete
            parts.append(
                Samples(
                    angle_deg=values.start_deg + values.step_deg * np.arange(POINTS),
                    range_m=values.range_m,
                    intensity=values.intensity,
                    time_s=sample_times_s(last_s, values.step_deg / values.speed_deg_s, POINTS),
                )
            )
        if self._framer.pending > max(waiting - taken, 0):
            self._pending_at_ns = at_ns
        return self.stamp_revolutions(parts)
