"""Where model files are: BEAMSPLAT_MODELS, else the user's data folder; deploy/models.toml names them."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from beamsplat.common.errors import UserError


def models_dirs() -> list[Path]:
    """Folders that are searched for models, first one first; the first is where `pull` puts them."""
    given = os.environ.get("BEAMSPLAT_MODELS")
    if given:
        return [Path(part).expanduser() for part in given.split(os.pathsep) if part]
    base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return [Path(base).expanduser() / "beamsplat" / "models"]


def find_model(name: str | Path) -> Path:
    """The file of a model: a path that exists, or `name` or `name.onnx` in the models folders.

    Raises:
        UserError: nowhere; says where it was sought and how to get it.
    """
    path = Path(name).expanduser()
    if path.is_file():
        return path
    for folder in models_dirs():
        for candidate in (folder / path.name, folder / f"{path.name}.onnx"):
            if candidate.is_file():
                return candidate
    sought = ", ".join(str(folder) for folder in models_dirs())
    raise UserError(
        f"model {str(name)!r} is not in {sought}; `beamsplat models pull {path.stem}` fetches it, "
        "or set BEAMSPLAT_MODELS to the folder that holds it"
    )


def sha256_of(path: Path) -> str:
    """Hex digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
