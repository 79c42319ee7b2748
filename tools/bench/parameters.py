"""Numeric fields of a settings class as parameters: name, default, unit, meaning, and values close to it."""

from __future__ import annotations

import ast
import inspect
import io
import math
import tokenize
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

# Unit by the end of a field's name; longer ends are tried first.
_UNITS = {
    "_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_deg": "deg", "_px": "px", "_m": "m", "_s": "s",
    "_grey": "grey levels", "_nodes": "nodes", "_scans": "scans", "_cells": "cells", "_jobs": "jobs",
    "_iterations": "iterations",
}  # fmt: skip


@dataclass(frozen=True)
class Parameter:
    """One numeric field of a settings object; fields of nested objects have dotted names."""

    name: str
    default: float | int
    unit: str  # "" for a pure number
    meaning: str  # the comment at the field in the source; "" without one


def parameters_of(settings: Any) -> list[Parameter]:
    """Return the int and float fields of a settings object (a dataclass), nested ones too, in their order.

    Flags, texts and tuples are left out.
    """
    comments, found = field_comments(type(settings)), []
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            found += [replace(inner, name=f"{field.name}.{inner.name}") for inner in parameters_of(value)]
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            found.append(Parameter(field.name, value, _unit(field.name), comments.get(field.name, "")))
    return found


def with_value(settings: Any, name: str, value: float | int) -> Any:
    """Return a copy of a settings object in which the field of this (dotted) name has another value."""
    first, _, rest = name.partition(".")
    return replace(settings, **{first: with_value(getattr(settings, first), rest, value) if rest else value})


def scaled(value: float | int, scale: float) -> float | int:
    """Return `value * scale`; integers are rounded and change by at least 1.

    An infinite value and a float of zero stay as they are.
    """
    if isinstance(value, int):
        rounded = round(value * scale)
        return rounded if rounded != value else value + (1 if scale > 1.0 else -1)
    return float(f"{value * scale:.6g}")


def invalid(parameter: Parameter, value: float | int) -> str:
    """Return why a value cannot be used in place of the default, or "" if it can."""
    if value == parameter.default:
        return "it does not change"
    if not math.isfinite(value):
        return "not finite"
    if value < 0.0 <= parameter.default:
        return "negative"
    if parameter.name.endswith("_ratio") and parameter.default <= 1.0 < value:
        return "above 1"
    return ""


def field_comments(settings_class: type) -> dict[str, str]:
    """Return the comment at the end of each field's line in the source of a class, by name of the field."""
    source = inspect.getsource(settings_class)
    comments = {
        token.start[0]: token.string.lstrip("# ").strip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (definition,) = ast.parse(source).body
    return {
        node.target.id: comments[node.end_lineno]
        for node in definition.body
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and node.end_lineno in comments
    }


def _unit(name: str) -> str:
    ends = sorted(_UNITS, key=len, reverse=True)
    return next((_UNITS[end] for end in ends if name.endswith(end)), "")
