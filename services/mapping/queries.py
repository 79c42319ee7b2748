"""Parameters of the queries to the mapper."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.limits import FOCAL_RATIO
from beamsplat.common.geometry.transforms import make_transform, matrix_from_quat_wxyz
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.chunks import Viewpoint

_MAX_COORDINATE_M = 1e6
_LEAST_SIZE_PX, _LARGEST_SIZE_PX = 16, 2048  # edges of a rendered image
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
    return Viewpoint(
        _position("snapshot", parameters, "from"),
        _number("snapshot", parameters, "focal_px", (_MIN_PX, _MAX_PX)),
        _number("snapshot", {"error_px": "1", **parameters}, "error_px", (_MIN_PX, _MAX_PX)),
    )


class View(NamedTuple):
    """A camera pose, and a camera if the query has one."""

    T_map_camera: np.ndarray  # float64 [4, 4], optical frame
    camera: RasterCamera | None


def view_of(parameters: dict[str, str]) -> View:
    """Return the view in the parameters of the query `render`.

    `position` is X,Y,Z (m, map frame) and `quaternion` X,Y,Z,W of the camera's optical frame. `width_px`,
    `height_px` and `focal_px` are given together or not at all; the principal point is the centre.

    Raises:
        UserError: a parameter is unknown, missing, not a number, or out of range; the text has its name and
            value.
    """
    size = ("width_px", "height_px", "focal_px")
    check_names("render", parameters, ("position", "quaternion", *size))
    wanted = ("position", "quaternion", *(size if any(name in parameters for name in size) else ()))
    for name in wanted:
        if name not in parameters:
            raise UserError(f"render: the parameter {name} is missing, with {_shown(parameters)}")
    position_m = _position("render", parameters, "position")
    x, y, z, w = _numbers("render", parameters, "quaternion", 4, (-1e3, 1e3), "numbers X,Y,Z,W")
    try:
        T_map_camera = make_transform(matrix_from_quat_wxyz(np.array([w, x, y, z])), position_m)
    except ValueError:
        raise _wrong("render", parameters, "quaternion", "a quaternion that is not zero") from None
    if "width_px" not in parameters:
        return View(T_map_camera, None)
    sizes_px = (_LEAST_SIZE_PX, _LARGEST_SIZE_PX)
    width_px, height_px = (int(_number("render", parameters, name, sizes_px)) for name in size[:2])
    largest_px = max(width_px, height_px)
    limits = (FOCAL_RATIO[0] * largest_px, FOCAL_RATIO[1] * largest_px)
    focal_px = _number("render", parameters, "focal_px", limits)
    cx_px, cy_px = 0.5 * (width_px - 1), 0.5 * (height_px - 1)
    return View(T_map_camera, RasterCamera(focal_px, focal_px, cx_px, cy_px, width_px, height_px))


def keyframe_id_of(parameters: dict[str, str]) -> int:
    """Return the id in the parameters of the query `keyframe`.

    Raises:
        UserError: a parameter is unknown, missing, or not an id; the text has its name and value.
    """
    check_names("keyframe", parameters, ("id",))
    if "id" not in parameters:
        raise UserError(f"keyframe: the parameter id is missing, with {_shown(parameters)}")
    word = parameters["id"]
    if not (word.isascii() and word.isdigit() and len(word) <= 19):
        raise _wrong("keyframe", parameters, "id", "the id of a keyframe")
    return int(word)


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


def _position(query: str, parameters: dict[str, str], name: str) -> np.ndarray:
    limits_m = (-_MAX_COORDINATE_M, _MAX_COORDINATE_M)
    return np.array(_numbers(query, parameters, name, 3, limits_m, "numbers X,Y,Z (m, map frame)"))


def _numbers(
    query: str, parameters: dict[str, str], name: str, count: int, limits: tuple[float, float], what: str
) -> list[float]:
    words = parameters[name].split(",")
    if len(words) != count:
        raise _wrong(query, parameters, name, f"{count} {what}")
    return [_checked(query, parameters, name, word, limits) for word in words]


def _number(query: str, parameters: dict[str, str], name: str, limits: tuple[float, float]) -> float:
    return _checked(query, parameters, name, parameters[name], limits)


def _checked(
    query: str, parameters: dict[str, str], name: str, word: str, limits: tuple[float, float]
) -> float:
    """Return the number in `word`, a part of the parameter `name`, within limits (inclusive)."""
    least, most = limits
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise _wrong(query, parameters, name, f"a number from {least:g} to {most:g}")
    return value


def _wrong(query: str, parameters: dict[str, str], name: str, expected: str) -> UserError:
    return UserError(f"{query}: {_shown({name: parameters[name]})}: expected {expected}")


def _shown(parameters: dict[str, str]) -> str:
    text = ", ".join(f"{name}={value}" for name, value in parameters.items())
    return ascii(text)[1:-1][:_SHOWN_CHARS]
