"""Conversion of a mapper to arrays and back, bit-exact: optimisation continues as if it had not been
interrupted.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.state import CAMERA_FIELDS, camera_of, progress_of, restore_store
from beamsplat.services.mapping.keyframe import (
    REACH_TILES,
    DeferredLevels,
    PyramidLevel,
    RgbdKeyframe,
    StoredKeyframe,
    compress,
    unobserved_levels,
)
from beamsplat.services.mapping.mapper import Mapper

log = logging.getLogger("beamsplat.mapping")

_NOT_STORED = {"levels", "camera"}  # recomputed from the keyframe's file; stored as `CAMERA_FIELDS`
_FIELDS = tuple(field.name for field in fields(StoredKeyframe) if field.name not in _NOT_STORED)


def arrays_of(mapper: Mapper, extra: Arrays | None = None) -> Arrays:
    """Return the state of a mapper as arrays (copies), without the images of its keyframes.

    Names of the arrays: `store_*` for Gaussians; `keyframe_*` for keyframes, in the order of the mapper, then
    the paged-out keyframes (`keyframe_parked` is True); `anchor_*` for anchors; `extra_*` for the arrays
    `extra` of the caller.
    """
    keyframes = [*mapper.keyframes.values(), *mapper.paged_out.values()]
    out = {f"store_{name}": array for name, array in mapper.store.state().items()}
    for name in _FIELDS:
        out[f"keyframe_{name}"] = np.array([getattr(k, name) for k in keyframes])
    cameras = [[getattr(k.camera, name) for name in CAMERA_FIELDS] for k in keyframes]
    out["keyframe_parked"] = np.arange(len(keyframes)) >= len(mapper.keyframes)
    out["keyframe_camera"] = np.array(cameras, np.float64).reshape(-1, len(CAMERA_FIELDS))
    out["anchor_id"] = np.array(list(mapper.T_map_anchor), np.int64)
    out["anchor_T_map"] = np.array(list(mapper.T_map_anchor.values()), np.float64).reshape(-1, 4, 4)
    out["progress"] = np.frombuffer(json.dumps(mapper.progress()).encode(), np.uint8)
    return out | {f"extra_{name}": np.array(array) for name, array in (extra or {}).items()}


def extras_of(arrays: Arrays) -> Arrays:
    """Return the arrays that were passed to `arrays_of` as `extra`."""
    return {key.removeprefix("extra_"): a for key, a in arrays.items() if key.startswith("extra_")}


def restore(
    mapper: Mapper,
    arrays: Arrays,
    read: Callable[[int], Callable[[], RgbdKeyframe]],
    *,
    keep_paged_out: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> list[str]:
    """Restore a saved state into a new mapper.

    Args:
        read: reads and checks the file of a keyframe, and returns the function that decodes its images; both
            raise ValueError.
        keep_paged_out: True: keyframes that were paged out stay paged out, and all others are decoded now, so
            that the memory use is known. False: every keyframe is in memory, and decoded when it is used.
        report: called with the progress as text; what it raises ends the restoring.

    Returns:
        One sentence for each keyframe that could not be read. Its Gaussians are in the map, but the mapper
        does not optimise on it any more.

    Raises:
        UserError: an array is missing.
    """
    lost = []
    try:
        restore_store(mapper.store, arrays)
        anchors = zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"])
        mapper.T_map_anchor = {anchor: T.copy() for anchor, T in anchors}
        ids = arrays["keyframe_id"].tolist()
        paged_out = arrays.get("keyframe_parked", np.zeros(len(ids), bool))
        for row, id in enumerate(ids):
            keyframe = _keyframe(arrays, row)
            if keep_paged_out and paged_out[row]:
                mapper.paged_out[id] = keyframe
                continue
            report(f"resuming: keyframe {row + 1} of {len(ids)}")
            try:
                decode = read(id)
                if keep_paged_out:
                    keyframe.levels = compress(decode(), mapper.settings.sigma_unit).levels
                else:
                    keyframe.levels = _deferred(keyframe, decode, mapper.settings.sigma_unit)
            except ValueError as error:
                lost.append(f"keyframe {id}: {error}")
                continue
            mapper.keyframes[id] = keyframe
        mapper.resume(progress_of(arrays))
    except KeyError as error:
        raise UserError(f"the saved state lacks {error}: restore the session from a copy") from error
    return lost


def _deferred(
    keyframe: StoredKeyframe, decode: Callable[[], RgbdKeyframe], sigma_unit: float
) -> DeferredLevels:
    def levels() -> list[PyramidLevel]:
        try:
            return list(compress(decode(), sigma_unit).levels)
        except ValueError as error:  # of images that an earlier version of this program accepted
            log.warning("the mapper no longer optimises on keyframe %d: %s", keyframe.id, error)
            return unobserved_levels(keyframe.camera)

    return DeferredLevels(levels)


def _keyframe(arrays: Arrays, row: int) -> StoredKeyframe:
    """Return the keyframe in a row of the arrays, without levels; fields not saved have their default."""
    stored = [n for n in _FIELDS if f"keyframe_{n}" in arrays]
    values = {n: _value(arrays[f"keyframe_{n}"][row]) for n in stored}
    if "reach_m" in values:  # one for the whole image in sessions of earlier versions
        values["reach_m"] = np.broadcast_to(np.float32(values["reach_m"]), REACH_TILES).copy()
    return StoredKeyframe(camera=camera_of(arrays, row), levels=[], **values)


def _value(stored: np.ndarray) -> Any:
    return stored.item() if stored.ndim == 0 else stored.copy()
