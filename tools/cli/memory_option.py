"""The options `--memory 1GB` and `--gpu-memory 2GB`: the mapper's memory budgets."""

from __future__ import annotations

import re
from typing import Annotated

import typer

from beamsplat.common.errors import UserError

_MB = {"MB": 1.0, "GB": 1e3, "MIB": 2**20 / 1e6, "GIB": 2**30 / 1e6}

MemoryOption = Annotated[
    str | None,
    typer.Option("--memory", metavar="1GB", help="Memory of the mapper; the rest of its map is kept on disk"),
]

GpuMemoryOption = Annotated[
    str | None,
    typer.Option(
        "--gpu-memory", metavar="2GB",
        help="GPU memory of the mapper; the rest of its map is kept in memory and on disk",
    ),
]  # fmt: skip


def memory_overrides(memory: str | None, gpu_memory: str | None = None) -> tuple[str, ...]:
    """Return the overrides NODE.OPTION=VALUE that set the memory budgets, such as "1GB"; () for None.

    Raises:
        UserError: a text is not a size.
    """
    given = (("--memory", "memory_mb", memory), ("--gpu-memory", "gpu_memory_mb", gpu_memory))
    return tuple(
        f"mapping.{name}={_megabytes(flag, text):g}" for flag, name, text in given if text is not None
    )


def _megabytes(flag: str, text: str) -> float:
    match = re.fullmatch(r"([0-9]*\.?[0-9]+) *([A-Za-z]+)", text.strip())
    if match is None or match[2].upper() not in _MB:
        raise UserError(f"{flag} {text!r}: expected a number and MB or GB, for example 1GB or 600MB")
    return float(match[1]) * _MB[match[2].upper()]
