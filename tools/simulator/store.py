"""The cache on disk: everything is found again by a hash of all that made it, this code included."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

# A change in any other module of this folder may change what is drawn ...
NOT_DRAWING = frozenset(
    {
        "cli.py",
        "writer.py",
        "wheels.py",
        "recording.py",
        "drive_log.py",
        "lidar.py",
        "truth.py",
        "store.py",
        "__init__.py",
    }
)
# ... and in any but these, too, the world that it is drawn from.
NOT_BUILDING = NOT_DRAWING | {"shots.py", "movers.py", "render.py", "shade.py", "camera.py", "settings.py"}


def cache_root() -> Path:
    """$BEAMSPLAT_CACHE, or ~/.cache/beamsplat."""
    chosen = os.environ.get("BEAMSPLAT_CACHE")
    return Path(chosen) if chosen else Path.home() / ".cache" / "beamsplat"


@cache
def code_version(leave_out: frozenset[str]) -> str:
    """Hash of this folder's sources but those."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        if path.name not in leave_out:
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def key(kind: str, *parts: Any) -> str:
    """A name for the `world` or `shot` that these settings, numbers and strings make."""

    def plain(value: Any) -> Any:
        return {type(value).__name__: asdict(value)} if is_dataclass(value) else value

    text = json.dumps([kind, *(plain(p) for p in parts)], sort_keys=True, default=repr)
    code = code_version(NOT_BUILDING if kind == "world" else NOT_DRAWING)
    return hashlib.sha256((code + text).encode()).hexdigest()[:24]


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary neighbour that becomes `path` when all went well: no half file ever has the name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, *, replace: bool) -> Iterator[Path]:
    """A temporary neighbour that becomes the folder `path` when all went well."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        yield part
        if path.exists() and replace:
            shutil.rmtree(path)
        os.replace(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)
