"""The last step of a merge: what both maps show is there once, as the pictures in the session decide."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

from common.camera import Undistorter
from common.codec import decode
from services.mapping.messages import open_keyframe
from services.mapping.session.blocks import Arrays
from services.mapping.session.edit import with_gaussians
from services.mapping.session.folder import SessionFolder
from services.mapping.session.seams import without_doubles
from services.mapping.session.state import View


def once(
    folder: SessionFolder,  # with the keyframes of both
    arrays: Arrays,  # as `merged` gives them
    offset: int,  # of the second map's anchors
    watched: Callable[[list[View]], Iterable[View]] = iter,
) -> Arrays:
    """The merged map without doubled surfaces."""
    lens = lru_cache(maxsize=4)(Undistorter)
    stay = without_doubles(
        arrays, arrays["store_anchor"] >= offset - 1,
        lambda id: open_keyframe(decode(*folder.read_body(id)), lens), watched,
    )  # fmt: skip
    return with_gaussians(arrays, stay)
