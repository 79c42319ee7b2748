"""The weights file of the learned aggregation, before it is read."""

from __future__ import annotations

from pathlib import Path

from beamsplat.common.errors import UserError

TRAINED_BY = "`beamsplat train aggregator --out DIR` writes DIR/aggregator.onnx"


def check_weights(path: Path | None, option: str) -> Path:
    """Return the path of a weights file; the file is not read.

    Raises:
        UserError: no path is given, or there is no such file; the message names `option`.
    """
    if path is None:
        raise UserError(f"{option} is required for the learned aggregation: {TRAINED_BY}")
    if not path.expanduser().is_file():
        raise UserError(f"{option} = {path}: there is no such file; {TRAINED_BY}")
    return path.expanduser()
