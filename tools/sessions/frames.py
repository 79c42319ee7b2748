"""The keyframes of a saved session as frames of a data set: pose by the mapper, image from its file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from beamsplat.common.errors import UserError, reason
from beamsplat.common.geometry.camera import Pinhole, Undistorter
from beamsplat.common.mapfiles.blocks import Arrays
from beamsplat.common.mapfiles.dataset import DatasetFrame
from beamsplat.common.mapfiles.session import SessionFolder
from beamsplat.common.mapfiles.state import KeyframeView, keyframe_views
from beamsplat.common.messages import Keyframe
from beamsplat.common.messages.codec import decode
from beamsplat.services.mapping.messages import decode_keyframe

_EXIF, _HEAD_BYTES = b"Exif\0\0", 65_536  # where the first segments of a JPEG are


class SessionFrames:
    """Iterates over the keyframes of a checkpoint, in the order of time.

    Keyframes whose file is missing or damaged are left out; `lost` says which and why.
    """

    def __init__(self, folder: SessionFolder, arrays: Arrays) -> None:
        self.views = keyframe_views(arrays)
        self.lost: list[str] = []
        self._folder = folder
        exposures = arrays.get("keyframe_exposure", np.zeros((0, 6)))
        self._exposures = dict(zip(arrays["keyframe_id"].tolist(), exposures))
        self._lens = lru_cache(maxsize=4)(Undistorter)
        self._valid: Callable[[Pinhole], np.ndarray] = lru_cache(maxsize=4)(self._inside_original)

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[DatasetFrame]:
        for view in self.views:
            frame = self.frame(view)
            if frame is not None:
                yield frame

    def frame(self, view: KeyframeView) -> DatasetFrame | None:
        """Return one of the keyframes; None if its file is missing or damaged, which is added to `lost`."""
        try:
            return self._frame(view)
        except (UserError, ValueError) as error:
            self.lost.append(f"keyframe {view.id}: {reason(error)}")
            return None

    def as_mapped(self, frame: DatasetFrame) -> np.ndarray:
        """Return the image of a keyframe with the exposure of the map, uint8 [H, W, 3]."""
        exposure = self._exposures.get(frame.id, np.zeros(6)).astype(np.float64)
        image = (frame.rgb / 255.0 - exposure[3:]) / np.exp(exposure[:3])
        return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)

    def _frame(self, view: KeyframeView) -> DatasetFrame:
        message = decode(*self._folder.read_keyframe(view.id))
        if not isinstance(message, Keyframe):
            raise ValueError(f"its file holds a {type(message).__name__}")
        frame = decode_keyframe(message, self._lens)
        lens = Pinhole.of(message.camera)
        mask = self._valid(lens)
        picture = message.picture.tobytes()
        # The image as the camera compressed it, if no undistortion has changed it. By an orientation in EXIF
        # data some readers would turn it, but K belongs to the pixels as they are stored.
        verbatim = not lens.is_distorted and _EXIF not in picture[:_HEAD_BYTES]
        return DatasetFrame(
            id=view.id, stamp_ns=message.stamp_ns, camera=frame.camera, T_map_camera=view.T_map_camera,
            rgb=frame.rgb, encoded=(message.encoding, picture) if verbatim else None, depth_m=frame.depth_m,
            mask=mask if frame.mask is None else mask & frame.mask,
            beams_uvz_sigma=message.beams.astype(np.float64),
        )  # fmt: skip

    def _inside_original(self, lens: Pinhole) -> np.ndarray:
        """Return a mask bool [H, W] of the pixels of the undistorted image that the original image shows."""
        return self._lens(lens)(np.full(lens.shape, 255, np.uint8)) == 255
