"""Search for keyframes that look like an image: start poses after tracking was lost."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.services.localization.camera.splat_map import MapKeyframe

_SIZE_PX = (20, 15)
_MIN_CORRELATION = 0.4


def thumbnail(grey: np.ndarray) -> np.ndarray:
    """Return a descriptor float32 [15, 20] of a grey image; zero mean and unit norm cancel the exposure."""
    small = cv2.GaussianBlur(cv2.resize(grey, _SIZE_PX, interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    small = small - small.mean()
    return (small / max(float(np.linalg.norm(small)), 1e-9)).astype(np.float32)


def similar_keyframes(keyframes: list[MapKeyframe], query: np.ndarray, most: int) -> list[MapKeyframe]:
    """Return up to `most` keyframes whose thumbnails correlate with the thumbnail `query`, best first."""
    scores = [(float(np.sum(frame.thumbnail * query)), -i) for i, frame in enumerate(keyframes)]
    best = sorted(scores, reverse=True)[:most]
    return [keyframes[-i] for score, i in best if score > _MIN_CORRELATION]
