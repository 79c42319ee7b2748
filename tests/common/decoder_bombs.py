"""Bombs: small inputs that state or cause a huge result, one for each decoder of bytes from outside.

`python -m tests.common.decoder_bombs FOLDER` decodes each in a forked process and prints one JSON object per line:
name, growth of the peak memory in MB, and the exception, or "" if the decoder returned.
"""

from __future__ import annotations

import bz2
import io
import json
import os
import resource
import sqlite3
import struct
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.frame
import msgpack
import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from beamsplat.common.mapfiles.session import unpacked_arrays
from beamsplat.common.messages import FusedDepth, Image, Keyframe, Tick
from beamsplat.common.messages.codec import decode
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma
from beamsplat.common.messages.image_codec import decode_rgb
from beamsplat.common.messages.splat_codec import unpack
from beamsplat.common.recording import layout
from beamsplat.common.recording.mcap_file import McapFile
from beamsplat.services.depth.recorded import read_depth
from beamsplat.services.mapping.messages import decode_keyframe
from beamsplat.services.replay.bags import Bag
from beamsplat.services.replay.folder_scans import xy_from_pcd
from tests.common.samples import sample_messages

SIDE_PX = 6000  # 36 million pixels
_LIMIT_BYTES = 12 * 2**30  # of address space: a bomb must not take this machine down
_ZEROS = 400 * 1024 * 1024  # larger than any block that may be decompressed


def png(side_px: int, bits: int = 8) -> np.ndarray:
    """Return a black grey PNG of side_px x side_px pixels, uint8 [B], without ever holding its pixels."""
    packer = zlib.compressobj(9)
    row = bytes(1 + side_px * bits // 8)
    body = b"".join(packer.compress(row) for _ in range(side_px)) + packer.flush()
    head = struct.pack(">IIBBBBB", side_px, side_px, bits, 0, 0, 0, 0)
    chunks = b"".join(
        _png_chunk(kind, data) for kind, data in ((b"IHDR", head), (b"IDAT", body), (b"IEND", b""))
    )
    return np.frombuffer(b"\x89PNG\r\n\x1a\n" + chunks, np.uint8)


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def small_jpeg(*, progressive: bool = False) -> bytes:
    image = np.random.default_rng(3).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)))[1].tobytes()


def jpeg_of_stated_size(side_px: int) -> np.ndarray:
    """Return a JPEG whose header states side_px x side_px pixels, with the data of a small one."""
    data = bytearray(small_jpeg(progressive=True))
    at = data.index(b"\xff\xc2")
    data[at + 5 : at + 9] = struct.pack(">HH", side_px, side_px)
    return np.frombuffer(bytes(data), np.uint8)


def jpeg_of_scans(scans: int) -> np.ndarray:
    """Return a progressive JPEG whose last scan is repeated."""
    data = small_jpeg(progressive=True)
    last = data.rindex(b"\xff\xda")
    return np.frombuffer(data[:last] + data[last:-2] * scans + data[-2:], np.uint8)


def keyframe_with(**fields: object) -> Keyframe:
    """Return the sample keyframe of 640 x 480 px with valid image, depth and sigma, and other `fields`."""
    keyframe = next(m for m in sample_messages() if isinstance(m, Keyframe))
    grey = np.zeros((480, 640), np.uint8)
    valid = {
        "picture": cv2.imencode(".jpg", grey)[1].ravel(),
        "depth": pack_depth(grey.astype(np.float32)), "sigma": pack_sigma(grey.astype(np.float32)),
        "mask": np.zeros(0, np.uint8),
    }  # fmt: skip
    return keyframe.model_copy(update=valid | fields)


def nested_lists(depth: int, stated: int) -> bytes:
    """Return msgpack bytes of lists in lists, each of which states `stated` entries."""
    return (b"\xdd" + struct.pack(">I", stated)) * depth + b"\xc0" * stated


def head(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def mcap(path: Path, compression: str, payload: bytes, stated: int | None = None) -> Path:
    """Write an MCAP file with one chunk that holds `payload`; `stated`: another uncompressed size."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, use_chunking=True)
        writer.start("", "")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        writer.add_message(channel, 5, b"\0\1\0\0\0\0\0\0", 5)
        writer.finish()
    data = path.read_bytes()
    at = data.index(struct.pack("<B", 6), 8 + 9)  # the chunk; the header record is before it
    (length,) = struct.unpack_from("<Q", data, at + 1)
    body = data[at + 9 : at + 9 + length]
    records = struct.pack("<QQQI", 5, 5, stated if stated is not None else _ZEROS, 0)
    chunk = body[:0] + records + struct.pack("<I", len(compression)) + compression.encode()
    chunk += struct.pack("<Q", len(payload)) + payload
    path.write_bytes(data[:at] + struct.pack("<BQ", 6, len(chunk)) + chunk)  # truncated: without an index
    return path


def read_mcap(path: Path) -> str:
    with McapFile(path) as file:
        for _ in file.messages():
            pass
        if not file.damaged:
            return ""
    raise ValueError("damaged chunk")


def rosbag1(path: Path, compression: str, data: bytes) -> Path:
    """Write a ROS 1 bag with one message in one chunk, and replace the data of the chunk."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.typesys import Stores, get_typestore

    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection(
            "/a", "std_msgs/msg/UInt8", typestore=get_typestore(Stores.ROS1_NOETIC)
        )
        writer.write(connection, 5, b"\1")
    raw = bytearray(path.read_bytes())
    # Records are: length of the header, header, length of the data, data. The bag's header is the first record.
    at = len(b"#ROSBAG V2.0\n")
    index_pos_at = raw.index(b"index_pos=") + len(b"index_pos=")
    for _ in range(2):
        at += 4 + struct.unpack_from("<I", raw, at)[0]
        size_at, at = at, at + 4 + struct.unpack_from("<I", raw, at)[0]
    (index_pos,) = struct.unpack_from("<Q", raw, index_pos_at)
    struct.pack_into("<Q", raw, index_pos_at, index_pos + len(data) - (at - size_at - 4))
    raw[size_at:at] = struct.pack("<I", len(data)) + data
    path.write_bytes(raw)
    return path


def read_bag(path: Path) -> str:
    with Bag(path, allow_truncated=True) as bag:
        for _ in bag.messages():
            pass
        if bag.problems:
            raise ValueError(bag.problems[0])
    return ""


def rosbag2(path: Path, payload: bytes) -> Path:
    """Write a ROS 2 bag (sqlite) of messages that are compressed one by one; the last is `payload`."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    writer = Writer2(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(
            "/a", "std_msgs/msg/UInt8", typestore=get_typestore(Stores.ROS2_JAZZY)
        )
        writer.write(connection, 5, b"\0\1\0\0\1")
    database = sqlite3.connect(next(path.glob("*.db3")))
    database.execute("UPDATE messages SET data = ?", (payload,))
    database.commit()
    database.close()
    return path


def zip_bomb(kind: str = "<f4") -> bytes:
    """Return an npz file whose deflated array expands to 400 MB."""
    count = _ZEROS // 4
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": kind, "fortran_order": False, "shape": (count,)})
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file, file.open("a.npy", "w") as member:
        member.write(header.getvalue())
        for _ in range(_ZEROS >> 20):
            member.write(bytes(1 << 20))
    return out.getvalue()


def _zeros(compressor: object, finish: Callable[[], bytes], size: int = _ZEROS) -> bytes:
    piece = bytes(1 << 20)
    return b"".join(compressor.compress(piece) for _ in range(size >> 20)) + finish()


def zstd_zeros(size: int = _ZEROS) -> bytes:
    compressor = zstandard.ZstdCompressor().compressobj()
    return _zeros(compressor, compressor.flush, size)


def packed_zeros(width_px: int, height_px: int) -> np.ndarray:
    """Return packed depth of a stated size, whose data expand to 400 MB."""
    return np.frombuffer(struct.pack("<4sBxHH", b"BSZ1", 2, height_px, width_px) + zstd_zeros(), np.uint8)


def lz4_zeros() -> bytes:
    compressor = lz4.frame.LZ4FrameCompressor()
    return compressor.begin() + _zeros(compressor, compressor.flush)


def bz2_zeros() -> bytes:
    compressor = bz2.BZ2Compressor()
    return _zeros(compressor, compressor.flush)


def written(path: Path, data: bytes | np.ndarray) -> Path:
    path.write_bytes(bytes(data))
    return path


def huge_npy() -> bytes:
    """Return an .npy file that states 10^12 values and has none."""
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        out, {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)}
    )
    return out.getvalue()


def splats(stated: int) -> np.ndarray:
    return np.frombuffer(
        struct.pack("<4sI6f", b"SPL1", stated, *[0.0] * 6) + zlib.compress(bytes(_ZEROS), 9), np.uint8
    )


# Name -> (make the bomb in a folder, decode it). Bombs are made before the peak memory is measured.
BOMBS: dict[str, tuple[Callable[[Path], object], Callable[[object], object]]] = {
    "png": (lambda f: png(SIDE_PX), lambda b: decode_rgb(b, "png", 640, 480)),
    "png of the stated size": (
        lambda f: png(SIDE_PX), lambda b: decode_rgb(b, "png", SIDE_PX, SIDE_PX)),
    "jpeg": (lambda f: jpeg_of_stated_size(SIDE_PX), lambda b: decode_rgb(b, "jpeg", 640, 480)),
    "jpeg of many scans": (lambda f: jpeg_of_scans(20_000), lambda b: decode_rgb(b, "jpeg", 64, 48)),
    "image message": (lambda f: png(SIDE_PX), lambda b: Image(
        stamp_ns=1, width_px=SIDE_PX, height_px=SIDE_PX, encoding="png", data=b)),
    "keyframe picture": (
        lambda f: keyframe_with(picture=png(SIDE_PX), encoding="png"), lambda b: keyframe_pixels(b)),
    "keyframe depth png": (lambda f: keyframe_with(depth=png(SIDE_PX, 16)), lambda b: keyframe_pixels(b)),
    "keyframe sigma png": (lambda f: keyframe_with(sigma=png(SIDE_PX)), lambda b: keyframe_pixels(b)),
    "keyframe mask png": (lambda f: keyframe_with(mask=png(SIDE_PX)), lambda b: keyframe_pixels(b)),
    "keyframe depth": (lambda f: keyframe_with(depth=packed_zeros(640, 480)), lambda b: keyframe_pixels(b)),
    "fused depth": (lambda f: FusedDepth(
        stamp_ns=1, depth=packed_zeros(16384, 16384), sigma=packed_zeros(1, 1)), lambda b: b.depth_m),
    "message head": (lambda f: head(nested_lists(100, 400_000)), lambda b: decode("Tick/1.0", b)),
    "array description": (
        lambda f: head(msgpack.packb(msgpack.ExtType(1, nested_lists(100, 400_000)))),
        lambda b: decode("Tick/1.0", b)),
    "fields record": (lambda f: nested_lists(100, 400_000), lambda b: layout.unpack_fields(b, Tick)),
    "mcap zstd": (lambda f: mcap(f / "a.mcap", "zstd", zstd_zeros()), read_mcap),
    "mcap zstd of unstated size": (lambda f: mcap(f / "a.mcap", "zstd", zstd_zeros(), 2000), read_mcap),
    "mcap lz4": (lambda f: mcap(f / "a.mcap", "lz4", lz4_zeros(), 2000), read_mcap),
    "rosbag1 bz2": (lambda f: rosbag1(f / "a.bag", "bz2", bz2_zeros()), read_bag),
    "rosbag1 lz4": (lambda f: rosbag1(f / "a.bag", "lz4", lz4_zeros()), read_bag),
    "rosbag2 message": (lambda f: rosbag2(f / "a", zstd_zeros()), read_bag),
    "session state": (lambda f: zip_bomb(), unpacked_arrays),
    "recorded depth png": (lambda f: written(f / "1.png", png(SIDE_PX, 16)), read_depth),
    "recorded depth npy": (lambda f: written(f / "1.npy", huge_npy()), read_depth),
    "packed gaussians": (lambda f: splats(100), unpack),
    "pcd": (
        lambda f: b"FIELDS x y\nTYPE F F\nSIZE 4 4\nCOUNT 1 1\nPOINTS 99999999999\nDATA binary\n",
        lambda b: xy_from_pcd(b, "a.pcd")),
}  # fmt: skip


def keyframe_pixels(keyframe: Keyframe) -> object:
    from beamsplat.common.geometry.camera import Undistorter

    return decode_keyframe(keyframe, Undistorter)


def _measure(name: str, folder: Path) -> dict[str, object]:
    """Decode a bomb in this process; return the growth of the peak memory, MB, and the exception."""
    make, read = BOMBS[name]
    bomb = make(folder)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak, which making the bomb has raised
    before_kb = _peak_kb()
    fault = ""
    try:
        read(bomb)
    except Exception as error:
        fault = f"{type(error).__mro__[0].__name__}|{isinstance(error, ValueError)}|{str(error)[:200]}"
    return {"name": name, "grown_mb": (_peak_kb() - before_kb) / 1024, "fault": fault}


def _peak_kb() -> int:
    line = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")
    )
    return int(line.split()[1])


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (_LIMIT_BYTES, _LIMIT_BYTES))
    cv2.setNumThreads(1)
    for bomb_name in sys.argv[2:] or BOMBS:
        with tempfile.TemporaryDirectory(dir=sys.argv[1]) as work:
            child = os.fork()
            if not child:
                sys.stdout.write(json.dumps(_measure(bomb_name, Path(work))) + "\n")
                sys.stdout.flush()
                os._exit(0)
            os.waitpid(child, 0)
