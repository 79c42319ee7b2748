"""Encoding and decoding of messages: exact round trips; invalid bytes raise DecodeError only."""

import random
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import BaseModel

from beamsplat.common.messages import MESSAGES, Correction, Image, Rig, Scan
from beamsplat.common.messages.codec import decode, encode, encode_into, kept_payload, schema_of
from beamsplat.common.messages.header import DecodeError, Header
from tests.common.samples import assert_equal, sample_messages

SAMPLES = sample_messages()
GOLDEN = Path(__file__).parent / "golden"


def test_samples_cover_every_message():
    assert {type(m) for m in SAMPLES} == set(MESSAGES.values())


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: m.schema_name())
def test_round_trip(message):
    payload = encode(message)
    decoded = decode(schema_of(message), payload)
    assert_equal(message, decoded)
    assert encode(decoded) is payload  # kept with the message
    copied = decoded.model_copy()
    assert kept_payload(copied) is None
    assert encode(copied) == payload


def test_a_payload_is_kept_until_the_message_is_changed():
    message = SAMPLES[6].model_copy()
    assert encode(message) == encode(message)
    assert kept_payload(message) is None
    payload = encode(message, keep=True)
    assert encode(message) is payload
    assert "kept_payload" not in message.__dict__
    other = message.model_copy(update={"optimisation": 9})
    assert decode(schema_of(other), encode(other)).optimisation == 9


def test_a_buffer_that_is_used_again_has_the_payload_of_each_message():
    buffer = bytearray(b"of before")
    rng = np.random.default_rng(1)
    for _ in range(3):
        for k in rng.permutation(len(SAMPLES)):
            message = SAMPLES[k].model_copy()  # nothing is kept with it
            assert encode_into(message, buffer) is buffer
            assert buffer == encode(message)
    kept = encode(message, keep=True)
    assert encode_into(message, buffer) is kept


def test_a_payload_of_another_version_is_not_kept():
    """What is encoded again has the version that this program states beside it."""
    for file in sorted(GOLDEN.glob("*.bin")):
        name, _, version = file.stem.partition("-")
        message = decode(f"{name}/{version}", file.read_bytes())
        assert (kept_payload(message) is not None) == (version == message.version)
        again = decode(schema_of(message), encode(message))
        assert_equal(message, again)


@pytest.mark.parametrize("message", SAMPLES, ids=lambda m: m.schema_name())
def test_golden_files_of_released_versions_decode(message):
    files = sorted(GOLDEN.glob(f"{message.schema_name()}-*.bin"))
    assert files, (
        f"no golden file of {message.schema_name()}: run python -m tests.common.messages.write_golden"
    )
    for file in files:
        version = file.stem.split("-")[1]
        decoded = decode(f"{message.schema_name()}/{version}", file.read_bytes())
        expected = message if version == message.version else _without_new_fields(message, decoded)
        assert_equal(expected, decoded)


def _without_new_fields(value, old):
    """Return `value` with the default in each field that has its default in `old`, also within parts."""
    if isinstance(value, tuple) and isinstance(old, tuple) and len(value) == len(old):
        return tuple(_without_new_fields(a, b) for a, b in zip(value, old))
    if not isinstance(value, BaseModel):
        return value
    update = {}
    for name, field in type(value).model_fields.items():
        mine, theirs = getattr(value, name), getattr(old, name)
        is_new = (
            not field.is_required()
            and isinstance(theirs, (int, float, str, tuple, type(None)))
            and theirs == field.default
        )
        update[name] = theirs if is_new else _without_new_fields(mine, theirs)
    return value.model_copy(update=update)


def test_decoded_arrays_are_read_only_views_of_the_payload():
    message = Image(
        stamp_ns=1, width_px=10, height_px=10, encoding="mono8", data=np.arange(100, dtype=np.uint8)
    )
    payload = encode(message)
    data = decode("Image/1.0", payload).data
    assert not data.flags.writeable
    assert np.shares_memory(data, np.frombuffer(payload, np.uint8))
    assert (data.__array_interface__["data"][0] - np.frombuffer(payload, np.uint8).ctypes.data) % 64 == 0


@given(
    ranges=hnp.arrays(np.float32, st.integers(0, 300), elements=st.floats(width=32)),
    stamp=st.integers(0, 2**62 - 1),
    angle=st.floats(-10, 10),
)
@settings(max_examples=100, deadline=None)
def test_any_scan_round_trips(ranges, stamp, angle):
    scan = Scan(
        stamp_ns=stamp, angle_min_rad=angle, angle_increment_rad=0.01, time_increment_s=0.0, scan_time_s=0.1,
        range_min_m=0.1, range_max_m=10.0, ranges_m=ranges,
    )  # fmt: skip
    assert_equal(scan, decode("Scan/1.0", encode(scan)))


def test_unknown_fields_of_a_newer_minor_version_are_ignored():
    payload = encode(SAMPLES[6])
    length = int.from_bytes(payload[:4], "little")
    head = msgpack.unpackb(payload[4 : 4 + length], ext_hook=msgpack.ExtType, strict_map_key=False)
    head["future"] = 7
    longer = msgpack.packb(head)
    start, old_start = -(-(4 + len(longer)) // 64) * 64, -(-(4 + length) // 64) * 64
    newer = len(longer).to_bytes(4, "little") + longer
    newer += bytes(start - len(newer)) + payload[old_start:]
    assert_equal(decode("Correction/1.9", newer), SAMPLES[6])
    with pytest.raises(DecodeError, match="future"):
        decode("Correction/1.0", newer)
    with pytest.raises(DecodeError, match=r"version 2\.0.*supports 1\.0"):
        decode("Correction/2.0", newer)


def test_unknown_fields_in_a_nested_part_are_ignored():
    rig = next(m for m in SAMPLES if isinstance(m, Rig) and m.lidar is not None)
    payload = encode(rig)
    length = int.from_bytes(payload[:4], "little")
    head = msgpack.unpackb(payload[4 : 4 + length], ext_hook=msgpack.ExtType, strict_map_key=False)
    head["lidar"]["future"] = 7
    longer = msgpack.packb(head)
    start, old_start = -(-(4 + len(longer)) // 64) * 64, -(-(4 + length) // 64) * 64
    newer = len(longer).to_bytes(4, "little") + longer
    newer += bytes(start - len(newer)) + payload[old_start:]
    assert_equal(decode("Rig/1.9", newer), rig)
    with pytest.raises(DecodeError, match=r"lidar\.future"):
        decode("Rig/1.0", newer)


def _mutations(payload: bytes, rng: random.Random) -> bytes:
    data = bytearray(payload)
    kind = rng.randrange(5)
    if kind == 0:
        return bytes(data[: rng.randrange(len(data) + 1)])
    if kind == 1:
        return rng.randbytes(rng.randrange(200))
    if kind == 2:
        at = rng.randrange(len(data))
        return bytes(data[:at]) + rng.randbytes(rng.randrange(1, 9)) + bytes(data[at:])
    for _ in range(rng.randrange(1, 8)):  # change bytes, mostly in the head
        at = rng.randrange(min(len(data), 300))
        data[at] = rng.randrange(256)
    return bytes(data)


def test_100_000_mutated_payloads_raise_decode_errors_only():
    rng = random.Random(1)
    payloads = [(schema_of(m), encode(m)) for m in SAMPLES]
    refused = 0
    per_type = 100_000 // len(payloads) + 1
    for schema, payload in payloads:
        for _ in range(per_type):
            broken = _mutations(payload, rng)
            try:
                message = decode(schema, broken)
            except DecodeError:
                refused += 1
            else:  # mutations of array contents or padding only leave a valid message
                assert type(message) is MESSAGES[schema.partition("/")[0]]
    assert refused > 0.5 * per_type * len(payloads)


@given(st.text(max_size=30), st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_random_schemas_and_bytes_raise_decode_errors_only(schema, payload):
    with pytest.raises(DecodeError):
        decode(schema, payload)


@given(st.binary(max_size=120))
@settings(max_examples=300, deadline=None)
def test_random_headers_raise_decode_errors_only(data):
    with pytest.raises(DecodeError):
        Header.unpack(data)


@given(
    st.builds(
        Header,
        stamp_ns=st.integers(0, 2**63 - 1), publish_ns=st.integers(0, 2**63 - 1),
        clock_id=st.integers(0, 2**64 - 1), sequence=st.integers(0, 2**64 - 1), epoch=st.integers(0, 2**32 - 1),
        producer=st.text(max_size=40), instance=st.binary(min_size=8, max_size=8).map(bytes.hex),
        backlog=st.integers(0, 2**32 - 1),
    )
)  # fmt: skip
@settings(deadline=None)
def test_header_round_trip(header):
    assert Header.unpack(header.pack()) == header


def test_a_header_without_a_backlog_is_readable_by_earlier_programs():
    calm, busy = (Header(5, 6, 7, 8, 9, "keyframes", "ab" * 8, backlog) for backlog in (0, 3))
    assert calm.pack()[2] == 1
    assert (busy.pack()[2], len(busy.pack())) == (2, len(calm.pack()) + 4)
    with pytest.raises(DecodeError, match="version 1 or 2"):
        Header.unpack(calm.pack()[:2] + b"\3" + calm.pack()[3:])


def test_age_is_known_only_on_the_same_clock():
    header = Header(0, 1000, 42, 0, 0, "a", "00" * 8)
    assert header.age_ns(1500, 42) == 500
    assert header.age_ns(1500, 43) is None


@pytest.mark.parametrize(
    ("change", "message_text"),
    [
        ({"T_map_odom": np.eye(3)}, "shape"),
        ({"T_map_odom": np.eye(4, dtype=np.float32)}, "dtype float64"),
        ({"T_map_odom": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid"),
        ({"T_map_odom": np.full((4, 4), np.nan)}, "NaN"),
        ({"stamp_ns": -1}, "greater than or equal"),
        ({"optimisation": 0.5}, "integer"),
    ],
)
def test_invalid_values_raise_with_the_field(change, message_text):
    fields = {"stamp_ns": 0, "T_map_odom": np.eye(4), "optimisation": 0, **change}
    with pytest.raises(ValueError, match=message_text):
        Correction(**fields)
