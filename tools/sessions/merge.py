"""The last step of a merge: remove surfaces that both maps contain."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

from beamsplat.common.geometry.camera import Undistorter
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import KeyframeView
from beamsplat.common.messages import Keyframe
from beamsplat.common.messages.codec import decode
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.messages import decode_keyframe
from beamsplat.tools.sessions.deduplicate import without_duplicates
from beamsplat.tools.sessions.edit import with_gaussians


def deduplicated(
    folder: SessionFolder,  # contains the keyframes of both maps
    arrays: Arrays,  # from `merged`
    offset: int,  # added to the anchor ids of the second map
    progress: Callable[[list[KeyframeView]], Iterable[KeyframeView]] = iter,
) -> Arrays:
    """Return the merged map without duplicate surfaces: where both maps agree, the better one remains.

    Better is the map whose render is closer to the images of the keyframes.
    """
    lens = lru_cache(maxsize=4)(Undistorter)

    def load(id: int) -> RgbdKeyframe:
        message = decode(*folder.read_keyframe(id))
        assert isinstance(message, Keyframe)  # sessions store keyframes only
        return decode_keyframe(message, lens)

    stay = without_duplicates(
        arrays, arrays["store_anchor"] >= offset - 1,
        load, progress,
    )  # fmt: skip
    return with_gaussians(arrays, stay)


def merge_doubt(agreeing: int, queried: int, loop_closures: int) -> str:
    """Return why the estimated pose of a second map in the first may be wrong; "" if it is confirmed.

    Args:
        agreeing: number of scans of the second map whose pose in the first map agrees with the estimate.
        queried: number of scans of the second map that were relocalized in the first map.
        loop_closures: number of loop closures between the two maps at the estimated pose.
    """
    if loop_closures > 0 or 2 * agreeing > queried:
        return ""
    return (
        f"only {agreeing} of {queried} scans agree on the place of the second drive, and no loop closure "
        "between the drives confirms it"
    )
