"""Base class of configuration tables and their validation: invalid tables are rejected, never corrected."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from beamsplat.common.errors import UserError
from beamsplat.common.redaction import REMOVED, is_secret

# Error types of pydantic (its documentation, "Validation Errors").
_TEXT_EXPECTED = ("string_type", "path_type")
_LIST_EXPECTED = ("tuple_type", "list_type", "set_type", "frozen_set_type")


_REMOTE = "may be set from another host"
_T = TypeVar("_T")
# Type of an option that other hosts may change while the system runs: thresholds, rates and the like. Never
# files, commands, addresses, secrets, classes, or limits that protect memory and disk.
Remote = Annotated[_T, _REMOTE]


class Config(BaseModel):
    """Base class of all configurations: immutable; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def remote_options(cls: type[BaseModel]) -> tuple[str, ...]:
    """Return the names of the options that other hosts may change (type `Remote`)."""
    return tuple(name for name, field in cls.model_fields.items() if _REMOTE in field.metadata)


def parse(cls: type[Config], table: dict[str, Any], where: str, prefix: str | None = None) -> Any:
    """Return a `cls` instance made from a raw table; `where` names the table's source in errors.

    Args:
        prefix: text before a field's name in `--set`, for example "camera."; None for tables whose fields
            `--set` cannot change.

    Raises:
        UserError: the table is invalid; one clause per fault with field, value and expected value.
    """
    try:
        return cls.model_validate(table)
    except ValidationError as error:
        faults = []
        for fault in error.errors(include_url=False):
            field = ".".join(str(part) for part in fault["loc"])
            if fault["type"] == "extra_forbidden":
                known = ", ".join(sorted(_model_at(cls, fault["loc"][:-1]).model_fields))
                faults.append(f"unknown option {field!r} (options are: {known})")
            elif fault["type"] == "missing":
                faults.append(f"option {field!r} is required: set it in the file, or with --set")
            else:
                hint = "" if prefix is None else _quoting_hint(f"{prefix}{field}", fault)
                value = REMOVED if is_secret(field) else f"{fault['input']!r}"
                faults.append(f"{field} = {value}: {fault['msg']}{'' if is_secret(field) else hint}")
        raise UserError(f"{where}: " + "; ".join(faults)) from error


def _quoting_hint(option: str, fault: ErrorDetails) -> str:
    """Return how to write a text or a list on the command line, where the wrong type was parsed as TOML."""
    value = fault["input"]
    if fault["type"] in _TEXT_EXPECTED and isinstance(value, (bool, int, float)):
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return f"; a text needs quotes: --set '{option}=\"{text}\"'"
    if fault["type"] in _LIST_EXPECTED and isinstance(value, str):
        return f"; a list needs brackets: --set '{option}=[\"{value}\"]'"
    return ""


def _model_at(cls: type[BaseModel], path: tuple[str | int, ...]) -> type[BaseModel]:
    """Return the model of the nested table at `path` in `cls`, or the deepest model on that path."""
    for part in path:
        field = cls.model_fields.get(str(part))
        inner = field.annotation if field is not None else None
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            break
        cls = inner
    return cls
