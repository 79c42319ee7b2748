"""The last step of a merge: what both maps show is there once, as the pictures in the session decide."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

from beamsplat.common.geometry.camera import Undistorter
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import KeyframeView
from beamsplat.common.messages.codec import decode
from beamsplat.services.mapping.messages import decode_keyframe
from beamsplat.tools.sessions.deduplicate import without_duplicates
from beamsplat.tools.sessions.edit import with_gaussians


def once(
    folder: SessionFolder,  # with the keyframes of both
    arrays: Arrays,  # as `merged` gives them
    offset: int,  # of the second map's anchors
    watched: Callable[[list[KeyframeView]], Iterable[KeyframeView]] = iter,
) -> Arrays:
    """The merged map without doubled surfaces."""
    lens = lru_cache(maxsize=4)(Undistorter)
    stay = without_duplicates(
        arrays, arrays["store_anchor"] >= offset - 1,
        lambda id: decode_keyframe(decode(*folder.read_keyframe(id)), lens), watched,
    )  # fmt: skip
    return with_gaussians(arrays, stay)
