"""Search for model files: folder BEAMSPLAT_MODELS if set, else the user's data folder."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from beamsplat.common.errors import UserError


def models_dirs() -> list[Path]:
    """Return the folders in which models are searched, in this order; `pull` installs into the first one."""
    given = os.environ.get("BEAMSPLAT_MODELS")
    if given:
        return [Path(part).expanduser() for part in given.split(os.pathsep) if part]
    base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return [Path(base).expanduser() / "beamsplat" / "models"]


def find_model(name: str | Path) -> Path:
    """Return the path of a model file.

    `name`: an existing path, or `name`, `name.onnx` or `name/model.onnx` in one of the models folders.

    Raises:
        UserError: not found; the message contains the folders and how to obtain the file.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return path
    for folder in models_dirs():
        for candidate in (
            folder / path.name, folder / f"{path.name}.onnx", folder / path.name / "model.onnx",
        ):  # fmt: skip
            if candidate.is_file():
                return candidate
    sought = ", ".join(str(folder) for folder in models_dirs())
    raise UserError(
        f"model {str(name)!r} is not in {sought}; `beamsplat models pull {path.stem}` downloads it, "
        "or set BEAMSPLAT_MODELS to the folder that holds it"
    )


def sha256_of(path: Path) -> str:
    """Return the SHA-256 digest of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
