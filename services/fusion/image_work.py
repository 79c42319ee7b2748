"""The work on the images of a drive: depth at once, plane sweeps of keyframes beside it, results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from beamsplat.services.fusion.fuse import ExaminedImage, Fusion, SweptKeyframe
from beamsplat.services.fusion.inputs import FusionInput
from beamsplat.services.fusion.ordered_results import OrderedResults
from beamsplat.services.fusion.result import FusionResult, rejected
from beamsplat.services.fusion.single_image import SingleImageFusion

_KEYFRAMES = (
    1  # that waits for its plane sweep, beside the one that is computed: each adds to the delay of all
)
_RESULTS = 16  # that wait for the sweep of an earlier keyframe: 40 MB at 640x480


@dataclass(frozen=True)
class CandidateImage:
    """An image that is ready for fusion, with the age of its beams."""

    frame: FusionInput
    beams_age_ns: int


@dataclass(frozen=True)
class FusedImage:
    """The result of one image. `candidate` is None for an image that could not become a candidate."""

    stamp_ns: int
    candidate: CandidateImage | None
    result: FusionResult
    keyframe: bool


@dataclass(frozen=True)
class _KeyframeWork:
    number: int  # among the results
    candidate: CandidateImage
    examined: ExaminedImage


class ImageWork:
    """Fuses images in order. One plane sweep at a time runs in another thread, in the order of the keyframes.

    Images between keyframes use the newest keyframe depth that is finished. A keyframe for which no place is
    left becomes an image between keyframes: a later image takes its place.
    """

    def __init__(self, fusion: Fusion | SingleImageFusion) -> None:
        self._fusion = fusion
        self._keyframes: deque[_KeyframeWork] = deque()
        self._swept: _KeyframeWork | None = None  # its sweep runs
        self._results: OrderedResults[FusedImage] = OrderedResults(_RESULTS)
        self.postponed = 0  # keyframes for which no place was left

    def refuse(self, stamp_ns: int, status: str) -> list[FusedImage]:
        """Take an image without depth, whose `status` is the reason; return the results that are due."""
        fused = FusedImage(stamp_ns, None, rejected((0, 0), status), False)
        return self._results.finish(self._results.begin(), fused)

    def take(self, candidate: CandidateImage, keyframe: bool) -> list[FusedImage]:
        """Take the next image; return the results that are due. Call `next_sweep` afterwards."""
        number, fusion = self._results.begin(), self._fusion
        if isinstance(fusion, SingleImageFusion):
            return self._finish(number, candidate, fusion.fuse(candidate.frame, keyframe=keyframe), keyframe)
        if keyframe and len(self._keyframes) >= _KEYFRAMES:
            keyframe = False
            self.postponed += 1
        examined = fusion.examine(candidate.frame, keyframe=keyframe)
        if isinstance(examined, FusionResult):
            return self._finish(number, candidate, examined, keyframe)
        if keyframe:
            self._keyframes.append(_KeyframeWork(number, candidate, examined))
            return []
        return self._finish(number, candidate, fusion.between_keyframes(examined), keyframe)

    def next_sweep(self) -> Callable[[], SweptKeyframe] | None:
        """Return the next plane sweep, to be run in another thread; None if one runs, or none waits.

        Pass its result to `finish_sweep`.
        """
        if self._swept is not None or not self._keyframes:
            return None
        assert isinstance(self._fusion, Fusion)  # no other method has sweeps
        self._swept = self._keyframes.popleft()
        return self._fusion.begin_keyframe(self._swept.examined)

    def finish_sweep(self, swept: SweptKeyframe) -> list[FusedImage]:
        """Take the result of a plane sweep; return the results that are due. Call `next_sweep` afterwards."""
        work, self._swept = self._swept, None
        assert work is not None  # its sweep has run
        assert isinstance(self._fusion, Fusion)
        return self._finish(work.number, work.candidate, self._fusion.finish_keyframe(swept), True)

    def _finish(
        self, number: int, candidate: CandidateImage, result: FusionResult, keyframe: bool
    ) -> list[FusedImage]:
        fused = FusedImage(candidate.frame.stamp_ns, candidate, result, keyframe)
        return self._results.finish(number, fused)
