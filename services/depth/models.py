"""The table of models, and fetching one: resumed, with progress, checked before it is put in its place."""

from __future__ import annotations

import os
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable
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


class ModelEntry(Config):
    """One model of the table."""

    source: str  # the depth source that takes it
    licence: str
    commercial: bool
    url: Annotated[str, Field(pattern=r"^(https://.*|file://.*|http://127\.0\.0\.1[:/].*|)$")]
    sha256: Annotated[str, Field(pattern=r"^([0-9a-f]{64}|)$")]  # "" = nobody has verified it
    how: str = ""


def read_model_table(path: Path = TABLE) -> dict[str, ModelEntry]:
    """All rows by name.

    Raises:
        UserError: no such file, not TOML, or a row that does not fit.
    """
    try:
        table = tomllib.loads(path.read_text())
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"{path}: cannot be read as the table of models: {reason(error)}") from error
    return {name: parse(ModelEntry, row, f"{path}: [{name}]") for name, row in table.items()}


def find_entry(name: str, table: dict[str, ModelEntry]) -> ModelEntry:
    """The row called `name`.

    Raises:
        UserError: none; lists those there are.
    """
    if name not in table:
        raise UserError(f"there is no model {name!r}; there are {', '.join(table)}")
    return table[name]


def pull(
    name: str,
    row: ModelEntry,
    agree: Callable[[str], bool],
    progress: Callable[[int, int | None], None] = lambda done, total: None,
) -> Path:
    """Fetches a model into the first models folder; an interrupted download goes on where it stopped.

    `agree(question)` is asked for a non-commercial licence, and for a file that nobody has verified.

    Raises:
        UserError: no address, refused, no connection, or the wrong digest (the file is then removed).
    """
    target = models_dirs()[0] / f"{name}.onnx"
    if target.is_file() and row.sha256 and sha256_of(target) == row.sha256:
        return target
    if not row.url:
        raise UserError(f"{name}: no finished file is published. {row.how} Then put it at {target}")
    if not row.commercial and not agree(f"{name} is licensed {row.licence}: not for commercial use. Go on?"):
        raise UserError(f"{name}: licence not accepted; nothing was fetched")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(target.name + ".partial")
    _download(row.url, partial, progress)
    digest = sha256_of(partial)
    if row.sha256 and digest != row.sha256:
        partial.unlink()
        raise UserError(
            f"{name}: the file from {row.url} has sha256 {digest}, the table says {row.sha256}; "
            "it was removed. Try again, or check the table"
        )
    question = f"{name}: sha256 of what arrived is {digest}; the table holds none to compare with. Keep it?"
    if not row.sha256 and not agree(question):
        partial.unlink()
        raise UserError(f"{name}: not kept")
    os.replace(partial, target)
    return target


def _download(url: str, partial: Path, progress: Callable[[int, int | None], None]) -> None:
    have = partial.stat().st_size if partial.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            goes_on = have > 0 and getattr(answer, "status", None) == 206
            done = have if goes_on else 0
            length = answer.headers.get("Content-Length")
            total = done + int(length) if length else None
            with partial.open("ab" if goes_on else "wb") as file:
                while block := answer.read(_BLOCK):
                    file.write(block)
                    done += len(block)
                    progress(done, total)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # the whole file is there already
            return
        raise UserError(f"{url}: the server says {error.code} {error.reason}") from error
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", error)
        raise UserError(f"{url}: cannot be fetched ({reason}); what arrived is kept, try again") from error
    if total is not None and done < total:
        raise UserError(
            f"{url}: the connection broke at {done} of {total} bytes; try again, it goes on there"
        )


def describe_model_file(file: Path, table: dict[str, ModelEntry]) -> dict[str, object]:
    """What a model file is: digest, the row it matches, ports, and how long a run takes to answer.

    Raises:
        UserError: no such file, or no graph that runs here.
    """
    from beamsplat.services.depth.onnx_model import OnnxModel

    path = find_model(file)
    model = OnnxModel(path)
    digest = sha256_of(path)
    named = [name for name, row in table.items() if row.sha256 == digest]
    return {
        "file": str(path),
        "sha256": digest,
        "known_as": named[0] if named else None,
        "inputs": {port.name: list(port.shape) for port in model.inputs},
        "outputs": {port.name: list(port.shape) for port in model.outputs},
        "providers": list(model.providers),
    }


def installed_path(name: str) -> Path | None:
    """Where a model lies, None if nowhere."""
    try:
        return find_model(name)
    except UserError:
        return None
