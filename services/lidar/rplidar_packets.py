"""SLAMTEC's protocol: requests, response descriptors and the measurement packets.

SLAMTEC, "RPLIDAR Interface Protocol and Application Notes" LR001 v2.1. Details that it leaves open (sign of
the angle compensation, padding of the HQ checksum) follow SLAMTEC's SDK, sl_lidar_driver.cpp.
"""

from __future__ import annotations

import math
import struct
import zlib
from functools import reduce
from operator import xor
from typing import NamedTuple

import numpy as np

STOP, RESET, SCAN, EXPRESS_SCAN = 0x25, 0x40, 0x20, 0x82
GET_INFO, GET_HEALTH, GET_SAMPLERATE, GET_LIDAR_CONF, SET_MOTOR_PWM = 0x50, 0x52, 0x59, 0x84, 0xF0

INFO, HEALTH, SAMPLERATE, CONF = 0x04, 0x06, 0x15, 0x20
STANDARD, CAPSULED, HQ, ULTRA, DENSE = 0x81, 0x82, 0x83, 0x84, 0x85
PACKET_BYTES = {STANDARD: 5, CAPSULED: 84, HQ: 781, ULTRA: 132, DENSE: 84}
SAMPLES = {STANDARD: 1, CAPSULED: 32, HQ: 96, ULTRA: 96, DENSE: 40}

CONF_US_PER_SAMPLE, CONF_ANSWER_TYPE, CONF_TYPICAL_MODE = 0x71, 0x75, 0x7C
DESCRIPTOR_BYTES = 7
_HQ_NODE = np.dtype([("angle_q14", "<u2"), ("mm_q2", "<u4"), ("quality", "u1"), ("flag", "u1")])


def request(command: int, payload: bytes = b"") -> bytes:
    """Return a request packet (2.2): 0xA5, command; with a payload also its size, payload and XOR."""
    head = bytes((0xA5, command))
    if not payload:
        return head
    body = head + bytes((len(payload),)) + payload
    return body + bytes((reduce(xor, body),))


class ResponseDescriptor(NamedTuple):
    """The header before a response of the device (2.3): data length, one or several packets, type."""

    length: int  # of each data packet
    multiple: bool
    kind: int


def find_descriptor(data: bytes, kinds: tuple[int, ...]) -> tuple[ResponseDescriptor, int] | None:
    """Return the first descriptor of one of `kinds` and the offset of its data; None if there is none."""
    at = data.find(b"\xa5\x5a")
    while at >= 0 and at + DESCRIPTOR_BYTES <= len(data):
        word, kind = struct.unpack_from("<IB", data, at + 2)
        if kind in kinds:
            return ResponseDescriptor(word & 0x3FFFFFFF, word >> 30 == 1, kind), at + DESCRIPTOR_BYTES
        at = data.find(b"\xa5\x5a", at + 1)
    return None


class PacketSamples(NamedTuple):
    """The decoded samples of one packet.

    Angles of capsules are relative to the start angles of this capsule and of the next one.
    """

    start_deg: float
    first: bool  # start flag of the device: first packet of a stream
    # float64 [N]; capsules: subtracted from the evenly spaced angle; HQ: the angle itself
    offset_deg: np.ndarray
    range_m: np.ndarray  # float64 [N], NaN = invalid
    quality: np.ndarray  # float64 [N]


def has_capsule_header(packet: bytes) -> bool:
    """Return whether the upper four bits of the first two bytes are 0xA and 0x5 (lower bits: checksum)."""
    return packet[0] >> 4 == 0xA and packet[1] >> 4 == 0x5


def capsule_checksum_ok(packet: bytes) -> bool:
    """Return whether the checksum is the XOR of all bytes after the two sync bytes."""
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(packet, np.uint8, offset=2)))
    return checksum == (packet[0] & 0xF) | (packet[1] & 0xF) << 4


def start_deg(packet: bytes) -> float:
    """Return the start angle of a capsule."""
    return (struct.unpack_from("<H", packet, 2)[0] & 0x7FFF) / 64.0


def parse_capsule(packet: bytes) -> PacketSamples:
    """Decode 32 samples in 16 groups ("cabins") of two distances (mm) and two angle offsets (degrees / 8)."""
    word = struct.unpack_from("<H", packet, 2)[0]
    cabins = np.frombuffer(packet, [("d", "<u2", 2), ("angles", "u1")], count=16, offset=4)
    mm = (cabins["d"] >> 2).ravel().astype(np.float64)
    low = np.stack([cabins["angles"] & 0xF, cabins["angles"] >> 4], axis=1).astype(np.int64)
    offset_q3 = low | (cabins["d"].astype(np.int64) & 0x3) << 4
    return PacketSamples(
        (word & 0x7FFF) / 64.0, bool(word >> 15), offset_q3.ravel() / 8.0, _metres(mm), mm * 0.0
    )


def parse_dense(packet: bytes) -> PacketSamples:
    """Decode 40 distances in mm at evenly spaced angles."""
    word = struct.unpack_from("<H", packet, 2)[0]
    mm = np.frombuffer(packet, "<u2", count=40, offset=4).astype(np.float64)
    return PacketSamples((word & 0x7FFF) / 64.0, bool(word >> 15), np.zeros(40), _metres(mm), np.zeros(40))


# Variable bit scale: first code of each segment, its distance (mm), and the shift within the segment.
_SCALE_FROM = np.array([0, 512, 1280, 1792, 3328])
_SCALE_MM = np.array([0, 1 << 9, 1 << 11, 1 << 12, 1 << 14])
_SCALE_SHIFT = np.array([0, 1, 2, 3, 4])


def parse_ultra(packet: bytes, following: bytes | None) -> PacketSamples:
    """Decode 96 samples in 32 groups ("cabins").

    A cabin contains one distance of variable scale and two predicted distances: differences from this
    distance and from the distance of the next cabin. The last cabin therefore needs the following packet
    (None: its last sample is lost). As _ultraCapsuleToNormal of SLAMTEC's SDK, with the angle offset that the
    host must compute.
    """
    word = struct.unpack_from("<H", packet, 2)[0]
    cabins = np.frombuffer(packet, "<i4", count=32, offset=4).astype(np.int64)
    after = cabins[-1:] * 0 if following is None else np.frombuffer(following, "<i4", 1, 4).astype(np.int64)
    code = np.concatenate([cabins, after]) & 0xFFF
    step = np.searchsorted(_SCALE_FROM, code, side="right") - 1
    shift = _SCALE_SHIFT[step]
    mm = _SCALE_MM[step] + (code - _SCALE_FROM[step] << shift)
    major, base2, shift2 = mm[:-1], mm[1:], shift[1:]
    borrowed = (major == 0) & (base2 != 0)
    base1, shift1 = np.where(borrowed, base2, major), np.where(borrowed, shift2, shift[:-1])
    predict1, predict2 = (cabins << 42) >> 54, cabins >> 22  # signed, ten bits each
    second = np.where(np.isin(predict1, (-512, 511)), 0, base1 + (predict1 << shift1))
    third = np.where(np.isin(predict2, (-512, 511)), 0, base2 + (predict2 << shift2))
    if following is None:
        third[-1] = 0
        second[-1] = second[-1] if major[-1] else 0
    distance = np.stack([major, second, third], axis=1).ravel().astype(np.float64)
    return PacketSamples(
        (word & 0x7FFF) / 64.0,
        bool(word >> 15),
        _ultra_offset_deg(distance),
        _metres(distance),
        distance * 0.0,
    )


def _ultra_offset_deg(mm: np.ndarray) -> np.ndarray:
    """Return the angle offset (degrees) at distances in mm, in the fixed-point arithmetic of the SDK."""
    quarter = np.maximum(mm * 4.0, 200.0).astype(np.int64)
    k = 98361 // quarter
    radians_q16 = int(8 * np.pi * 65536 / 180) - (k << 6) - k * k * k // 98304
    radians_q16 = np.where(mm * 4.0 >= 200.0, radians_q16, int(7.5 * np.pi * 65536 / 180))
    return np.degrees(radians_q16 / 65536.0)


def has_hq_header(packet: bytes) -> bool:
    """Return whether the packet starts with 0xA5."""
    return packet[0] == 0xA5


def hq_checksum_ok(packet: bytes) -> bool:
    """Return whether the CRC-32 (IEEE 802.3) at the end of the packet is correct.

    The CRC is computed over the preceding bytes, zero-padded to a multiple of four.
    """
    body = packet[:-4]
    return zlib.crc32(body + bytes(-len(body) % 4)) == struct.unpack_from("<I", packet, len(body))[0]


def parse_hq(packet: bytes) -> PacketSamples:
    """Decode 96 samples, each with its own angle (90 / 2^14 degrees) and distance (mm / 4)."""
    nodes = np.frombuffer(packet, _HQ_NODE, count=96, offset=9)
    angle = nodes["angle_q14"] * (90.0 / 16384.0)
    mm = nodes["mm_q2"] / 4.0
    first = bool(nodes["flag"][0] & 1)
    return PacketSamples(float(angle[0]), first, angle, _metres(mm), nodes["quality"].astype(np.float64))


def has_node_header(packet: bytes) -> bool:
    """Return whether start bit and inverse start bit differ and the check bit is set (no checksum)."""
    return (packet[0] ^ packet[0] >> 1) & 1 == 1 and packet[1] & 1 == 1


class MeasurementNode(NamedTuple):
    """One sample of the standard scan ("node" in SLAMTEC's protocol)."""

    first: bool  # start of a revolution
    angle_deg: float
    range_m: float  # NaN = invalid
    quality: float


def parse_node(packet: bytes) -> MeasurementNode:
    """Decode one sample of the standard scan (4.2): quality, angle in degrees / 64, distance in mm / 4."""
    angle, distance = (packet[1] | packet[2] << 8) >> 1, packet[3] | packet[4] << 8
    range_m = distance / 4000.0 if distance else math.nan
    return MeasurementNode(bool(packet[0] & 1), angle / 64.0, range_m, float(packet[0] >> 2))


def _metres(mm: np.ndarray) -> np.ndarray:
    return np.where(mm > 0.0, mm / 1000.0, np.nan)
