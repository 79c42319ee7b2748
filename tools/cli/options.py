"""What several commands require of their options."""

from __future__ import annotations

from pathlib import Path

from beamsplat.common.errors import UserError
from beamsplat.common.files.persist import check_can_write


def writable(path: Path | None) -> Path | None:
    """Check, before a command starts its work, that the path of its `--out` can be written; a typer callback.

    Raises:
        UserError: no permission, or a parent of the path is a file.
    """
    if path is not None:
        check_can_write(path, "--out")
    return path


def session_folder(path: Path) -> Path:
    """Return `path`, or the folder `session` in it, as `beamsplat demo` leaves it; a typer callback.

    A deployment file (.toml) and a path that does not exist are returned as they are.

    Raises:
        UserError: `path` is another file.
    """
    from beamsplat.common.mapfiles.session import SessionFolder

    if path.is_file() and path.suffix != ".toml":
        raise UserError(
            f"{path} is a file: give the folder of a session, which `mapping.session = DIR` and "
            "`beamsplat demo` write, or for export and render the deployment file (.toml) of a running system"
        )
    inner = path / "session"
    return inner if not SessionFolder(path).exists() and SessionFolder(inner).exists() else path
