"""Edit the arrays of saved maps: move anchors, merge two maps, remove Gaussians and keyframes."""

from __future__ import annotations

import json

import numpy as np

from beamsplat.common.errors import UserError
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.harmonics.basis import degree_of, with_degree
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.state import progress_of, store_of
from beamsplat.common.mapfiles.store import HARMONIC_ARRAYS, GaussianStore
from beamsplat.common.raster.layout import OPACITY

_KEYFRAMES, _STORE, _TAKEN = "keyframe_", "store_", "extra_taken_"


def with_anchors(arrays: Arrays, T_map_anchor: dict[int, np.ndarray]) -> Arrays:
    """Return the map with new anchor poses; Gaussians and keyframes move with their anchors.

    `T_map_anchor` contains poses float64 [4, 4] by anchor id; anchors that are not in it do not move.
    """
    ids, poses = arrays["anchor_id"], arrays["anchor_T_map"].copy()
    store = store_of(arrays)
    for row, anchor in enumerate(ids.tolist()):
        if anchor in T_map_anchor:
            store.move(anchor, T_map_anchor[anchor] @ inverse(poses[row]))
            poses[row] = T_map_anchor[anchor]
    return arrays | _prefixed(store) | {"anchor_T_map": poses}


def merged(a: Arrays, b: Arrays, T_a_b: np.ndarray, offset: int) -> Arrays:
    """Return map a with all contents of map b inserted.

    Args:
        T_a_b: pose of the frame of map b in the frame of map a, float64 [4, 4].
        offset: number that is added to the anchor ids of map b.

    Spherical harmonics that only one of them has are left out.

    Raises:
        UserError: both maps contain the same keyframes, or an anchor id plus the offset exists in map a.
    """
    shared = set(a["extra_taken_id"].tolist()) & set(b["extra_taken_id"].tolist())
    if shared:
        raise UserError(
            f"the sessions share {len(shared)} keyframes (such as {min(shared)}): they are of the same run"
        )
    ids_b = b["anchor_id"] + offset
    if set(ids_b.tolist()) & set(a["anchor_id"].tolist()):
        raise UserError(f"with offset {offset}, anchor ids of the second map exist in the first")
    T_a_anchor = {anchor: T_a_b @ T for anchor, T in zip(b["anchor_id"].tolist(), b["anchor_T_map"])}
    b = with_anchors(b, T_a_anchor)
    b = b | {
        "anchor_id": ids_b, "keyframe_anchor": b["keyframe_anchor"] + offset,
        "store_anchor": b["store_anchor"] + offset, "store_events": b["store_events"] + [[offset, 0]],
    }  # fmt: skip
    if "store_harmonics" in a and "store_harmonics" in b:
        degree = degree_of(len(a["store_harmonics"]))
        b |= {f"{_STORE}{name}": with_degree(b[f"{_STORE}{name}"], degree) for name in HARMONIC_ARRAYS}
    out = dict(a)
    for key in a:
        if key not in b:  # written by a newer program only: the mapper has a default for it
            out.pop(key)
        elif key.startswith(_STORE) and key != "store_events":
            out[key] = np.concatenate([a[key], b[key]], axis=-1)
        elif key.startswith((_KEYFRAMES, "anchor_", _TAKEN)) or key == "store_events":
            out[key] = np.concatenate([a[key], b[key]])
    progress, other = progress_of(a), progress_of(b)
    progress["steps"] += other["steps"]
    progress["forgotten"] = sorted(progress["forgotten"] + other["forgotten"])
    progress["given_up"] = _given_up(progress) + _given_up(other)
    return out | _progress(progress)


def with_gaussians(arrays: Arrays, stay: np.ndarray) -> Arrays:
    """Return the map without the Gaussians whose flag in `stay` bool [N] is False."""
    store = store_of(arrays)
    store.keep(stay)
    return arrays | _prefixed(store)


def pruned(arrays: Arrays, least_opacity: float, keyframes: int | None) -> Arrays:
    """Return the map without Gaussians of low opacity, and with fewer keyframes.

    Args:
        least_opacity: Gaussians whose opacity in [0, 1] is lower are removed.
        keyframes: number of keyframes that remain, evenly spaced in time; None: all. The Gaussians of removed
            keyframes remain.
    """
    opacity = 1.0 / (1.0 + np.exp(-arrays["store_params"][OPACITY].astype(np.float64)))
    out = with_gaussians(arrays, opacity >= least_opacity)
    ids = arrays["keyframe_id"]
    if keyframes is not None and len(ids) > keyframes:
        in_time = np.argsort(ids, kind="stable")
        kept = np.sort(in_time[np.linspace(0, len(ids) - 1, keyframes).round().astype(int)])
        out |= {key: a[kept] for key, a in arrays.items() if key.startswith(_KEYFRAMES)}
        progress = progress_of(arrays)
        gone = set(ids.tolist()) - set(ids[kept].tolist())
        progress["given_up"] = _given_up(progress) + len(gone)
        progress["forgotten"] = sorted({*progress["forgotten"], *gone})
        progress["newest"] = [id for id in progress["newest"] if id not in gone]
        out |= _progress(progress)
    return out


def summary_of(arrays: Arrays) -> dict[str, int]:
    """Return the summary of a saved map for its manifest: number of keyframes, Gaussians etc., last stamp."""
    stamps_ns = arrays["extra_taken_stamp_ns"]
    return {
        "keyframes": len(arrays["keyframe_id"]), "gaussians": arrays["store_params"].shape[1],
        "steps": progress_of(arrays)["steps"], "anchors": len(arrays["anchor_id"]),
        "stamp_ns": int(stamps_ns.max()) if len(stamps_ns) else 0,
    }  # fmt: skip


def _given_up(progress: dict) -> int:
    return progress.get("given_up", len(progress["forgotten"]))


def _prefixed(store: GaussianStore) -> Arrays:
    return {f"{_STORE}{name}": array for name, array in store.state().items()}


def _progress(progress: dict) -> Arrays:
    return {"progress": np.frombuffer(json.dumps(progress).encode(), np.uint8)}
