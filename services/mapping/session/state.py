"""A mapper as arrays and back: bit for bit, so that training goes on as if nothing had happened."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.state import CAMERA_FIELDS, camera_of, progress_of, store_of
from beamsplat.services.mapping.keyframe import Held, Keyframe, Level, hold
from beamsplat.services.mapping.mapper import FULL, Mapper

_NOT_STORED = {"levels"}  # made again from the keyframe's body
_FIELDS = tuple(field.name for field in fields(Held) if field.name not in _NOT_STORED)


def arrays_of(mapper: Mapper, extra: Arrays | None = None) -> Arrays:
    """Copies of all that a mapper is, but for its keyframes' pictures; `extra` rides along.

    Gaussians are `store_*`, keyframes `keyframe_*` (in the mapper's order, then the resting ones, whose
    pictures are not in memory), anchors `anchor_*`.
    """
    held = [*mapper.keyframes.values(), *mapper.resting.values()]
    out = {f"store_{name}": array for name, array in mapper.store.state().items()}
    for name in _FIELDS:
        out[f"keyframe_{name}"] = np.array([getattr(h, name) for h in held])
    cameras = [[getattr(h.levels[FULL].camera, name) for name in CAMERA_FIELDS] for h in held]
    out["keyframe_parked"] = np.arange(len(held)) >= len(mapper.keyframes)
    out["keyframe_camera"] = np.array(cameras, np.float64).reshape(-1, len(CAMERA_FIELDS))
    out["anchor_id"] = np.array(list(mapper.T_map_anchor), np.int64)
    out["anchor_T_map"] = np.array(list(mapper.T_map_anchor.values()), np.float64).reshape(-1, 4, 4)
    out["progress"] = np.frombuffer(json.dumps(mapper.progress()).encode(), np.uint8)
    return out | {f"extra_{name}": np.array(array) for name, array in (extra or {}).items()}


def extras_of(arrays: Arrays) -> Arrays:
    """What rode along."""
    return {key.removeprefix("extra_"): a for key, a in arrays.items() if key.startswith("extra_")}


def restore(mapper: Mapper, arrays: Arrays, body: Callable[[int], Keyframe], rest: bool = False) -> list[str]:
    """Makes a fresh mapper what the saved one was; `body` opens a keyframe by its id. Those whose pictures
    were not in memory stay without them if they are to `rest`.

    Gives one sentence for each keyframe that could not be opened: the map is whole without it, but does not
    learn from it any more.

    Raises:
        UserError: the arrays are not a whole state.
    """
    lost = []
    try:
        mapper.store = store_of(arrays)
        anchors = zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"])
        mapper.T_map_anchor = {anchor: T.copy() for anchor, T in anchors}
        resting = arrays.get("keyframe_parked", np.zeros(len(arrays["keyframe_id"]), bool))
        for row, id in enumerate(arrays["keyframe_id"].tolist()):
            held = _held(arrays, row)
            if rest and resting[row]:
                mapper.resting[id] = held
                continue
            try:
                held.levels = hold(body(id), mapper.settings.sigma_unit).levels
            except ValueError as error:
                lost.append(f"keyframe {id}: {error}")
                continue
            mapper.keyframes[id] = held
        mapper.resume(progress_of(arrays))
    except KeyError as error:
        raise UserError(f"the saved state lacks {error}: restore the session from a copy") from error
    return lost


def _held(arrays: Arrays, row: int) -> Held:
    """A keyframe without its pictures; what came later than the file keeps its default."""
    empty, stored = np.zeros(0, np.uint8), [n for n in _FIELDS if f"keyframe_{n}" in arrays]
    level = Level(camera_of(arrays, row), empty, empty, empty, empty, empty)
    return Held(levels=[level], **{n: _value(arrays[f"keyframe_{n}"][row]) for n in stored})


def _value(stored: np.ndarray) -> Any:
    return stored.item() if stored.ndim == 0 else stored.copy()
