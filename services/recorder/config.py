"""Options of the recorder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from beamsplat.common.config.deployment import NodeConfig


class RecorderConfig(NodeConfig):
    """What to write, and where."""

    # Folder to make; if it is there, NAME_2, NAME_3, ... so that a restart loses nothing.
    out: Path = Path("recording")
    topics: tuple[str, ...] = ()  # only these; none named: all
    without: tuple[str, ...] = ()
    health: bool = True
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    chunk_s: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 1.0  # what a crash can cost
    sync: bool = True  # each chunk to the disk itself: what a power cut can cost
    # Time of arrival: by this host's clock ("wall"), or by the newest stamp ("data", for replayed data,
    # whose clock is not ours). "auto" looks whether the first stamp is of now.
    clock: Literal["auto", "wall", "data"] = "auto"
