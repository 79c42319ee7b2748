"""Bytes from outside never cost more memory than their stated or allowed size, whatever they contain."""

import json
import subprocess
import sys

import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.recording import mcap_file
from tests.common.decoder_bombs import BOMBS, rosbag2, zstd_zeros

# Blocks of bags may expand to 128 MiB, and a decompressor doubles its buffer. Everything else is refused early.
_BLOCKS_MB, _ELSE_MB = 300, 48


@pytest.fixture(scope="module")
def decoded(tmp_path_factory):
    out = subprocess.run(
        [sys.executable, "-m", "tests.common.decoder_bombs", str(tmp_path_factory.mktemp("bombs"))],
        capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    return {row["name"]: row for row in map(json.loads, out.stdout.splitlines())}


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_within_bounded_memory(decoded, name):
    limit_mb = _BLOCKS_MB if name.startswith(("mcap", "rosbag")) else _ELSE_MB
    row = decoded[name]
    assert row["grown_mb"] < limit_mb, row
    assert "|True|" in row["fault"], f"not refused by a ValueError: {row}"


def test_messages_far_out_of_order_are_not_all_held_back(tmp_path, monkeypatch):
    from mcap.writer import CompressionType, Writer

    monkeypatch.setattr(mcap_file, "_MAX_HELD_BYTES", 10_000_000)
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=1)
        writer.start("", "")
        channel = writer.register_channel("/a", "cdr", writer.register_schema("a/msg/A", "ros2msg", b""))
        for _ in range(20):  # each chunk begins before all chunks that were read before it
            writer.add_message(channel, 10**9, bytes(1_000_000), 5)
        writer.finish()
    with mcap_file.McapFile(tmp_path / "a.mcap") as file, pytest.raises(UserError, match="out of order"):
        list(file.messages())


def test_a_compressed_bag_is_not_decompressed_beyond_the_free_disk(tmp_path, monkeypatch):
    from beamsplat.services.replay import bags

    path = rosbag2(tmp_path / "bag", b"")
    database = next(path.glob("*.db3"))
    database.rename(database.with_suffix(".db3.zstd"))
    database.with_suffix(".db3.zstd").write_bytes(zstd_zeros())
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("compression_mode: message", "compression_mode: file"))
    free = bags.shutil.disk_usage(tmp_path).free
    monkeypatch.setattr(bags, "_KEEP_FREE_BYTES", free - 50_000_000)
    with pytest.raises(UserError, match=r"db3\.zstd: cannot be decompressed .* expands to more than"):
        bags.Bag(path)
