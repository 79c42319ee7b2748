"""Which files belong to a bag: splits, compressed splits, and what recorders and tools leave beside them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.persist import read_limited

_MAX_METADATA_BYTES = 4_000_000  # of metadata.yaml; with hundreds of topics it has less than 1 MB
# NAME.KIND, with what recorders and tools add: NAME.orig.bag and NAME.bag.orig.active by `rosbag reindex`,
# .active by a recorder that is running or crashed, .zstd by `ros2 bag record` with file compression.
_NAME = re.compile(
    r"(?P<name>.+?)(?P<orig>\.orig)?\.(?P<kind>bag|mcap|db3)(?P<orig2>\.orig)?(?P<active>\.active)?"
    r"(?P<zstd>\.zstd?)?"
)
_KINDS = ("mcap", "db3", "bag")


class _Part(NamedTuple):
    """A file of a bag: its name without additions, and which additions it has."""

    file: Path
    name: str
    kind: str
    original: bool
    active: bool
    compressed: bool


class BagFiles(NamedTuple):
    """The files to read, and sentences about what was left out or is missing."""

    files: list[Path]
    notes: list[str]


def looks_like_bag(path: Path) -> bool:
    """Return whether `path` is a bag, judged by its name or by the names of the files in it."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or any(_part(file) for file in path.iterdir())
    return _part(path) is not None


def is_compressed(file: Path) -> bool:
    """Return whether a file of a bag has to be decompressed first."""
    return file.suffix in (".zstd", ".zst")


def find_bag_files(path: Path) -> BagFiles:
    """Return the files of the bag at `path`, which is a file or a folder.

    Raises:
        UserError: there is no such file or folder, or no bag in it.
    """
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; check the path")
    if path.is_file():
        if _part(path) is None:
            raise UserError(
                f"{path}: not a bag; expected .bag, .mcap, .db3 (also with .active or .zstd), or a folder "
                "with one of them"
            )
        return BagFiles([path], [])
    parts = [part for file in sorted(path.iterdir()) if (part := _part(file)) and file.is_file()]
    if not parts:
        raise UserError(f"{path}: not a bag: no .mcap, .db3 or .bag file in this folder")
    notes: list[str] = []
    listed = _listed(path / "metadata.yaml")
    kinds = {part.kind for part in parts}
    kind = next((k for k in _KINDS if any(name.endswith(f".{k}") for name in listed) and k in kinds), None)
    kind = kind or next(k for k in _KINDS if k in kinds)
    if len(kinds) > 1:
        others = ", ".join(part.file.name for part in parts if part.kind != kind)
        notes.append(f"{path}: {others}: not read, beside files of type .{kind}; give one to read it instead")
    chosen: dict[str, _Part] = {}
    for part in sorted(parts, key=lambda p: (p.original, p.active, p.compressed)):
        if part.kind != kind:
            continue
        first = chosen.setdefault(part.name, part)
        if first is not part:
            why = (
                "left over from a repair" if part.original else "not closed"
                if part.active else "the same file, compressed"
            )  # fmt: skip
            notes.append(f"{path}: {part.file.name} is not read, beside {first.file.name}: {why}")
    for name in listed:
        if name.removesuffix(".zstd").removesuffix(f".{kind}") not in chosen:
            notes.append(
                f"{path}: metadata.yaml lists {name}, which is not there: this part of the drive is missing; "
                "copy it again from where it was recorded"
            )
    return BagFiles(sorted(part.file for part in chosen.values()), notes)


def _part(file: Path) -> _Part | None:
    match = _NAME.fullmatch(file.name)
    if match is None or file.name.startswith("."):
        return None
    return _Part(
        file, match["name"], match["kind"], bool(match["orig"] or match["orig2"]), bool(match["active"]),
        bool(match["zstd"]),
    )  # fmt: skip


def _listed(metadata: Path) -> list[str]:
    """Return the names of the files that a metadata.yaml lists, [] without such a file.

    Raises:
        UserError: the file cannot be read, or is too long: the reader of bags would need minutes for it.
    """
    if not metadata.is_file():
        return []
    try:
        text = read_limited(metadata, _MAX_METADATA_BYTES).decode(errors="replace")
    except (OSError, ValueError) as error:
        raise UserError(
            f"{metadata}: cannot be read ({reason(error)}); copy it again from where it was recorded"
        ) from error
    block = re.search(r"relative_file_paths:\s*\n((?:\s*-\s*.+\n?)+)", text)
    names = re.findall(r"-\s*['\"]?([^'\"\n]+?)['\"]?\s*\n", block[1] + "\n") if block else []
    return [Path(name).name for name in names if _NAME.fullmatch(Path(name).name)]
