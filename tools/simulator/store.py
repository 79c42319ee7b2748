"""The cache on disk: the name of an entry is a hash of all its inputs and of the source code."""

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

# Modules that cannot change rendered frames; a change in any other module invalidates cached frames.
NOT_IN_FRAME_HASH = frozenset(
    {
        "writer.py",
        "bag_layout.py",
        "lidar_drivers.py",
        "robots.py",
        "wheels.py",
        "recording.py",
        "drive_log.py",
        "lidar.py",
        "lidar_records.py",
        "truth.py",
        "store.py",
        "__init__.py",
    }
)
# Modules that cannot change a world; a change in any other module invalidates cached worlds.
NOT_IN_WORLD_HASH = NOT_IN_FRAME_HASH | {
    "frames.py",
    "actors.py",
    "render.py",
    "shade.py",
    "camera.py",
    "settings.py",
}


def cache_root() -> Path:
    """Return the cache folder: $BEAMSPLAT_CACHE, or ~/.cache/beamsplat."""
    chosen = os.environ.get("BEAMSPLAT_CACHE")
    return Path(chosen) if chosen else Path.home() / ".cache" / "beamsplat"


@cache
def code_version(leave_out: frozenset[str]) -> str:
    """Return a hash of the source files in this module's folder, without the file names in `leave_out`."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        if path.name not in leave_out:
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def key(kind: str, *parts: Any) -> str:
    """Return the cache key of an entry of kind `world` or `shot` (a rendered frame) with the inputs `parts`.

    `parts` are dataclasses of settings, numbers, strings, and lists of them.
    """

    def plain(value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            return {type(value).__name__: asdict(value)}
        return value

    text = json.dumps([kind, *(plain(p) for p in parts)], sort_keys=True, default=repr)
    code = code_version(NOT_IN_WORLD_HASH if kind == "world" else NOT_IN_FRAME_HASH)
    return hashlib.sha256((code + text).encode()).hexdigest()[:24]


def file_hash(path: Path) -> str:
    """Return the SHA-256 of the contents of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path that is renamed to `path` on success; `path` is never an incomplete file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path, *, replace: bool) -> Iterator[Path]:
    """Yield a temporary folder that is renamed to `path` on success.

    With `replace`, an existing folder `path` is deleted immediately before the renaming.
    """
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
