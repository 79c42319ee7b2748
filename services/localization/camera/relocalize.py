"""Which keyframes look like a picture: where to begin when the track is lost."""

from __future__ import annotations

import cv2
import numpy as np

from beamsplat.services.localization.camera.splat_map import MapKeyframe

_SIZE = (20, 15)
_LEAST_CORRELATION = 0.4


def thumbnail(grey: np.ndarray) -> np.ndarray:
    """float32 [15, 20] of a grey picture, without its mean, of unit length: brightness does not matter."""
    small = cv2.GaussianBlur(cv2.resize(grey, _SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    small = small - small.mean()
    return (small / max(float(np.linalg.norm(small)), 1e-9)).astype(np.float32)


def similar_keyframes(keyframes: list[MapKeyframe], picture: np.ndarray, most: int) -> list[MapKeyframe]:
    """Up to `most` keyframes whose thumbnails correlate best with the picture's, best first."""
    scores = [(float(np.sum(frame.thumbnail * picture)), -i) for i, frame in enumerate(keyframes)]
    best = sorted(scores, reverse=True)[:most]
    return [keyframes[-i] for score, i in best if score > _LEAST_CORRELATION]
