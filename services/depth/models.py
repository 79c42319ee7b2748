"""The table of depth models, and resumable downloads that are verified before they are installed."""

from __future__ import annotations

import os
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

from pydantic import Field

from beamsplat.common.config.base import Config, parse
from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.resources import shipped_file
from beamsplat.services.depth.model_files import find_model, models_dirs, sha256_of

TABLE = shipped_file("models.toml")
_BLOCK = 1 << 18
_TIMEOUT_S = 30.0


Url = Annotated[str, Field(pattern=r"^(https://.*|file://.*|http://127\.0\.0\.1[:/].*|)$")]
Sha256 = Annotated[str, Field(pattern=r"^([0-9a-f]{64}|)$")]


class ModelEntry(Config):
    """One row of `models.toml`: a model file that can be downloaded, with its licence and digest."""

    source: str  # the depth source that uses it
    licence: str
    commercial: bool  # the licence permits commercial use
    url: Url
    sha256: Sha256  # "" = not verified
    data_url: Url = ""  # a second file with the weights, which the first one names
    data_sha256: Sha256 = ""
    size_mb: float | None = None  # of all files; None = not known
    how: str = ""  # how to obtain the file, where there is no URL
    note: str = ""  # what a user must know before the download


def read_model_table(path: Path = TABLE) -> dict[str, ModelEntry]:
    """Return all rows of the table by name.

    Raises:
        UserError: the file is missing, is not TOML, or has an invalid row.
    """
    try:
        table = tomllib.loads(path.read_text())
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"{path}: cannot be read as the table of models: {reason(error)}") from error
    return {name: parse(ModelEntry, row, f"{path}: [{name}]") for name, row in table.items()}


def model_name(name: str, table: dict[str, ModelEntry]) -> str:
    """Return the name of a model in the table; for the name of a depth source, its first model in the table.

    Raises:
        UserError: no model and no depth source has this name; the message lists all names.
    """
    if name in table:
        return name
    if (default := next((key for key, row in table.items() if row.source == name), None)) is not None:
        return default
    sources = dict.fromkeys(row.source for row in table.values())
    near = get_close_matches(name, (*table, *sources), 1)
    meant = f"did you mean {near[0]!r}? " if near else ""
    raise UserError(
        f"there is no model {name!r}; {meant}there are {', '.join(table)}, and by depth source "
        f"{', '.join(sources)}"
    )


def find_entry(name: str, table: dict[str, ModelEntry]) -> ModelEntry:
    """Return the row of the table for a model or depth source, see `model_name`.

    Raises:
        UserError: no such row; the message lists all names.
    """
    return table[model_name(name, table)]


def pull(
    name: str,
    row: ModelEntry,
    agree: Callable[[str], bool],
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> Path:
    """Download a model into the first models folder and return its path; resume an interrupted download.

    Args:
        name: file name of the model, without suffix.
        row: the model's row of the table.
        agree: called with a question if the licence is non-commercial or the digest unknown; False cancels.
        progress: called with (bytes received, total bytes or None if the server does not report it).

    Raises:
        UserError: no URL, no agreement, no connection, or a wrong digest (the file is then removed).
    """
    parts = files_of(name, row)
    target = parts[0].path
    if all(part.path.is_file() and part.sha256 and sha256_of(part.path) == part.sha256 for part in parts):
        return target
    if not row.url:
        raise UserError(f"{name}: there is no file to download. {row.how} Then copy it to {target}")
    note = f" {row.note}" if row.note else ""
    if not row.commercial and not agree(
        f"{name} has the licence {row.licence}: no commercial use.{note} Continue?"
    ):
        raise UserError(f"{name}: licence not accepted; nothing was downloaded")
    target.parent.mkdir(parents=True, exist_ok=True)
    for part in parts:
        _download(part.url, part.partial, progress)
        _verify(name, part, agree)
    for part in reversed(parts):  # the graph last: while it is missing, the model is not installed
        os.replace(part.partial, part.path)
    return target


@dataclass(frozen=True)
class ModelFile:
    """One file of a model: where it comes from, and where it is installed."""

    url: str
    sha256: str
    path: Path

    @property
    def partial(self) -> Path:
        """Return the path of the file while it is downloaded."""
        return self.path.with_name(self.path.name + ".partial")


def files_of(name: str, row: ModelEntry) -> list[ModelFile]:
    """Return the files of a model in the first models folder, the graph first.

    A graph names its second file, which therefore keeps its name; both are in a folder called `name`.
    """
    folder = models_dirs()[0]
    if not row.data_url:
        return [ModelFile(row.url, row.sha256, folder / f"{name}.onnx")]
    data = folder / name / row.data_url.rpartition("/")[2]
    return [
        ModelFile(row.url, row.sha256, folder / name / "model.onnx"),
        ModelFile(row.data_url, row.data_sha256, data),
    ]


def _verify(name: str, part: ModelFile, agree: Callable[[str], bool]) -> None:
    """Check the digest of a downloaded file; ask where there is none to compare with.

    Raises:
        UserError: another digest, or no agreement; the file is removed.
    """
    digest = sha256_of(part.partial)
    if part.sha256 and digest != part.sha256:
        part.partial.unlink()
        raise UserError(
            f"{name}: the file from {part.url} has sha256 {digest}, the table states {part.sha256}; "
            "the file was removed. Try again, or check the table"
        )
    question = (
        f"{name}: the downloaded file has sha256 {digest}; the table has none to compare with. Keep it?"
    )
    if not part.sha256 and not agree(question):
        part.partial.unlink()
        raise UserError(f"{name}: the file was not kept")


def _download(url: str, partial: Path, progress: Callable[[int, int | None], None]) -> None:
    have = partial.stat().st_size if partial.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
            resumes = have > 0 and getattr(response, "status", None) == 206
            done = have if resumes else 0
            length = response.headers.get("Content-Length")
            total = done + int(length) if length else None
            with partial.open("ab" if resumes else "wb") as file:
                while block := response.read(_BLOCK):
                    file.write(block)
                    done += len(block)
                    progress(done, total)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # the partial file is already complete
            return
        raise UserError(f"{url}: the server answered {error.code} {error.reason}") from error
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", error)
        raise UserError(
            f"{url}: download failed ({reason}); the part received is kept, try again to resume"
        ) from error
    if total is not None and done < total:
        raise UserError(f"{url}: the connection was lost after {done} of {total} bytes; try again to resume")


def describe_model_file(file: Path, table: dict[str, ModelEntry]) -> dict[str, object]:
    """Return digest, table row, inputs, outputs and execution providers of a model file, as a dictionary.

    Raises:
        UserError: the file is missing, or ONNX Runtime cannot run its graph here.
    """
    from beamsplat.common.onnx_model import OnnxModel

    path = find_model(file)
    model = OnnxModel(path)
    digest = sha256_of(path)
    names = [name for name, row in table.items() if row.sha256 == digest]
    return {
        "file": str(path),
        "sha256": digest,
        "known_as": names[0] if names else None,
        "inputs": {port.name: list(port.shape) for port in model.inputs},
        "outputs": {port.name: list(port.shape) for port in model.outputs},
        "providers": list(model.providers),
    }


def installed_path(name: str) -> Path | None:
    """Return the path of an installed model; None if it is not installed."""
    try:
        return find_model(name)
    except UserError:
        return None
