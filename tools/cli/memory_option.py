"""The option `--memory 1GB`: the mapper's memory budget."""

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


def memory_overrides(text: str | None) -> tuple[str, ...]:
    """Return the overrides NODE.OPTION=VALUE that set the memory budget `text`, such as "1GB"; () for None.

    Raises:
        UserError: the text is not a size.
    """
    if text is None:
        return ()
    match = re.fullmatch(r"([0-9]*\.?[0-9]+) *([A-Za-z]+)", text.strip())
    if match is None or match[2].upper() not in _MB:
        raise UserError(f"--memory {text!r}: expected a number and MB or GB, for example 1GB or 600MB")
    return (f"mapping.memory_mb={float(match[1]) * _MB[match[2].upper()]:g}",)
