"""Gaussians that were removed from a session by hand, kept beside it so that they can be put back.

One file per edit, `edge/edits/<number>.npz`, is written before the state without these Gaussians. The newest
is put back first. Anchors may have moved since: the Gaussians move with them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.numbered_state import numbered_files, packed_arrays, unpacked_arrays
from beamsplat.common.files.persist import write_durably
from beamsplat.common.geometry.transforms import inverse
from beamsplat.common.harmonics.basis import rotated
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.store import transform_with_momentum

_STORE, _EVENTS = "store_", "store_events"
_HARMONICS = ("store_harmonics", "store_harmonics_first")  # of colours that depend on the view


class RemovedGaussians:
    """The stack of removed Gaussians of one session; the caller holds the lock of the session."""

    def __init__(self, edge: Path) -> None:
        """`edge`: folder of the mapper's files."""
        self._folder = edge / "edits"

    def __len__(self) -> int:
        return len(numbered_files(self._folder, "", ".npz"))

    def push(self, arrays: Arrays, removed: np.ndarray, text: str) -> None:
        """Write the Gaussians of a state whose flag in `removed` bool [N] is True, and what the edit was.

        Raises:
            OSError: the disk is full or broken.
        """
        self._folder.mkdir(exist_ok=True)
        kept = {key: a[..., removed] for key, a in arrays.items() if _is_column(key)}
        places = {key: arrays[key] for key in ("anchor_id", "anchor_T_map")}
        number = 1 + max(numbered_files(self._folder, "", ".npz"), default=0)
        note = {"text": np.frombuffer(text.encode(), np.uint8)}
        write_durably(self._folder / f"{number}.npz", packed_arrays(kept | places | note))

    def newest(self) -> tuple[Path, str, Arrays]:
        """Return the file of the newest edit, what it was, and its arrays.

        Raises:
            UserError: there is none, or it cannot be read.
        """
        files = numbered_files(self._folder, "", ".npz")
        if not files:
            raise UserError(f"{self._folder.parent.parent}: no edit to be undone")
        path = files[max(files)]
        try:
            saved = unpacked_arrays(path.read_bytes())
            return path, saved.pop("text").tobytes().decode(), saved
        except Exception as error:
            raise UserError(f"{path}: {reason(error)}; restore it from a copy, or remove it") from error


def put_back(arrays: Arrays, saved: Arrays) -> Arrays:
    """Return the state with the Gaussians of an edit; the same state if they are in it.

    They are in it if the edit was interrupted before the state without them was written.

    Raises:
        UserError: the map no longer has an anchor of these Gaussians.
    """
    count = saved["store_params"].shape[1]
    if count == 0 or _contains(arrays["store_params"], saved["store_params"][:, 0]):
        return arrays
    now = dict(zip(arrays["anchor_id"].tolist(), arrays["anchor_T_map"]))
    params, first = saved["store_params"].copy(), saved["store_first"].copy()
    harmonics = {key: saved[key].copy() for key in _HARMONICS if key in saved}
    for anchor, before in zip(saved["anchor_id"].tolist(), saved["anchor_T_map"]):
        rows = saved["store_anchor"] == anchor
        if not rows.any():
            continue
        if anchor not in now:
            raise UserError(f"the map no longer has anchor {anchor}, of {int(rows.sum())} of the Gaussians")
        if not np.array_equal(now[anchor], before):
            move = now[anchor] @ inverse(before)
            params[:, rows], first[:, rows] = transform_with_momentum(params[:, rows], first[:, rows], move)
            for array in harmonics.values():
                array[:, rows] = rotated(array[:, rows], move[:3, :3])
    back = saved | {"store_params": params, "store_first": first} | harmonics
    out = dict(arrays)
    for key in arrays:
        if _is_column(key):
            part = back.get(key, np.zeros((*arrays[key].shape[:-1], count), arrays[key].dtype))
            out[key] = np.concatenate([arrays[key], part.astype(arrays[key].dtype)], axis=-1)
    events = out[_EVENTS].copy()
    events[np.isin(events[:, 0], saved["store_anchor"]), 1] += 1  # viewers fetch these anchors again
    return out | {_EVENTS: events}


def _is_column(key: str) -> bool:
    return key.startswith(_STORE) and key != _EVENTS


def _contains(params: np.ndarray, column: np.ndarray) -> bool:
    return bool((params[:3] == column[:3, None]).all(axis=0).any())
