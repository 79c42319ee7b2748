"""What several commands require of their options."""

from __future__ import annotations

from pathlib import Path

from beamsplat.common.files.persist import check_can_write


def writable(path: Path | None) -> Path | None:
    """Check, before a command starts its work, that the path of its `--out` can be written; a typer callback.

    Raises:
        UserError: no permission, or a parent of the path is a file.
    """
    if path is not None:
        check_can_write(path, "--out")
    return path
