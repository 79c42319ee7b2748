"""Read parts of a saved state without a mapper: Gaussians, counters and keyframe views."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from beamsplat.common.harmonics.basis import degree_of
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera

CAMERA_FIELDS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


def store_of(arrays: Arrays) -> GaussianStore:
    """Return the Gaussians of a saved state.

    Raises:
        KeyError: an array is missing.
    """
    rows = arrays["store_harmonics"].shape[0] if "store_harmonics" in arrays else 0
    store = GaussianStore(degree=degree_of(rows))
    restore_store(store, arrays)
    return store


def restore_store(store: GaussianStore, arrays: Arrays) -> None:
    """Replace the contents of `store` by the Gaussians of a saved state.

    Raises:
        KeyError: an array is missing.
    """
    store.restore({k.removeprefix("store_"): a for k, a in arrays.items() if k.startswith("store_")})


def progress_of(arrays: Arrays) -> dict[str, Any]:
    """Return the mapper's counters (see `Mapper.progress`) that a saved state contains."""
    return json.loads(arrays["progress"].tobytes())


@dataclass(frozen=True)
class KeyframeView:
    """The camera and the refined pose of a keyframe in a saved map."""

    id: int
    camera: RasterCamera
    T_map_camera: np.ndarray


def keyframe_views(arrays: Arrays) -> list[KeyframeView]:
    """Return the views of all keyframes in a saved state, by ascending id, which is the order of time."""
    T_map_anchor = dict(zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"]))
    out = []
    for row, id in enumerate(arrays["keyframe_id"].tolist()):
        T_anchor_camera = arrays["keyframe_T_anchor_camera"][row] @ arrays["keyframe_delta"][row]
        T_map_camera = T_map_anchor[int(arrays["keyframe_anchor"][row])] @ T_anchor_camera
        out.append(KeyframeView(id, camera_of(arrays, row), T_map_camera))
    return sorted(out, key=lambda view: view.id)


def camera_of(arrays: Arrays, row: int) -> RasterCamera:
    """Return the camera of the keyframe in row `row` of the `keyframe_*` arrays."""
    numbers = dict(zip(CAMERA_FIELDS, arrays["keyframe_camera"][row].tolist()))
    return RasterCamera(**numbers | {name: int(numbers[name]) for name in ("width_px", "height_px")})
