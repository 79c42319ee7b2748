"""Decompression with a limit on the size of the result: compressed kilobytes can expand to gigabytes."""

from __future__ import annotations

import bz2
from typing import IO

import lz4.frame
import zstandard

# Largest chunk or message of a recording after decompression. Writers make chunks of about 1 MB.
MAX_BLOCK_BYTES = 128 * 1024 * 1024
_PIECE_BYTES = 1024 * 1024


def decompress(data: bytes | memoryview, compression: str, limit: int = MAX_BLOCK_BYTES) -> bytes:
    """Return the decompressed bytes of `data`; `compression` is "zstd", "lz4" or "bz2".

    Raises:
        ValueError: another compression, damaged data, or a result of more than `limit` bytes.
    """
    try:
        if compression == "zstd":
            out = _zstd(data, limit)
        elif compression == "lz4":
            out = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit + 1)
        elif compression == "bz2":
            out = bz2.BZ2Decompressor().decompress(data, max_length=limit + 1)
        else:
            raise ValueError(f"compression {compression[:80]!r} is not supported")
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError) as error:
        raise ValueError(f"{compression} data do not decompress: {error}") from error
    if len(out) > limit:
        raise ValueError(f"{compression} data expand to more than {limit} bytes")
    return out


def _zstd(data: bytes | memoryview, limit: int) -> bytes:
    size = zstandard.frame_content_size(data)  # -1: not stated
    if size > limit:
        raise ValueError(f"zstd data expand to {size} bytes, at most {limit}")
    if size >= 0:
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
    pieces: list[bytes] = []
    total = 0
    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        while piece := reader.read(_PIECE_BYTES):
            pieces.append(piece)
            total += len(piece)
            if total > limit:
                raise ValueError(f"zstd data expand to more than {limit} bytes")
    return b"".join(pieces)


def decompress_file(source: IO[bytes], target: IO[bytes], limit: int) -> None:
    """Decompress a zstd file.

    Raises:
        ValueError: damaged data, or a result of more than `limit` bytes.
        OSError: `target` cannot be written.
    """
    total = 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True) as reader:
            while piece := reader.read(_PIECE_BYTES):
                total += len(piece)
                if total > limit:
                    raise ValueError(f"it expands to more than {limit} bytes")
                target.write(piece)
    except zstandard.ZstdError as error:
        raise ValueError(f"zstd data do not decompress: {error}") from error
