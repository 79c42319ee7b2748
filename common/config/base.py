"""Tables that somebody wrote by hand: taken as they are, or refused in one sentence; nothing is repaired."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from beamsplat.common.errors import UserError


class Config(BaseModel):
    """Base of every configuration: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def parse(cls: type[Config], table: dict[str, Any], where: str) -> Any:
    """`cls` from a raw table.

    Raises:
        UserError: one sentence per fault, naming `where`, field, value and what was expected.
    """
    try:
        return cls.model_validate(table)
    except ValidationError as error:
        faults = []
        for fault in error.errors(include_url=False):
            field = ".".join(str(part) for part in fault["loc"])
            if fault["type"] == "extra_forbidden":
                known = ", ".join(sorted(_at(cls, fault["loc"][:-1]).model_fields))
                faults.append(f"unknown option {field!r} (there are: {known})")
            elif fault["type"] == "missing":
                faults.append(f"option {field!r} is required: give it in the file, or by --set")
            else:
                faults.append(f"{field} = {fault['input']!r}: {fault['msg']}")
        raise UserError(f"{where}: " + "; ".join(faults)) from error


def _at(cls: type[BaseModel], place: tuple[str | int, ...]) -> type[BaseModel]:
    """The model of the table at `place` within `cls`, as far down as models go."""
    for part in place:
        field = cls.model_fields.get(str(part))
        inner = field.annotation if field is not None else None
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            break
        cls = inner
    return cls
