"""Parameters of the queries to the mapper."""

from __future__ import annotations

import math

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.services.mapping.chunks import Viewpoint

_MAX_COORDINATE_M = 1e6
_MAX_PX = 1e6  # of a focal length, and of the size of invisible detail
_MIN_PX = 1e-3
_SHOWN_CHARS = 80  # of a wrong value, in the text of the error


def viewpoint_of(parameters: dict[str, str]) -> Viewpoint | None:
    """Return the viewpoint in the parameters of the query `snapshot`; None without any parameter.

    Raises:
        UserError: a parameter is unknown, missing, not a number, or out of range; the text has its name and
            value.
    """
    if not check_names("snapshot", parameters, ("from", "focal_px", "error_px")):
        return None
    for name in ("from", "focal_px"):
        if name not in parameters:
            raise UserError(f"snapshot: the parameter {name} is missing, with {_shown(parameters)}")
    words = parameters["from"].split(",")
    if len(words) != 3:
        raise _wrong("from", parameters["from"], "three numbers X,Y,Z (m, map frame)")
    limits_px = (_MIN_PX, _MAX_PX)
    return Viewpoint(
        np.array([_number(parameters, "from", w, (-_MAX_COORDINATE_M, _MAX_COORDINATE_M)) for w in words]),
        _number(parameters, "focal_px", parameters["focal_px"], limits_px),
        _number(parameters, "error_px", parameters.get("error_px", "1"), limits_px),
    )


def check_names(query: str, parameters: dict[str, str], known: tuple[str, ...]) -> bool:
    """Check the names of the parameters of a query; return whether there are any.

    Zenoh's own parameters, whose names begin with an underscore, are ignored.

    Raises:
        UserError: a parameter is not in `known`.
    """
    given = [name for name in parameters if not name.startswith("_")]
    for name in given:
        if name not in known:
            allowed = f"its parameters are {', '.join(known)}" if known else "it has no parameters"
            raise UserError(f"{query}: unknown parameter {_shown({name: parameters[name]})}: {allowed}")
    return bool(given)


def _number(parameters: dict[str, str], name: str, word: str, limits: tuple[float, float]) -> float:
    """Return the number in `word`, a part of the parameter `name`, within limits (inclusive)."""
    least, most = limits
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise _wrong(name, parameters.get(name, word), f"a number from {least:g} to {most:g}")
    return value


def _wrong(name: str, value: str, expected: str) -> UserError:
    return UserError(f"snapshot: {_shown({name: value})}: expected {expected}")


def _shown(parameters: dict[str, str]) -> str:
    text = ", ".join(f"{name}={value}" for name, value in parameters.items())
    return ascii(text)[1:-1][:_SHOWN_CHARS]
