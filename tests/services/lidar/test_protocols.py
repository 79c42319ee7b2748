"""Packets printed in the vendors' documents are decoded to the values printed there."""

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beamsplat.services.lidar import ldrobot, scip
from beamsplat.services.lidar import rplidar_packets as rp

# LDROBOT, LD06 Development Manual v1.0, 3.3 "Example": the packet and the values printed beside it.
LD06_EXAMPLE = bytes.fromhex(
    "542C6808AB7EE000E4DC00E2D900E5D500E3D300E4D000E9CD00E4CA00E2C700E9C500E5C200E5C000E5BE823A1A50"
)


def test_ldrobot_example_of_the_manual():
    assert len(LD06_EXAMPLE) == ldrobot.PACKET_BYTES
    assert ldrobot.has_header(LD06_EXAMPLE)
    assert ldrobot.checksum_ok(LD06_EXAMPLE)
    packet = ldrobot.parse(LD06_EXAMPLE)
    assert (packet.speed_deg_s, packet.start_deg, packet.end_deg) == (
        2152.0,
        324.27,
        334.7,
    )  # 0868H 7EABH 82BEH
    assert packet.time_ms == 0x1A3A
    assert packet.range_m[[0, 1, 11]] == pytest.approx([0.224, 0.220, 0.192])  # 00E0H 00DCH 00C0H
    assert packet.intensity[[0, 1, 11]].tolist() == [0xE4, 0xE2, 0xE5]


@pytest.mark.parametrize("at", range(ldrobot.PACKET_BYTES))
def test_ldrobot_checksum_detects_any_wrong_byte(at):
    for flip in (0x01, 0x80, 0xFF):
        wrong = bytearray(LD06_EXAMPLE)
        wrong[at] ^= flip
        assert not ldrobot.checksum_ok(bytes(wrong))


def test_rplidar_requests_and_descriptors_of_the_protocol_document():
    """LR001 v2.1: figures 4-2 (STOP), 4-14 (express scan), 4-25 (info), 4-28 (health), 4-4 (scan)."""
    assert rp.request(rp.STOP) == bytes.fromhex("A525")
    assert rp.request(rp.GET_INFO) == bytes.fromhex("A550")
    assert rp.request(rp.EXPRESS_SCAN, bytes(5)) == bytes.fromhex("A58205000000000022")
    kinds = (rp.INFO, rp.HEALTH, *rp.PACKET_BYTES)
    assert rp.find_descriptor(bytes.fromhex("A55A1400000004"), kinds) == ((20, False, 0x04), 7)
    assert rp.find_descriptor(bytes.fromhex("A55A0300000006"), kinds) == ((3, False, 0x06), 7)
    assert rp.find_descriptor(bytes.fromhex("A55A0500004081"), kinds) == ((5, True, 0x81), 7)
    assert rp.find_descriptor(bytes.fromhex("00A5A55A5400004082"), kinds) == ((84, True, 0x82), 9)


def test_rplidar_recorded_exchange():
    """An A2M8's exchange, printed in zerowincoding.tistory.com, "RPLIDAR SDK" (2020)."""
    assert rp.request(0xFF, bytes(2)) == bytes.fromhex("A5FF02000058")
    assert rp.request(rp.SET_MOTOR_PWM, bytes(2)) == bytes.fromhex("A5F002000057")
    answer = bytes.fromhex("A55A140000000428190105F1959A87C5E392D3A5E49EF061403D65")
    (length, _, _), start = rp.find_descriptor(answer, (rp.INFO,))
    info = answer[start : start + length]
    assert (info[0] >> 4, info[2], info[1]) == (2, 1, 25)  # A2, firmware 1.25


def _sdk_capsule(previous, current):
    """Decode as _capsuleToNormal of sl_lidar_driver.cpp, in integers: (angle q6, distance q2) of 32
    samples.
    """
    start = [(struct.unpack_from("<H", p, 2)[0] & 0x7FFF) << 2 for p in (previous, current)]
    difference = start[1] - start[0] + (360 << 8 if start[0] > start[1] else 0)
    increment, angle, found = difference << 3, start[0] << 8, []
    for i in range(16):
        one, two, offsets = struct.unpack_from("<HHB", previous, 4 + 5 * i)
        for word, low in ((one, offsets & 0xF), (two, offsets >> 4)):
            offset = low | (word & 0x3) << 4
            found.append(((angle - (offset << 13)) >> 10, word & 0xFFFC))
            angle += increment
    return np.array(found)


@given(st.binary(min_size=80, max_size=80), st.integers(0, 23039), st.integers(500, 1500))
def test_rplidar_capsules_match_slamtecs_decoder(cabins, start_q6, span_q6):
    first = b"\xa0\x50" + struct.pack("<H", start_q6) + cabins
    second = b"\xa0\x50" + struct.pack("<H", (start_q6 + span_q6) % 23040) + cabins
    expected = _sdk_capsule(first, second)
    measured = rp.parse_capsule(first)
    angle = measured.start_deg + span_q6 / 64 / 32 * np.arange(32) - measured.offset_deg
    assert np.abs((angle * 64 - expected[:, 0] + 11520) % 23040 - 11520).max() <= 1.0
    assert np.nan_to_num(measured.range_m) * 4000 == pytest.approx(expected[:, 1], abs=1e-6)


def _int32(value):
    value &= 0xFFFFFFFF
    return value - (1 << 32) if value >> 31 else value


def _sdk_scale(code):
    for base, level, target in ((3328, 4, 14), (1792, 3, 12), (1280, 2, 11), (512, 1, 9)):
        if code >= base:
            return (1 << target) + (code - base << level), level
    return code, 0


def _sdk_ultra(previous, current):
    """Decode as _ultraCapsuleToNormal, in integers: (angle q6 relative to an even one, distance q2), 96
    samples.
    """
    found = []
    words = [*struct.unpack("<32I", previous[4:]), struct.unpack_from("<I", current, 4)[0]]
    for word, after in itertools.pairwise(words):
        (major, level1), (major2, level2) = _sdk_scale(word & 0xFFF), _sdk_scale(after & 0xFFF)
        predict1, predict2 = _int32(word << 10) >> 22, _int32(word) >> 22
        base1 = major
        if not major and major2:
            base1, level1 = major2, level2
        second = 0 if predict1 in (-512, 511) else (predict1 << level1) + base1
        third = 0 if predict2 in (-512, 511) else (predict2 << level2) + major2
        for mm in (major, second, third):
            q2 = mm << 2
            offset = int(7.5 * 3.1415926535 * (1 << 16) / 180.0)
            if q2 >= 200:
                k2 = int(98361 / q2)
                offset = int(8 * 3.1415926535 * (1 << 16) / 180) - (k2 << 6) - (k2 * k2 * k2) // 98304
            found.append((offset * 180 / 3.14159265 / 65536, q2))
    return np.array(found)


@given(st.binary(min_size=128, max_size=128), st.binary(min_size=4, max_size=4))
def test_rplidar_ultra_capsules_match_slamtecs_decoder(cabins, after):
    first, second = b"\xa0\x50\0\0" + cabins, b"\xa0\x50\0\0" + after + bytes(124)
    expected = _sdk_ultra(first, second)
    measured = rp.parse_ultra(first, second)
    positive = expected[:, 1] > 0
    assert np.array_equal(np.isfinite(measured.range_m), positive)
    assert measured.range_m[positive] * 4000 == pytest.approx(expected[positive, 1], abs=1e-6)
    assert measured.offset_deg[positive] == pytest.approx(expected[positive, 0], abs=1e-3)
    alone = rp.parse_ultra(first, None)  # the next packet is lost: only the last samples are missing
    assert np.array_equal(alone.range_m[:93], measured.range_m[:93], equal_nan=True)
    assert np.isnan(alone.range_m[95])


def test_rplidar_node_layout():
    """LR001 4.2, figure 4-4: quality, inverted and plain start flag; check bit and angle q6; distance q2."""
    node = rp.parse_node(struct.pack("<BHH", 15 << 2 | 1, round(90.5 * 64) << 1 | 1, 4 * 1234))
    assert (node.first, node.angle_deg, node.range_m, node.quality) == (True, 90.5, 1.234, 15.0)
    assert not rp.has_node_header(struct.pack("<BHH", 15 << 2 | 3, 1, 0))  # both start flags set
    assert not rp.has_node_header(struct.pack("<BHH", 15 << 2 | 1, 2, 0))  # no check bit


def test_scip_numbers_and_sums_of_the_specification():
    """Hokuyo C-42-03320B: figures 2 to 7 (2, 3 and 4 characters), 8.1 (status lines), 8.12 (reply to PP)."""
    assert (scip.decode(b"CB"), scip.decode(b"1Dh"), scip.decode(b"m2@0")) == (1234, 5432, 16_000_000)
    assert bytes((scip.checksum(b"00"), scip.checksum(b"99"))) == b"Pb"
    reply = b"PP\n00P\nDMIN:20;4\nDMAX:5600;_\nAMIN:44;7\nAMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
    assert scip.parameters(reply) == {
        "DMIN": "20", "DMAX": "5600", "AMIN": "44", "AMAX": "725", "AFRT": "384", "SCAN": "600",
    }  # fmt: skip
    assert scip.parameters(reply.replace(b"5600", b"5601")).keys() == {"DMIN", "AMIN", "AMAX", "AFRT", "SCAN"}


def test_scip_request_for_scans():
    """C-42-03320B 8.1: M D, start and end step (4), cluster (2), interval (1), number of scans (2)."""
    geometry = scip.ScipGeometry("URG-04LX", 0.02, 5.6, 1024, 44, 725, 384, 0.1)
    assert scip.ScipScanReply(geometry, intensity=False).command == b"MD0044072501000"


@given(st.binary(max_size=2000), st.integers(0, 4))
def test_random_bytes_give_no_packet_and_no_error(data, kind):
    from beamsplat.services.lidar.framing import Framer, StreamCounters
    from beamsplat.services.lidar.rplidar_stream import RplidarStream

    if kind == 4:
        stream = Framer(ldrobot.PACKET_BYTES, ldrobot.has_header, ldrobot.checksum_ok, StreamCounters())
    else:
        stream = RplidarStream((rp.CAPSULED, rp.DENSE, rp.HQ, rp.ULTRA)[kind], 1e-4, StreamCounters())
    assert not [part for part in stream.feed(data) if part is not None]
    assert scip.parameters(data) is not None


@given(st.binary(max_size=200), st.integers(1, 100), st.integers(3, 12))
def test_packets_are_found_after_any_bytes_and_in_any_chunks(garbage, piece, count):
    from beamsplat.services.lidar.framing import Framer, StreamCounters

    counters = StreamCounters()
    framer = Framer(
        ldrobot.PACKET_BYTES, ldrobot.has_header, ldrobot.checksum_ok, counters, check_next_header=True
    )
    data = garbage + LD06_EXAMPLE * count + LD06_EXAMPLE[:2]
    found = []
    for i in range(0, len(data), piece):
        found += framer.feed(data[i : i + piece])
    assert [p for p in found if p is not None] == [LD06_EXAMPLE] * count
    assert counters.skipped_bytes + 47 * counters.bad_packets + 47 * counters.packets <= len(data)
    assert counters.packets == count
