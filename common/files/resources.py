"""Paths of the files that are installed with the package: deployment files and the list of models."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

_FOLDER = Path(str(files("beamsplat.deploy")))  # pip unpacks wheels, so this is a real folder


def shipped_file(name: str) -> Path:
    """Return the path of a file in `deploy/`, for example `demo.toml`; it need not exist."""
    return _FOLDER / name


def deployment_file(path: Path) -> Path:
    """Return `path` if that file exists, else the shipped deployment of that name, else `path`.

    `deploy/demo.toml`, `demo.toml` and `demo` all name the shipped demo if the working directory does not
    contain this file.
    """
    if path.exists() or path.is_absolute():
        return path
    relative = path.relative_to("deploy") if path.parts[:1] == ("deploy",) else path
    for candidate in (relative, relative.with_suffix(".toml")):
        if ".." not in candidate.parts and (_FOLDER / candidate).is_file():
            return _FOLDER / candidate
    return path
