"""Options of the recorder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig


class RecorderConfig(NodeConfig):
    """Options of the recorder: folder, topics, compression and clock."""

    # Folder to create; if it exists, NAME_2, NAME_3, ..., so that a restart overwrites nothing.
    out: Path = Path("recording")
    topics: tuple[str, ...] = ()  # record only these; empty = all
    without: tuple[str, ...] = ()  # topics to leave out
    health: bool = True
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    chunk_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 1.0  # longest time that a crash can lose
    sync: bool = True  # fsync each chunk, so that a power cut loses no more than a crash
    # Arrival time: by this host's clock ("wall") or by the newest stamp ("data", for replayed data). "auto"
    # decides by the first stamp.
    clock: Literal["auto", "wall", "data"] = "auto"
