"""SLAMTEC's bytes: requests, descriptors and the four kinds of measurement packets.

SLAMTEC, "RPLIDAR Interface Protocol and Application Notes" LR001 v2.1; where that leaves a detail open
(sign of the angle compensation, padding of the HQ checksum) as in SLAMTEC's own SDK, sl_lidar_driver.cpp.
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
    """A request packet: 0xA5, command; with a payload its size, itself and the XOR of all before (2.2)."""
    head = bytes((0xA5, command))
    if not payload:
        return head
    body = head + bytes((len(payload),)) + payload
    return body + bytes((reduce(xor, body),))


class ResponseDescriptor(NamedTuple):
    """What announces a response (2.3)."""

    length: int  # of each data packet
    multiple: bool
    kind: int


def find_descriptor(data: bytes, kinds: tuple[int, ...]) -> tuple[ResponseDescriptor, int] | None:
    """The first descriptor of one of `kinds` in `data`, and where its data begin; None if there is none."""
    at = data.find(b"\xa5\x5a")
    while at >= 0 and at + DESCRIPTOR_BYTES <= len(data):
        word, kind = struct.unpack_from("<IB", data, at + 2)
        if kind in kinds:
            return ResponseDescriptor(word & 0x3FFFFFFF, word >> 30 == 1, kind), at + DESCRIPTOR_BYTES
        at = data.find(b"\xa5\x5a", at + 1)
    return None


class PacketSamples(NamedTuple):
    """Samples of a packet. Angles of capsules are relative to what the next capsule's start says."""

    start_deg: float
    first: bool  # the device says that a new stream begins here
    offset_deg: (
        np.ndarray
    )  # float64 [N]: capsules: taken off the evenly sample_times_s angle; HQ: the angle itself
    range_m: np.ndarray  # float64 [N], NaN = invalid
    quality: np.ndarray  # float64 [N]


def has_capsule_header(packet: bytes) -> bool:
    """Capsules start with the nibbles A and 5; the other halves are the checksum."""
    return packet[0] >> 4 == 0xA and packet[1] >> 4 == 0x5


def capsule_checksum_ok(packet: bytes) -> bool:
    """XOR of everything behind the two sync bytes."""
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(packet, np.uint8, offset=2)))
    return checksum == (packet[0] & 0xF) | (packet[1] & 0xF) << 4


def start_deg(packet: bytes) -> float:
    """Angle at which a capsule begins."""
    return (struct.unpack_from("<H", packet, 2)[0] & 0x7FFF) / 64.0


def parse_capsule(packet: bytes) -> PacketSamples:
    """32 samples in 16 cabins of two distances (q2 without its fraction) and two angle offsets (q3)."""
    word = struct.unpack_from("<H", packet, 2)[0]
    cabins = np.frombuffer(packet, [("d", "<u2", 2), ("angles", "u1")], count=16, offset=4)
    mm = (cabins["d"] >> 2).ravel().astype(np.float64)
    low = np.stack([cabins["angles"] & 0xF, cabins["angles"] >> 4], axis=1).astype(np.int64)
    offset_q3 = low | (cabins["d"].astype(np.int64) & 0x3) << 4
    return PacketSamples(
        (word & 0x7FFF) / 64.0, bool(word >> 15), offset_q3.ravel() / 8.0, _metres(mm), mm * 0.0
    )


def parse_dense(packet: bytes) -> PacketSamples:
    """40 distances in mm at even angles."""
    word = struct.unpack_from("<H", packet, 2)[0]
    mm = np.frombuffer(packet, "<u2", count=40, offset=4).astype(np.float64)
    return PacketSamples((word & 0x7FFF) / 64.0, bool(word >> 15), np.zeros(40), _metres(mm), np.zeros(40))


# Steps of the variable bit scale: where a code's range begins, what distance (mm) that is, shift within it.
_SCALE_FROM = np.array([0, 512, 1280, 1792, 3328])
_SCALE_MM = np.array([0, 1 << 9, 1 << 11, 1 << 12, 1 << 14])
_SCALE_SHIFT = np.array([0, 1, 2, 3, 4])


def parse_ultra(packet: bytes, following: bytes | None) -> PacketSamples:
    """96 samples in 32 cabins: a distance of variable scale, and two told by their difference from it and
    from the next cabin's, for which the packet that follows is needed (None: the last sample is lost).

    As _ultraCapsuleToNormal of SLAMTEC's SDK, with the angle offset that the device leaves to the host.
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
    """How far aside a triangulating lidar looks, by distance, in the fixed point numbers of the SDK."""
    quarter = np.maximum(mm * 4.0, 200.0).astype(np.int64)
    k = 98361 // quarter
    radians_q16 = int(8 * np.pi * 65536 / 180) - (k << 6) - k * k * k // 98304
    radians_q16 = np.where(mm * 4.0 >= 200.0, radians_q16, int(7.5 * np.pi * 65536 / 180))
    return np.degrees(radians_q16 / 65536.0)


def has_hq_header(packet: bytes) -> bool:
    """HQ packets start with the byte A5."""
    return packet[0] == 0xA5


def hq_checksum_ok(packet: bytes) -> bool:
    """CRC-32 (IEEE 802.3) of all before it, filled with zeros to a multiple of four."""
    body = packet[:-4]
    return zlib.crc32(body + bytes(-len(body) % 4)) == struct.unpack_from("<I", packet, len(body))[0]


def parse_hq(packet: bytes) -> PacketSamples:
    """96 samples, each with its own angle in units of 90 / 2^14 degrees and distance in mm / 4."""
    nodes = np.frombuffer(packet, _HQ_NODE, count=96, offset=9)
    angle = nodes["angle_q14"] * (90.0 / 16384.0)
    mm = nodes["mm_q2"] / 4.0
    first = bool(nodes["flag"][0] & 1)
    return PacketSamples(float(angle[0]), first, angle, _metres(mm), nodes["quality"].astype(np.float64))


def has_node_header(packet: bytes) -> bool:
    """Two bits of the first byte must differ and one of the second be set: that is all there is to check."""
    return (packet[0] ^ packet[0] >> 1) & 1 == 1 and packet[1] & 1 == 1


class MeasurementNode(NamedTuple):
    """One sample of the standard scan."""

    first: bool  # of a turn
    angle_deg: float
    range_m: float  # NaN = invalid
    quality: float


def parse_node(packet: bytes) -> MeasurementNode:
    """One sample: quality, angle in degrees / 64, distance in mm / 4 (4.2)."""
    angle, distance = (packet[1] | packet[2] << 8) >> 1, packet[3] | packet[4] << 8
    range_m = distance / 4000.0 if distance else math.nan
    return MeasurementNode(bool(packet[0] & 1), angle / 64.0, range_m, float(packet[0] >> 2))


def _metres(mm: np.ndarray) -> np.ndarray:
    return np.where(mm > 0.0, mm / 1000.0, np.nan)
